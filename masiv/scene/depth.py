"""Depth pictures: the distance of each pixel along the optical axis, as a depth camera measures it.

(H, W) float32 [m], 0 where it is unknown.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from masiv.errors import InputError
from masiv.files import read_npy
from masiv.scene.camera import Camera
from masiv.scene.picture_file import read_raw

MILLIMETRE = 1e-3
"""Unit [m] of the integers in depth pictures, unless a file says otherwise."""


@dataclass(frozen=True)
class DepthNoise:
    """Standard deviation of a depth: constant [m] + quadratic [1/m] z².

    A stereo camera with focal length f [pixels], baseline b [m] and a disparity error of e pixels has quadratic =
    e / (f b). The default is that of an Intel RealSense D435 (f = 640 at 1280 × 720, b = 50 mm, e = 0.08: its data
    sheet's subpixel error on a textured target), with a millimetre for the steps of its integers.
    """

    constant: float = 1e-3
    quadratic: float = 2.5e-3

    def std(self, depth: np.ndarray) -> np.ndarray:
        """Standard deviation [m] of ``depth`` [m], of any shape."""
        return self.constant + self.quadratic * np.square(depth)


def depth_size(path: Path) -> tuple[int, int]:
    """Width and height [pixels] of a depth picture. Raises InputError if it cannot be read."""
    height, width = _numbers(path).shape
    return width, height


def read_depth(path: Path, unit: float) -> np.ndarray:
    """The depth picture ``path`` (H, W) [m]: a picture with one channel (16 bits) or a .npy array of numbers.

    unit [m]: of one step of the numbers. What is zero, negative or not finite is unknown. Raises InputError.
    """
    depth = _numbers(path).astype(np.float32) * np.float32(unit)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def back_projected(camera: Camera, depth: np.ndarray, chosen: np.ndarray | None = None) -> np.ndarray:
    """World points (N, 3) [m] of the pixels with a known ``depth`` (H, W) [m], row by row.

    chosen (H, W) bool: those pixels only.
    """
    known = depth > 0 if chosen is None else (depth > 0) & chosen
    rows, columns = np.nonzero(known)
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], axis=1)
    in_camera = np.linalg.solve(camera.intrinsics, pixels.T).T * depth[known].astype(np.float64)[:, None]
    return (in_camera - camera.world_to_camera[:3, 3]) @ camera.world_to_camera[:3, :3]


def _numbers(path: Path) -> np.ndarray:
    if path.suffix == ".npy":
        values = read_npy(path)
    else:
        values = read_raw(path)
    if values.ndim != 2 or values.dtype.kind not in "uif" or values.dtype.itemsize < 2:
        raise InputError(
            f"{path} is {values.dtype} of shape {values.shape}: a depth picture has one channel of 16 bits or more"
        )
    return values
