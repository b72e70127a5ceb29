"""A tighter hull of a body that has a mirror plane: the part of the hull whose mirror image is in the hull, too.

A body with a mirror plane is in its hull and in the mirror image of its hull, so it is in their intersection: each
camera carves as if there were another one in its mirror image. The plane is right only if the intersection still
explains the silhouettes, as the hull does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from masiv.hull.carve import VisualHull, surface_of
from masiv.hull.silhouette import Silhouette

_DIRECTIONS = 400
"""Normals that are tried first, evenly spread over half a sphere: 7° apart."""
_STARTS = 8
"""Of these, the best are improved."""
_SAMPLES = 4000
"""Voxels that measure the overlap in the search."""
_OUTLINE = 1.5
"""A pixel is well inside of its mask at this distance from the edge [pixels]: outlines are not more exact."""


@dataclass(frozen=True)
class MirrorPlane:
    """The plane {x : normal·x = offset}; normal (3,) unit, offset [m]."""

    normal: np.ndarray
    offset: float

    def __str__(self) -> str:
        x, y, z = self.normal
        return f"mirror plane ({x:.3f}, {y:.3f}, {z:.3f})·x = {self.offset:.4f} m"

    def mirrored(self, points: np.ndarray) -> np.ndarray:
        """Mirror images (N, 3) [m] of ``points`` (N, 3) [m]."""
        return points - 2 * (points @ self.normal - self.offset)[:, None] * self.normal


class _Lattice:
    """The voxels of a hull as an array; ``grown`` by one voxel, since the edges of hull and image are half a voxel off
    each."""

    def __init__(self, hull: VisualHull) -> None:
        self.low = hull.points.min(axis=0) - 2 * hull.spacing
        self.spacing = hull.spacing
        index = np.rint((hull.points - self.low) / self.spacing).astype(int)
        self.occupied = np.zeros(index.max(axis=0) + 3, bool)
        self.occupied[tuple(index.T)] = True
        self.grown = ndimage.binary_dilation(self.occupied)

    def contains(self, points: np.ndarray, *, grown: bool = False) -> np.ndarray:
        """Which ``points`` (N, 3) [m] are in a voxel of the hull, (N,) bool."""
        cells = self.grown if grown else self.occupied
        index = np.rint((points - self.low) / self.spacing).astype(int)
        inside = ((index >= 0) & (index < cells.shape)).all(axis=1)
        found = np.zeros(len(points), bool)
        found[inside] = cells[tuple(index[inside].T)]
        return found


def symmetric_hull(hull: VisualHull, plane: MirrorPlane) -> VisualHull:
    """The voxels of ``hull`` whose mirror image is in the hull or next to it."""
    lattice = _Lattice(hull)
    kept = hull.points[lattice.contains(plane.mirrored(hull.points), grown=True)]
    index = np.rint((kept - lattice.low) / hull.spacing).astype(int)
    occupied = np.zeros(lattice.occupied.shape, bool)
    occupied[tuple(index.T)] = True
    return VisualHull(kept, hull.spacing, surface_of(occupied)[tuple(index.T)])


def overlap(hull: VisualHull, plane: MirrorPlane) -> float:
    """Share of the hull's volume whose mirror image is in the hull."""
    return float(_Lattice(hull).contains(plane.mirrored(hull.points)).mean())


