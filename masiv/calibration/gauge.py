"""Corrections of cameras: their prior, their effect in pixels, and what no picture determines of them.

A correction of V cameras is an array (V, 8); a row is that of ``masiv.scene.calibration.CameraCorrection``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from masiv.calibration.config import CalibrationPrior
from masiv.scene.camera import Camera

POSE = 8
"""Corrections of a camera: rotation vector (3) [rad], translation (3) [m], log focal factor, time offset [s]."""
REGISTRATION_NOISE_PX = 0.1
"""Error to which pictures register a camera: what the gauge takes for it when it weighs pixels and prior."""
MIN_PRIOR_SCALE, MAX_PRIOR_SCALE = 0.02, 5.0
"""Limits of what the silhouettes' agreement does to the prior standard deviations: no camera is exact, and one
that is further off is a mistake, which ``inspect`` names."""


def prior_deviations(cameras: Sequence[Camera], pivot: np.ndarray, fps: float, prior: CalibrationPrior) -> np.ndarray:
    """Prior standard deviations (V, 8) of rotation [rad] and translation [m] at the camera's centre, log focal factor,
    clock [s]."""
    rows = []
    for camera in cameras:
        distance = float(np.linalg.norm(camera.centre - pivot))
        rows.append(
            [np.radians(prior.rotation_deg)] * 3
            + [prior.translation_fraction * distance] * 3
            + [prior.focal_fraction, prior.time_frames / fps]
        )
    return np.array(rows)


def scaled_deviations(
    deviations: np.ndarray,
    inconsistency: np.ndarray,
    cameras: Sequence[Camera],
    pivot: np.ndarray,
    points: np.ndarray,
    velocities: np.ndarray,
) -> np.ndarray:
    """Prior standard deviations (V, 8) that displace the object by what its silhouettes disagree.

    inconsistency (V,) [pixels]: epipolar tangency error of each camera against the others, NaN if unknown. For random
    errors it is about the RMS displacement of the picture. Pose with focal length, and clock, are scaled apart: each of
    them alone may be the cause. So cameras whose silhouettes agree stay where they are, also if the pictures cannot
    tell a clock from a height.
    """
    scaled = deviations.copy()
    for row, camera, error in zip(scaled, cameras, inconsistency, strict=True):
        if not np.isfinite(error):
            continue
        local = at_camera(camera, pivot)
        jacobian = displacement_jacobian(camera, pivot, points, velocities) @ np.linalg.inv(local)
        squares = ((jacobian * row) ** 2).sum(axis=1).mean(axis=0)
        for part, largest in ((slice(0, 7), MAX_PRIOR_SCALE), (slice(7, 8), 1.0)):
            expected = np.sqrt(squares[part].sum())
            row[part] *= np.clip(error / max(expected, 1e-9), MIN_PRIOR_SCALE, largest)
    return scaled


def gauge_free_steps(
    cameras: Sequence[Camera], pivot: np.ndarray, points: np.ndarray, velocities: np.ndarray, deviations: np.ndarray
) -> np.ndarray:
    """The map (8 V, 8 V) from the parameters to the corrections of all cameras."""
    count = POSE * len(cameras)
    steps, metric, gauge = np.zeros((count, count)), np.zeros((count, count)), np.zeros((count, POSE))
    for view, (camera, deviation) in enumerate(zip(cameras, deviations, strict=True)):
        rows = slice(POSE * view, POSE * (view + 1))
        rotation = camera.world_to_camera[:3, :3]
        centre = rotation @ pivot + camera.world_to_camera[:3, 3]
        precision = camera_precision(camera, pivot, deviation)
        jacobian = displacement_jacobian(camera, pivot, points, velocities)
        curvature = np.einsum("pij,pik->jk", jacobian, jacobian) / len(points)
        # A step of one is a pixel, or one prior standard deviation where that moves the picture by less. The scale of
        # each quantity is taken out first: radians, metres and seconds have nothing in common.
        scaled = deviation[:, None] * (curvature + precision) * deviation
        values, vectors = np.linalg.eigh(scaled)
        steps[rows, rows] = deviation[:, None] * (vectors / np.sqrt(values)) @ vectors.T
        block = curvature + REGISTRATION_NOISE_PX**2 * precision
        # A common delay is that of the clocks' mean, whatever the cameras do.
        block[7, :7] = block[:7, 7] = 0
        block[7, 7] = 1
        metric[rows, rows] = block
        gauge[rows, :3] = np.vstack([rotation, np.zeros((5, 3))])
        gauge[rows, 3:6] = np.vstack([np.zeros((3, 3)), rotation, np.zeros((2, 3))])
        gauge[rows, 6] = [0, 0, 0, *centre, 0, 0]
        gauge[rows, 7] = [0, 0, 0, 0, 0, 0, 0, 1]
    weighted = gauge.T @ metric
    scale = np.sqrt(np.diag(weighted @ gauge))
    weighted, gauge = weighted / scale[:, None], gauge / scale
    return steps - gauge @ np.linalg.solve(weighted @ gauge, weighted @ steps)


def at_camera(camera: Camera, pivot: np.ndarray) -> np.ndarray:
    """The linear map (8, 8) of a correction about ``pivot`` to one with the translation of the camera's own centre."""
    found = np.eye(POSE)
    found[3:6, :3] = cross_matrix(camera.world_to_camera[:3, :3] @ pivot + camera.world_to_camera[:3, 3])
    return found


def camera_precision(camera: Camera, pivot: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """Inverse covariance (8, 8) of a correction about ``pivot``, from a row (8,) of ``prior_deviations``."""
    local = at_camera(camera, pivot)
    return local.T @ np.diag(deviation**-2) @ local


def displacement_jacobian(camera: Camera, pivot: np.ndarray, points: np.ndarray, velocities: np.ndarray) -> np.ndarray:
    """Derivative (P, 2, 8) of the pixels of ``points`` (P, 3) [m] with respect to the corrections at zero."""
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    x = points @ rotation.T + translation
    k, depth = camera.intrinsics[:2, :2], x[:, 2]
    perspective = np.zeros((len(points), 2, 3))
    perspective[:, 0, 0] = perspective[:, 1, 1] = 1 / depth
    perspective[:, :, 2] = -x[:, :2] / depth[:, None] ** 2
    projection = k @ perspective
    relative = x - (rotation @ pivot + translation)
    out = np.empty((len(points), 2, POSE))
    for axis in range(3):
        out[:, :, axis] = np.einsum("pij,pj->pi", projection, np.cross(np.eye(3)[axis], relative))
    out[:, :, 3:6] = projection
    out[:, :, 6] = (x[:, :2] / depth[:, None]) @ k.T
    out[:, :, 7] = np.einsum("pij,pj->pi", projection, velocities @ rotation.T)
    return out


def cross_matrix(vector: np.ndarray) -> np.ndarray:
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0.0]])
