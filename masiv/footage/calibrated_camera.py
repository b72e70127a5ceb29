"""A calibrated camera as a calibration file states it: lens, distortion and pose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from masiv.errors import InputError
from masiv.scene.lens import COEFFICIENTS, HALF, Lens

RATIONAL = (*COEFFICIENTS, "k4", "k5", "k6")
FISHEYE = ("k1", "k2", "k3", "k4")
SHAPE_TOLERANCE = 2.0
"""Difference of the heights [pixels] of calibration and footage, at the same width, that rounding explains."""
OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True, eq=False)
class CalibratedCamera:
    """Intrinsics, distortion and pose of one camera.

    intrinsics: (3, 3) [pixels], pixel centres at +0.5, for pictures of ``width`` × ``height`` pixels.
    coefficients: OpenCV's k1, k2, p1, p2, k3 (k4, k5, k6); of a fisheye its k1, k2, k3, k4.
    world_to_camera: (4, 4), OpenCV axes, in the calibration's unit of length.
    """

    name: str
    width: int
    height: int
    intrinsics: np.ndarray
    world_to_camera: np.ndarray
    coefficients: np.ndarray = field(default_factory=lambda: np.zeros(5))
    fisheye: bool = False

    @property
    def is_read_as_it_is(self) -> bool:
        """Whether the readers of scenes know its distortion. If not, its pictures are undistorted once."""
        return not self.fisheye and len(self.coefficients) <= len(COEFFICIENTS)

    def resized(self, width: int, height: int) -> CalibratedCamera:
        """The camera for pictures of another size. Raises InputError if these have another shape."""
        if abs(height - self.height * width / self.width) > SHAPE_TOLERANCE * max(1.0, width / self.width):
            raise InputError(
                f"the pictures of {self.name} have {width}×{height} pixels, its calibration is for "
                f"{self.width}×{self.height}: another shape; calibrate with the format that is filmed"
            )
        return self.exactly_resized(width, height)

    def exactly_resized(self, width: int, height: int) -> CalibratedCamera:
        """As ``resized``, whatever the shape: pixels become as wide and high as they must."""
        scale = np.diag([width / self.width, height / self.height, 1.0])
        return replace(self, width=width, height=height, intrinsics=scale @ self.intrinsics)

    def scaled(self, metres: float) -> CalibratedCamera:
        """The camera in a world whose unit of length is ``metres`` times the former one."""
        pose = self.world_to_camera.copy()
        pose[:3, 3] *= metres
        return replace(self, world_to_camera=pose)

    @property
    def centre(self) -> np.ndarray:
        """Optical centre, shape (3,), in the unit of the calibration."""
        return -self.world_to_camera[:3, :3].T @ self.world_to_camera[:3, 3]

    def rays(self, pixels: np.ndarray) -> np.ndarray:
        """Where the rays of ``pixels`` (N, 2), as filmed, meet the plane z = 1 of the camera, shape (N, 2)."""
        given = np.asarray(pixels, np.float64).reshape(-1, 1, 2) - 0.5
        matrix = self.intrinsics - HALF
        if self.fisheye:
            return cv2.fisheye.undistortPoints(given, matrix, self.coefficients).reshape(-1, 2)
        many = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-12)
        return cv2.undistortPoints(given, matrix, self.coefficients, criteria=many).reshape(-1, 2)

    def without_distortion(self) -> tuple[CalibratedCamera, Callable[[np.ndarray], np.ndarray]]:
        """The pinhole camera of the undistorted pictures, the widest without empty pixels, and what undistorts one.

        Raises InputError if the distortion is not invertible inside of the picture.
        """
        size, matrix = (self.width, self.height), self.intrinsics - HALF
        if self.fisheye:
            new = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
                matrix, self.coefficients, size, np.eye(3), balance=0
            )
        else:
            new, _ = cv2.getOptimalNewCameraMatrix(matrix, self.coefficients, size, 0)
        new = np.asarray(new, np.float64)
        if not np.isfinite(new).all() or min(new[0, 0], new[1, 1]) <= 0:
            raise InputError(f"the lens distortion of {self.name} is not invertible in the picture: check it")
        undistort = cv2.fisheye.initUndistortRectifyMap if self.fisheye else cv2.initUndistortRectifyMap
        maps = undistort(matrix, self.coefficients, np.eye(3), new, size, cv2.CV_32FC1)

        def apply(pixels: np.ndarray) -> np.ndarray:
            return cv2.remap(pixels, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

        pinhole = replace(self, intrinsics=new + HALF, coefficients=np.zeros(5), fisheye=False)
        return pinhole, apply

    def as_read(self, pixels: np.ndarray) -> np.ndarray:
        """``pixels`` (N, 2), as filmed -> where they are in the undistorted picture that a scene's reader makes."""
        if self.is_read_as_it_is:
            coefficients = np.zeros(5)
            coefficients[: len(self.coefficients)] = self.coefficients
            matrix = Lens(self.intrinsics, coefficients, self.width, self.height).pinhole
        else:
            matrix = self.without_distortion()[0].intrinsics
        rays = self.rays(pixels)
        return np.column_stack([rays, np.ones(len(rays))]) @ matrix[:2].T

    def listing_row(self) -> dict[str, object]:
        """Intrinsics and pose by the keys of ``transforms.json``; the pose is camera to world, in OpenGL axes."""
        k = self.intrinsics
        row: dict[str, object] = {
            "camera_model": "OPENCV" if self.coefficients.any() else "PINHOLE",
            "w": self.width, "h": self.height, "fl_x": k[0, 0], "fl_y": k[1, 1], "cx": k[0, 2], "cy": k[1, 2],
        }  # fmt: skip
        if self.coefficients.any():
            row |= dict(zip(COEFFICIENTS, self.coefficients.tolist(), strict=False))
        rotation = self.world_to_camera[:3, :3]
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation.T, self.centre
        return {**row, "transform_matrix": (pose @ OPENGL_TO_OPENCV).tolist()}