def mirror_plane(hull: VisualHull, normal: np.ndarray | None = None) -> MirrorPlane:
    """The plane about which ``hull`` overlaps most with its mirror image; with this ``normal`` (3,), if it is given."""
    lattice = _Lattice(hull)
    step = max(1, len(hull.points) // _SAMPLES)
    points = hull.points[::step]
    centre = hull.points.mean(axis=0)
    extent = float(np.linalg.norm(hull.points - centre, axis=1).max())

    def score(direction: np.ndarray, shift: float) -> float:
        plane = MirrorPlane(direction, float(direction @ centre) + shift)
        return float(lattice.contains(plane.mirrored(points)).mean())

    def best_shift(direction: np.ndarray, around: float, half_width: float) -> tuple[float, float]:
        """(overlap, shift) of the best of nine shifts [m]."""
        found, _, shift = max((score(direction, s), -abs(s), s) for s in around + half_width * np.linspace(-1, 1, 9))
        return found, shift

    if normal is not None:
        direction = np.asarray(normal, np.float64) / np.linalg.norm(normal)
        shift, width = 0.0, 0.25 * extent
        while width > 0.1 * hull.spacing:
            shift, width = best_shift(direction, shift, width)[1], 0.4 * width
        return MirrorPlane(direction, float(direction @ centre) + shift)
    tried = sorted(((*best_shift(d, 0.0, 0.1 * extent), d) for d in _half_sphere()), key=lambda t: -t[0])
    found = max((_improved(t, score, 0.12, 0.025 * extent, hull.spacing) for t in tried[:_STARTS]), key=lambda t: t[0])
    return MirrorPlane(found[2], float(found[2] @ centre) + found[1])


def _improved(start, score, angle: float, width: float, spacing: float):
    """(overlap, shift, normal) of a local maximum near ``start``; first steps ``angle`` [rad] and ``width`` [m]."""
    best = start
    while width > 0.1 * spacing:
        _, shift, normal = best
        across = np.linalg.svd(normal[None])[2][1:]
        near = [(shift + s * width, normal) for s in (-1, 1)]
        near += [(shift, _unit(normal + s * angle * axis)) for axis in across for s in (-1, 1)]
        better = max(((score(n, s), s, n) for s, n in near), key=lambda t: t[0])
        if better[0] > best[0]:
            best = better
        else:
            angle, width = angle / 2, width / 2
    return best


def _half_sphere() -> np.ndarray:
    """Unit vectors (_DIRECTIONS, 3), evenly spread over half a sphere (Fibonacci spiral)."""
    k = np.arange(_DIRECTIONS) + 0.5
    height, turn = 1 - k / _DIRECTIONS, np.pi * (1 + 5**0.5) * k
    across = np.sqrt(1 - height**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=1)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


def uncovered(views: Sequence[Silhouette], hull: VisualHull, tighter: VisualHull) -> dict[int, tuple[float, float]]:
    """By view: pixels that ``hull`` explains and ``tighter`` does not, and how many may be errors of the mask.

    Both are expected numbers of pixels well inside of the mask: of those that are lost, how many are on the object; and
    of all, how many are not on it, by the probabilities of the mask. A plane is contradicted where the first is larger.
    """
    found = {}
    for view in views:
        inside = view.valid & (view.distance <= -_OUTLINE)
        lost = inside & _drawn(view, hull) & ~_drawn(view, tighter)
        on_object = 0.5 * (1 + view.confidence)
        found[view.view] = float(on_object[lost].sum()), float((1 - on_object[inside]).sum())
    return found


def contradicting(views: Sequence[Silhouette], hull: VisualHull, tighter: VisualHull) -> list[int]:
    """Views whose silhouettes ``tighter`` does not explain as ``hull`` does; see ``uncovered``."""
    return [view for view, (lost, doubtful) in uncovered(views, hull, tighter).items() if lost > doubtful]


def _drawn(view: Silhouette, hull: VisualHull) -> np.ndarray:
    """The silhouette (H, W) bool of a hull, each voxel as a ball around it."""
    pixels, depth = view.project(hull.points)
    height, width = view.distance.shape
    columns, rows = np.floor(np.where(depth[:, None] > 0, pixels, -1)).astype(int).T
    seen = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    drawn = np.zeros((height, width), np.uint8)
    if not seen.any():
        return drawn > 0
    drawn[rows[seen], columns[seen]] = 1
    radius = np.sqrt(0.75) * hull.spacing * view.camera.intrinsics[0, 0] / float(np.median(depth[seen]))
    side = 2 * int(np.ceil(radius)) + 1
    return cv2.dilate(drawn, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))) > 0
