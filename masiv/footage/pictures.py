"""The pictures of one camera on their way from the footage into the scene: undistorted if needed, made smaller."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from masiv.errors import InputError, MasivError
from masiv.footage.calibrated_camera import CalibratedCamera


@dataclass(frozen=True, eq=False)
class Converter:
    """filmed: the camera of the footage. written: that of the scene's pictures. undistort: None where the readers of
    scenes do it."""

    filmed: CalibratedCamera
    written: CalibratedCamera
    undistort: Callable[[np.ndarray], np.ndarray] | None

    @classmethod
    def of(cls, filmed: CalibratedCamera, downscale: float) -> Converter:
        """For pictures that are ``downscale`` times smaller along both sides. Raises InputError."""
        camera, undistort = (filmed, None) if filmed.is_read_as_it_is else filmed.without_distortion()
        if not (np.isfinite(downscale) and downscale >= 1):
            raise InputError(f"--downscale {downscale:g}: give 1 or more; pictures are not enlarged")
        width, height = round(filmed.width / downscale), round(filmed.height / downscale)
        if min(width, height) < 16:
            raise InputError(f"--downscale {downscale:g} leaves {width}×{height} pixels of {filmed.name}: give less")
        return cls(filmed, camera.exactly_resized(width, height), undistort)

    @property
    def changes_nothing(self) -> bool:
        """Whether pictures stay as they are."""
        return self.undistort is None and (self.filmed.width, self.filmed.height) == self._size

    @property
    def _size(self) -> tuple[int, int]:
        return self.written.width, self.written.height

    def __call__(self, pixels: np.ndarray) -> np.ndarray:
        """A picture (H, W), (H, W, 3) or (H, W, 4) uint8. Colours are weighted by alpha, so that those of transparent
        pixels do not leak into the edge."""
        if self.changes_nothing:
            return pixels
        values = pixels.astype(np.float32)
        with_alpha = values.ndim == 3 and values.shape[-1] == 4
        if with_alpha:
            values[..., :3] *= values[..., 3:] / 255
        if self.undistort is not None:
            values = self.undistort(values)
        if (values.shape[1], values.shape[0]) != self._size:
            values = cv2.resize(values, self._size, interpolation=cv2.INTER_AREA)
        if with_alpha:
            values[..., :3] *= 255 / np.maximum(values[..., 3:], 0.5)
        return np.clip(np.round(values), 0, 255).astype(np.uint8)

    def point(self, pixels: np.ndarray) -> np.ndarray:
        """``pixels`` (N, 2) of the footage -> in the pictures of the scene as its reader undistorts them."""
        found = self.filmed.as_read(pixels)
        return found * [self.written.width / self.filmed.width, self.written.height / self.filmed.height]


def write_picture(path: Path, pixels: np.ndarray, jpeg: int | None = None) -> None:
    """Write (H, W), (H, W, 3) RGB or (H, W, 4) RGBA uint8, as PNG or, with a quality, as JPEG."""
    order: np.ndarray = pixels
    if pixels.ndim == 3:
        order = np.ascontiguousarray(pixels[..., [2, 1, 0, 3][: pixels.shape[-1]]])
    options = [] if jpeg is None else [cv2.IMWRITE_JPEG_QUALITY, jpeg]
    encoded, data = cv2.imencode(path.suffix, order, options)
    if not encoded:
        raise MasivError(f"the picture {path} could not be encoded")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data.tobytes())
