"""A calibrated pinhole camera. Conventions: docs/conventions.md."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from masiv.bounds import LENGTH
from masiv.errors import InputError
from masiv.scene.shutter import INSTANT, Shutter

SHORTEST_FOCAL, LONGEST_FOCAL = 0.04, 1e5
"""In sizes of the picture. A pinhole would see 171° with the shortest one: real lenses distort long before that. With
the longest, a picture spans 2 seconds of arc."""
SAME = 1e-6
"""Difference of poses [m, 1] and, relative, of intrinsics below which two cameras are one."""


@dataclass(frozen=True)
class Camera:
    """Pinhole camera without distortion (readers undistort), OpenCV axes: x right, y down, z forward.

    intrinsics: (3, 3) float64 [pixels], pixel centres at +0.5.
    world_to_camera: (4, 4) float64 [m], x_camera = R x_world + t.
    shutter: when its pixels are exposed.
    """

    name: str
    width: int
    height: int
    intrinsics: np.ndarray
    world_to_camera: np.ndarray
    shutter: Shutter = INSTANT

    @property
    def centre(self) -> np.ndarray:
        """Optical centre in the world, shape (3,) [m]."""
        rotation, translation = self.world_to_camera[:3, :3], self.world_to_camera[:3, 3]
        return -rotation.T @ translation

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """World points (N, 3) [m] -> pixel coordinates (N, 2) and depths along the optical axis (N,) [m]."""
        in_camera = points @ self.world_to_camera[:3, :3].T + self.world_to_camera[:3, 3]
        depth = in_camera[:, 2]
        homogeneous = in_camera @ self.intrinsics.T
        return homogeneous[:, :2] / homogeneous[:, 2:3], depth

    def cropped(self, x0: int, y0: int, width: int, height: int) -> Camera:
        """The camera of the sub-image that starts at pixel (x0, y0); may reach outside the image."""
        intrinsics = self.intrinsics.copy()
        intrinsics[0, 2] -= x0
        intrinsics[1, 2] -= y0
        return replace(self, width=width, height=height, intrinsics=intrinsics, shutter=self.shutter.cropped(y0))

    def reduced(self, factor: int) -> Camera:
        """The camera of an image averaged over factor x factor blocks, whole ones. All of K scales, since pixel centres
        are at +0.5."""
        intrinsics = self.intrinsics.copy()
        intrinsics[:2] /= factor
        width, height = self.width // factor, self.height // factor
        return replace(self, width=width, height=height, intrinsics=intrinsics, shutter=self.shutter.reduced(factor))


def check_cameras(cameras: Sequence[Camera], where: str) -> None:
    """Raises InputError if intrinsics are not those of a pinhole camera, a camera is further away than anything that is
    filmed, or two cameras are the same."""
    for k, camera in enumerate(cameras):
        _check_intrinsics(camera, f"{where}: intrinsics of {camera.name}")
        LENGTH.check(camera.centre, f"{where}: the position of {camera.name}")
        for other in cameras[:k]:
            if _same(camera, other):
                raise InputError(
                    f"{where}: {other.name} and {camera.name} have the same pose and focal length, and two cameras "
                    "cannot be in one place: correct one, or remove it"
                )


def _check_intrinsics(camera: Camera, where: str) -> None:
    k, size = camera.intrinsics, max(camera.width, camera.height)
    if k.shape != (3, 3) or not np.isfinite(k).all():
        raise InputError(f"{where} must be 3×3 finite numbers")
    if k[1, 0] != 0 or (k[2] != [0, 0, 1]).any():
        raise InputError(f"{where} must have the form [[fx, s, cx], [0, fy, cy], [0, 0, 1]], is it transposed?")
    for focal in (k[0, 0], k[1, 1]):
        if not SHORTEST_FOCAL * size <= focal <= LONGEST_FOCAL * size:
            raise InputError(
                f"{where}: the focal length {focal:.4g} pixels is not that of a pinhole camera with {camera.width}×"
                f"{camera.height} pixels (it must be {SHORTEST_FOCAL * size:.3g} to {LONGEST_FOCAL * size:.3g}): give "
                "it in pixels"
            )
    if not (0 <= k[0, 2] <= camera.width and 0 <= k[1, 2] <= camera.height):
        raise InputError(
            f"{where}: the principal point ({k[0, 2]:.4g}, {k[1, 2]:.4g}) is outside of the picture of {camera.width}×"
            f"{camera.height} pixels: give it in pixels of this picture"
        )


def _same(one: Camera, other: Camera) -> bool:
    return bool(
        np.abs(one.world_to_camera - other.world_to_camera).max() < SAME
        and np.allclose(one.intrinsics, other.intrinsics, rtol=SAME, atol=0)
    )
