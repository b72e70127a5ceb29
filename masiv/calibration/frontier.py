"""Where the planes through two optical centres touch the object in both pictures, and how far the two disagree.

The point of contact is a frontier point of the object. It is differentiated in closed form: at a tangent, the first
derivative of the plane's angle does not depend on how the point slides along the outline (envelope theorem), so the
point is held and found anew for the next cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from masiv.calibration.gauge import POSE, cross_matrix
from masiv.calibration.tangency import Outline
from masiv.scene.calibration import CameraCorrection, corrected_camera
from masiv.scene.camera import Camera

SIDES = (-1.0, 1.0)


@dataclass(frozen=True)
class Outlines:
    """Outlines of V views at F frames, as arrays: shorter ones are filled up with copies of their first vertex.

    hulls (V, F, K, 2) [pixels], NaN where a view has no outline. cuts (V, F, C, 2) [pixels]: hull of ``Outline.cut``,
    NaN where nothing is cut off. frames (F,): ascending.
    """

    hulls: np.ndarray
    cuts: np.ndarray
    frames: np.ndarray

    @classmethod
    def of(cls, outlines: Sequence[Sequence[Outline | None]], frames: Sequence[int]) -> Outlines:
        """outlines: V lists of F."""
        hulls = [[None if seen is None else seen.hull for seen in row] for row in outlines]
        cuts = [[None if seen is None or not len(seen.cut) else _hull(seen.cut) for seen in row] for row in outlines]
        return cls(_padded(hulls), _padded(cuts), np.asarray(frames))


@dataclass(frozen=True)
class TangencyResiduals:
    """Of N tangent planes of pairs of views.

    pairs (N, 2): views. angles (N,) [rad]: from the plane of the first view to that of the second. pixel_angles (N,)
    [rad]: standard deviation of the angle if each outline has an error of one pixel. jacobian (N, 2, 8): derivative of
    ``angles`` with respect to the corrections of the two cameras. groups (N,): the same number for the same side of the
    same pair in all frames.
    """

    pairs: np.ndarray
    angles: np.ndarray
    pixel_angles: np.ndarray
    jacobian: np.ndarray
    groups: np.ndarray


@dataclass(frozen=True)
class _View:
    """A corrected camera and the derivatives of its rays and its optical centre.

    rays (F, K, 3), cut_rays (F, C, 3) [world]: of the outlines. centre_jacobian (3, 8).
    """

    camera: Camera
    correction: np.ndarray
    hulls: np.ndarray
    rays: np.ndarray
    cut_rays: np.ndarray
    centre_jacobian: np.ndarray


def tangency_residuals(
    cameras: Sequence[Camera],
    outlines: Outlines,
    corrections: np.ndarray,
    pivot: np.ndarray,
    fps: float,
    time_offsets: np.ndarray,
) -> TangencyResiduals:
    """All that are known between the given ``cameras`` (V) after ``corrections`` (V, 8) about ``pivot`` (3,) [m].

    time_offsets (V,) [s]: of the given clocks. A plane is turned to the time of its frame at its own rate, which the
    neighbouring frames give; the Jacobian takes this rate as given.
    """
    views = [
        _view(camera, row, pivot, hulls, cuts)
        for camera, row, hulls, cuts in zip(cameras, corrections, outlines.hulls, outlines.cuts, strict=True)
    ]
    found = []
    for i in range(len(views)):
        for j in range(i + 1, len(views)):
            clocks = time_offsets[[i, j]] + corrections[[i, j], 7]
            rows = _pair(views[i], views[j], clocks, outlines.frames, fps)
            if rows is not None:
                found.append(((i, j), rows))
    if not found:
        return TangencyResiduals(
            np.zeros((0, 2), int), np.zeros(0), np.zeros(0), np.zeros((0, 2, POSE)), np.zeros(0, int)
        )
    angles, pixel_angles, jacobian, sides = (
        np.concatenate(part) for part in zip(*(rows for _, rows in found), strict=True)
    )
    pairs = np.concatenate([np.tile(pair, (len(rows[0]), 1)) for pair, rows in found])
    groups = np.repeat(2 * np.arange(len(found)), [len(rows[0]) for _, rows in found]) + sides
    return TangencyResiduals(pairs, angles, pixel_angles, jacobian, groups)


def tangent_angles(cameras: Sequence[Camera], outlines: Outlines, pair: tuple[int, int]) -> np.ndarray:
    """Angles (2, F, 2) [rad] about the baseline of the two planes that touch the outline of each camera of ``pair``
    (i, j), against one plane of reference; NaN if unknown."""
    one, other = (_view(cameras[k], np.zeros(POSE), np.zeros(3), outlines.hulls[k], outlines.cuts[k]) for k in pair)
    baseline = other.camera.centre - one.camera.centre
    length = float(np.linalg.norm(baseline))
    if length < 1e-9:
        return np.full((2, len(outlines.frames), 2), np.nan)
    axis = baseline / length
    seen = np.concatenate([one.rays.reshape(-1, 3), other.rays.reshape(-1, 3)])
    across = np.nanmean(seen / np.linalg.norm(seen, axis=1, keepdims=True), axis=0)
    across = across - (across @ axis) * axis
    found = []
    for view, (ends, known) in zip((one, other), _tangent_points(axis, one, other), strict=True):
        touching = np.take_along_axis(view.rays, ends[..., None], 1)
        found.append(np.where(known, np.arctan2(touching @ np.cross(axis, across), touching @ across), np.nan))
    return np.stack(found)


def _view(camera: Camera, row: np.ndarray, pivot: np.ndarray, hulls: np.ndarray, cuts: np.ndarray) -> _View:
    given = camera.world_to_camera
    corrected = corrected_camera(camera, CameraCorrection(row[:3], row[3:6], float(row[6]), float(row[7])), pivot)
    rotation = corrected.world_to_camera[:3, :3]
    moved = given[:3, :3] @ pivot + given[:3, 3] + row[3:6]
    jacobian = np.zeros((3, POSE))
    jacobian[:, :3] = -rotation.T @ cross_matrix(moved) @ _left_jacobian(row[:3])
    jacobian[:, 3:6] = -rotation.T
    return _View(corrected, row, hulls, world_rays(corrected, hulls), world_rays(corrected, cuts), jacobian)


def _pair(
    one: _View, other: _View, clocks: np.ndarray, frames: np.ndarray, fps: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    """angles, pixel_angles, jacobian and sides of the tangent planes of two views; None if there are none."""
    baseline = other.camera.centre - one.camera.centre
    length = float(np.linalg.norm(baseline))
    if length < 1e-9:
        return None
    axis = baseline / length
    touched = _tangent_points(axis, one, other)
    pixels = [np.take_along_axis(v.hulls, k[..., None], 1) for v, (k, _) in zip((one, other), touched, strict=True)]
    rays = [np.take_along_axis(v.rays, k[..., None], 1) for v, (k, _) in zip((one, other), touched, strict=True)]
    known = touched[0][1] & touched[1][1]
    angle, (by_one, by_other, by_axis) = _angle(axis, *rays)
    by_baseline = (by_axis - (by_axis @ axis)[..., None] * axis) / length
    jacobian = np.zeros((*angle.shape, 2, POSE))
    squares = np.zeros(angle.shape)
    for k, (view, by_ray, sign) in enumerate(((one, by_one, -1.0), (other, by_other, 1.0))):
        by_pixel, by_correction = _by_ray(view, pixels[k], by_ray)
        squares += (by_pixel**2).sum(axis=-1)
        jacobian[..., k, :] = by_correction + sign * by_baseline @ view.centre_jacobian
        rate = -sign * _rates(axis, np.where(known[..., None], rays[k], np.nan), frames, fps)
        jacobian[..., k, 7] = rate
        angle = angle + rate * (clocks[k] + view.camera.shutter.row_times(pixels[k][..., 1]))
    sides = np.broadcast_to([0, 1], known.shape)
    return (angle[known], np.sqrt(squares[known]), jacobian[known], sides[known]) if known.any() else None


def _tangent_points(axis: np.ndarray, one: _View, other: _View) -> list[tuple[np.ndarray, np.ndarray]]:
    """Of both views: index (F, 2) of the vertex that the first and the last half-plane about ``axis`` touch, and
    whether it is known (F, 2), as in ``tangency.tangency_errors``."""
    across = one.rays.mean(axis=1)
    across = across - (across @ axis)[:, None] * axis
    third = np.cross(axis, across)
    found = []
    for view in (one, other):
        angles = _angles(view.rays, across, third)
        ends = np.stack([angles.argmin(axis=1), angles.argmax(axis=1)], axis=1)
        span = np.take_along_axis(angles, ends, 1)
        known = np.repeat(span[:, 1:] - span[:, :1] < np.pi, 2, axis=1)  # false for NaN
        if view.cut_rays.shape[1]:
            beyond = (_angles(view.cut_rays, across, third) - span.mean(axis=1, keepdims=True))[..., None] * SIDES
            known &= ~(beyond > 0).any(axis=1)
        found.append((ends, known))
    return found


def _angles(rays: np.ndarray, across: np.ndarray, third: np.ndarray) -> np.ndarray:
    """Angles (F, K) about the baseline of ``rays`` (F, K, 3)."""
    return np.arctan2(np.einsum("fkc,fc->fk", rays, third), np.einsum("fkc,fc->fk", rays, across))


def _angle(
    axis: np.ndarray, first: np.ndarray, second: np.ndarray
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Angle (...) between the half-planes from ``axis`` (3,) unit through ``first`` and ``second`` (..., 3), and its
    derivatives (..., 3) with respect to ``first``, ``second`` and ``axis``."""
    along_first, along_second = (first @ axis)[..., None], (second @ axis)[..., None]
    normal = np.cross(first, second)
    sine = normal @ axis
    cosine = (first * second).sum(axis=-1) - along_first[..., 0] * along_second[..., 0]
    weight_sine = (cosine / (sine**2 + cosine**2))[..., None]
    weight_cosine = (sine / (sine**2 + cosine**2))[..., None]
    return np.arctan2(sine, cosine), (
        weight_sine * np.cross(second, axis) - weight_cosine * (second - along_second * axis),
        weight_sine * np.cross(axis, first) - weight_cosine * (first - along_first * axis),
        weight_sine * normal + weight_cosine * (along_second * first + along_first * second),
    )


