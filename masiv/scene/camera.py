"""A calibrated pinhole camera. Conventions: docs/conventions.md."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from masiv.scene.shutter import INSTANT, Shutter


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
