"""Epipolar tangency: two cameras see the same planes through their baseline touch the object.

A plane through the optical centres of two cameras that touches the object (at a frontier point) projects in both images
to a line that is tangent to the silhouette. This holds exactly for every shape, without correspondences, and fails if a
pose, a focal length, the time or a mask is wrong (Åström, Cipolla and Giblin, "Generalised epipolar constraints", IJCV
33, 1999; Hernández, Schmitt and Cipolla, "Silhouette coherence for camera calibration under circular motion", PAMI 29,
2007). The convex hull of a silhouette has the same outer tangents.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from masiv.scene.camera import Camera
from masiv.scene.frame_cache import Frame


@dataclass(frozen=True)
class Outline:
    """The silhouette of one picture.

    hull (K, 2) [pixels]: convex hull of the mask's 0.5 level, which is interpolated between pixel centres. cut (C, 2)
    [pixels]: pixels of the mask at the border of the image or beside pixels that are not valid. The object may continue
    there.
    """

    hull: np.ndarray
    cut: np.ndarray


def outline(frame: Frame) -> Outline | None:
    """The outline of the object in ``frame``; None if fewer than three points of its edge are visible."""
    mask = np.where(frame.valid, frame.mask, 0.0)
    on = mask > 0.5
    # Two pixels: the hidden side of an edge between a valid pixel and another one is not the object's edge.
    hidden = cv2.dilate((~frame.valid).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    hidden[[0, -1]] = True
    hidden[:, [0, -1]] = True
    rows, columns = np.nonzero(on & hidden)
    points = np.concatenate([_crossings(mask), _crossings(mask.T)[:, ::-1]]).astype(np.float32)
    if len(points) < 3:
        return None
    hull = cv2.convexHull(points)[:, 0].astype(np.float64)
    return Outline(hull, np.stack([columns, rows], axis=1) + 0.5)


def _crossings(mask: np.ndarray) -> np.ndarray:
    """Where the rows of ``mask`` (H, W) cross 0.5, shape (K, 2) as (x, y) [pixels]."""
    above = mask > 0.5
    row, column = np.nonzero(above[:, 1:] != above[:, :-1])
    left, right = mask[row, column], mask[row, column + 1]
    return np.stack([column + 0.5 + (0.5 - left) / (right - left), row + 0.5], axis=1)


def tangency_errors(camera: Camera, seen: Outline, other: Camera, other_seen: Outline) -> np.ndarray:
    """How far (2,) [pixels of ``camera``] ``seen`` reaches beyond the two planes that touch ``other_seen``.

    Zero if both cameras are right. NaN on a side where one of the two silhouettes is cut off, and on both sides if the
    baseline passes through a silhouette: then no plane through it touches the object.
    """
    baseline = other.centre - camera.centre
    length = float(np.linalg.norm(baseline))
    if length < 1e-9:
        return np.full(2, np.nan)
    rays = _rays(camera, seen.hull)
    along = baseline / length
    across = rays.mean(axis=0)
    across = across - (across @ along) * along
    if not np.linalg.norm(across) > 0:
        return np.full(2, np.nan)
    across /= np.linalg.norm(across)
    third = np.cross(along, across)
    ends = _interval(rays, _rays(camera, seen.cut), across, third)
    touched = _interval(_rays(other, other_seen.hull), _rays(other, other_seen.cut), across, third)
    errors = np.full(2, np.nan)
    homogeneous = np.column_stack([seen.hull, np.ones(len(seen.hull))])
    for side, sign in enumerate((-1.0, 1.0)):
        if np.isfinite(ends[side]) and np.isfinite(angle := touched[side]):
            normal = np.cos(angle) * third - np.sin(angle) * across
            line = np.linalg.solve(camera.intrinsics.T, camera.world_to_camera[:3, :3] @ normal)
            errors[side] = (sign * (homogeneous @ line)).max() / np.hypot(line[0], line[1])
    return errors


def _rays(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Directions (K, 3) in the world, not normalized, of ``pixels`` (K, 2)."""
    homogeneous = np.column_stack([pixels, np.ones(len(pixels))])
    return np.linalg.solve(camera.intrinsics, homogeneous.T).T @ camera.world_to_camera[:3, :3]


def _interval(rays: np.ndarray, cut: np.ndarray, across: np.ndarray, third: np.ndarray) -> np.ndarray:
    """Angles (2,) of the first and the last half-plane about the baseline that meet ``rays`` (K, 3); NaN if unknown.

    A half-plane has the same angle in both cameras: they differ by a translation along the baseline. cut (C, 3): rays
    at which the silhouette is cut off. What is hidden behind them most likely lies on their side of the middle.
    """
    angles = np.arctan2(rays @ third, rays @ across)
    first, last = float(angles.min()), float(angles.max())
    if last - first >= np.pi:
        return np.full(2, np.nan)
    ends = np.array([first, last])
    if len(cut):
        cut_angles, middle = np.arctan2(cut @ third, cut @ across), 0.5 * (first + last)
        ends[[cut_angles.min() < middle, cut_angles.max() > middle]] = np.nan
    return ends