def _by_ray(view: _View, pixels: np.ndarray, by_ray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives with respect to the pixel (..., 2) and to the correction (..., 8), by that of the ray (..., 3)."""
    inverse = np.linalg.inv(view.camera.intrinsics)
    in_camera = by_ray @ view.camera.world_to_camera[:3, :3].T
    ray = np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=-1) @ inverse.T
    by_correction = np.zeros((*by_ray.shape[:-1], POSE))
    by_correction[..., :3] = np.cross(in_camera, ray) @ _left_jacobian(view.correction[:3])
    by_correction[..., 6] = -(in_camera[..., :2] * ray[..., :2]).sum(axis=-1)
    return in_camera @ inverse[:, :2], by_correction


def _rates(axis: np.ndarray, rays: np.ndarray, frames: np.ndarray, fps: float) -> np.ndarray:
    """Angular velocity (F, 2) [rad/s] of the planes through ``rays`` (F, 2, 3), NaN where unknown. Zero where no
    neighbouring frame is known."""
    step = _angle(axis, rays[:-1], rays[1:])[0] * fps
    step[np.diff(frames) != 1] = np.nan
    none = np.full((1, 2), np.nan)
    both = np.stack([np.concatenate([none, step]), np.concatenate([step, none])])
    known = np.isfinite(both)
    return np.where(known, both, 0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)


def _left_jacobian(vector: np.ndarray) -> np.ndarray:
    """(3, 3): exp(vector + d) = exp(J d) exp(vector) to first order, of rotations."""
    angle, k = float(np.linalg.norm(vector)), cross_matrix(vector)
    if angle < 1e-6:
        return np.eye(3) + k / 2
    return np.eye(3) + (1 - np.cos(angle)) / angle**2 * k + (angle - np.sin(angle)) / angle**3 * k @ k


def world_rays(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Directions (..., 3) in the world, not normalized, of ``pixels`` (..., 2)."""
    homogeneous = np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=-1)
    return homogeneous @ np.linalg.inv(camera.intrinsics).T @ camera.world_to_camera[:3, :3]


def _hull(points: np.ndarray) -> np.ndarray:
    return cv2.convexHull(points.astype(np.float32))[:, 0].astype(np.float64)


def _padded(polygons: list[list[np.ndarray | None]]) -> np.ndarray:
    longest = max((len(p) for row in polygons for p in row if p is not None), default=0)
    out = np.full((len(polygons), len(polygons[0]) if polygons else 0, longest, 2), np.nan)
    for row, filled in zip(polygons, out, strict=True):
        for polygon, target in zip(row, filled, strict=True):
            if polygon is not None:
                target[: len(polygon)], target[len(polygon) :] = polygon, polygon[0]
    return out
