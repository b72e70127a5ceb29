"""Calibrated intrinsics with OpenCV's lens distortion, and the pinhole camera of the undistorted picture."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from masiv.errors import InputError
from masiv.scene.listing import number

COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3")
# COLMAP's names of camera models -> the distortion that each may have
MODELS: dict[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "PERSPECTIVE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": COEFFICIENTS,
}
HALF = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # pixel centres: +0.5 here, whole numbers in OpenCV


@dataclass(frozen=True, eq=False)
class Lens:
    """A pinhole with Brown–Conrady distortion, OpenCV's formula.

    intrinsics: (3, 3) [pixels], pixel centres at +0.5. coefficients: (5,) k1, k2, p1, p2, k3.
    """

    intrinsics: np.ndarray
    coefficients: np.ndarray
    width: int
    height: int

    @property
    def is_pinhole(self) -> bool:
        """Whether the lens has no distortion."""
        return not self.coefficients.any()

    @cached_property
    def pinhole(self) -> np.ndarray:
        """Intrinsics (3, 3) [pixels] of the undistorted picture: the widest one without empty pixels.

        Raises InputError if the distortion is not invertible inside of the picture.
        """
        if self.is_pinhole:
            return self.intrinsics
        size = self.width, self.height
        new, _ = cv2.getOptimalNewCameraMatrix(self.intrinsics - HALF, self.coefficients, size, 0)
        new = np.asarray(new, np.float64)
        if not np.isfinite(new).all() or min(new[0, 0], new[1, 1]) <= 0 or self._folds(new):
            raise InputError(
                f"the lens distortion {_format_coefficients(self.coefficients)} is not invertible in the picture: "
                "check its coefficients"
            )
        return new + HALF

    def _folds(self, new: np.ndarray) -> bool:
        corners = np.array([[x, y, 1.0] for x in (0, self.width - 1) for y in (0, self.height - 1)])
        radius = np.linalg.norm((corners @ np.linalg.inv(new).T)[:, :2], axis=1).max()
        r2 = np.linspace(0, radius, 64) ** 2
        k1, k2, _, _, k3 = self.coefficients
        return bool((1 + 3 * k1 * r2 + 5 * k2 * r2**2 + 7 * k3 * r2**3).min() <= 0)

    @cached_property
    def _maps(self) -> tuple[np.ndarray, np.ndarray]:
        size = self.width, self.height
        x, y = cv2.initUndistortRectifyMap(
            self.intrinsics - HALF, self.coefficients, np.eye(3), self.pinhole - HALF, size, cv2.CV_32FC1
        )
        return np.asarray(x), np.asarray(y)

    @cached_property
    def visible(self) -> np.ndarray:
        """Which pixels (H, W) bool of the undistorted picture are inside of the original one."""
        if self.is_pinhole:
            return np.ones((self.height, self.width), bool)
        x, y = self._maps
        return (x >= -0.5) & (x <= self.width - 0.5) & (y >= -0.5) & (y <= self.height - 0.5)

    def undistort(self, pixels: np.ndarray) -> np.ndarray:
        """A picture (H, W, 3) or (H, W, 4) uint8, resampled to the pinhole camera.

        Colours are weighted by alpha, so that the colour of transparent pixels does not leak into the edge.
        """
        if self.is_pinhole:
            return pixels
        x, y = self._maps
        values = pixels.astype(np.float32)
        if pixels.shape[-1] == 4:
            values[..., :3] *= values[..., 3:] / 255
        values = cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        if pixels.shape[-1] == 4:
            values[..., :3] *= 255 / np.maximum(values[..., 3:], 0.5)
        return np.clip(np.round(values), 0, 255).astype(np.uint8)

    def undistort_nearest(self, values: np.ndarray) -> np.ndarray:
        """Values (H, W), for example depths, of the nearest pixels; 0 outside of the original picture.

        A mean over an edge would be the depth of a point that is on no surface.
        """
        if self.is_pinhole:
            return values
        return cv2.remap(values, *self._maps, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)


def read_lens(row: Mapping[str, Any], width: int, height: int, where: str) -> Lens:
    """The lens of a nerfstudio, instant-ngp or Blender listing, for pictures of ``width`` × ``height`` pixels.

    ``row`` contains fl_x (fl_y, cx, cy, w, h, k1, k2, p1, p2, k3, camera_model), or camera_angle_x [rad]. Intrinsics
    for w × h are scaled to the size of the pictures. Raises InputError for a model that is not a pinhole with OpenCV's
    distortion, and for impossible numbers.
    """
    coefficients = _coefficients(row, where)
    w, h = number(row, "w", where, width), number(row, "h", where, height)
    if min(w, h) <= 0 or abs(width / w - height / h) * max(w, h) > 2:
        raise InputError(f"{where}: w × h is {w:g}×{h:g}, the picture is {width}×{height}: another shape")
    if "fl_x" in row:
        focal_x = number(row, "fl_x", where)
        focal_y = number(row, "fl_y", where, focal_x)
    elif "camera_angle_x" in row:
        focal_x = _focal(number(row, "camera_angle_x", where), w, where)
        focal_y = _focal(number(row, "camera_angle_y", where), h, where) if "camera_angle_y" in row else focal_x
    else:
        raise InputError(f"{where} has neither 'fl_x' nor 'camera_angle_x'")
    if min(focal_x, focal_y) <= 0:
        raise InputError(f"{where}: the focal length is {min(focal_x, focal_y):g} pixels, it must be positive")
    cx, cy = number(row, "cx", where, w / 2), number(row, "cy", where, h / 2)
    scale = np.diag([width / w, height / h, 1.0])
    return Lens(scale @ np.array([[focal_x, 0, cx], [0, focal_y, cy], [0, 0, 1.0]]), coefficients, width, height)


def _coefficients(row: Mapping[str, Any], where: str) -> np.ndarray:
    model = str(row.get("camera_model", "OPENCV"))
    if model not in MODELS or row.get("is_fisheye"):
        raise InputError(
            f"{where}: camera_model is {'fisheye' if model in MODELS else model!r}, known are {', '.join(MODELS)}: "
            "undistort the pictures first"
        )
    given = {key: number(row, key, where, 0.0) for key in (*COEFFICIENTS, "k4", "k5", "k6")}
    extra = [key for key, value in given.items() if value != 0 and key not in MODELS[model]]
    if extra:
        raise InputError(f"{where}: camera_model {model} has no {', '.join(extra)}: undistort the pictures first")
    return np.array([given[key] for key in COEFFICIENTS])


def _focal(angle: float, pixels: float, where: str) -> float:
    if not 0 < angle < math.pi:
        raise InputError(f"{where}: the camera's angle is {angle:g}, it must be between 0 and π rad")
    return 0.5 * pixels / math.tan(0.5 * angle)


def _format_coefficients(coefficients: np.ndarray) -> str:
    return ", ".join(f"{key} = {value:g}" for key, value in zip(COEFFICIENTS, coefficients, strict=True))
