"""Carving by votes: a view that contradicts several others does not remove a part of the object.

In a visual hull (Laurentini 1994) each view has a veto, so one pixel that is missing from one mask removes all voxels
behind it. Here a voxel that a single view denies is kept if other views need it: without it, pixels well inside of
their masks would show no part of the hull. This is shape from inconsistent silhouettes (Landabaso, Pardàs & Casas
2008), decided voxel by voxel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from masiv.hull.silhouette import Silhouette
from masiv.scene.scene import Ground

FEWEST_VIEWS = 5
"""Fewer views have a veto each: with four, three others seldom see enough of a part to need it."""
_VETO = 0.5
"""Confidence of the views against a voxel, summed, that removes it from the hull."""
_LARGEST_MINORITY = 1.5
"""The same for a voxel that other views may need: that of one view, and of doubts of others."""
_INSIDE = 1.5
"""A pixel counts as well inside of its mask at this distance from the edge [pixels]."""
_NEEDED_BY = 2.0
"""Views that need a voxel for each view that denies it."""


@dataclass(frozen=True)
class Votes:
    """What each of V views says of N voxels.

    denied (N, V) float32: confidence of a view that shows the voxel outside of its mask, else 0. cells (N, V): number
    of the square of pixels that the voxel covers, -1 if the view does not show it. sides (V,): of these squares
    [pixels]. allowed (N,) bool: shown by enough views and above the ground.
    """

    denied: np.ndarray
    cells: np.ndarray
    sides: tuple[int, ...]
    allowed: np.ndarray

    def hull(self) -> np.ndarray:
        """Voxels (N,) bool that no view removes."""
        return self.allowed & (self.denied.sum(axis=1) < _VETO)


def vote(
    views: tuple[Silhouette, ...],
    points: np.ndarray,
    tolerance: float,
    ground: Ground | None,
    spacing: float,
    *,
    fewest_views: int = 2,
) -> Votes:
    """The votes of ``views`` on voxels with centres ``points`` (N, 3) [m] and side ``spacing`` [m].

    A view denies a voxel whose centre is more than ``tolerance`` [m] outside of its mask. A voxel is allowed if
    ``fewest_views`` and half of the views show it.
    """
    denied = np.zeros((len(points), len(views)), np.float32)
    cells = np.full((len(points), len(views)), -1, np.int64)
    shown = np.zeros(len(points), np.int32)
    sides = []
    for k, view in enumerate(views):
        distance, inside_image, visible = view.distances(points)
        shown += inside_image
        pixels, depth = view.project(points[visible])
        columns, rows = np.floor(pixels).astype(np.int64).T
        denied[visible, k] = (distance[visible] > tolerance) * view.confidence[rows, columns]
        side = _cell_side(view, depth, spacing)
        cells[visible, k] = rows // side * _columns(view, side) + columns // side
        sides.append(side)
    allowed = shown >= max(fewest_views, len(views) // 2)
    if ground is not None:
        allowed &= points @ ground.normal >= ground.height - 0.5 * tolerance
    return Votes(denied, cells, tuple(sides), allowed)


def consensus(views: tuple[Silhouette, ...], votes: Votes) -> np.ndarray:
    """The hull (N,) bool with the voxels that one view denies and at least two others need."""
    kept = votes.hull()
    if len(views) < FEWEST_VIEWS or not kept.any():
        return kept
    denied = votes.denied.sum(axis=1)
    candidates = np.flatnonzero(votes.allowed & ~kept & (denied < _LARGEST_MINORITY))
    if len(candidates) == 0:
        return kept
    needed = np.zeros(len(candidates))
    for k, view in enumerate(views):
        uncovered = _cells_inside(view, votes.sides[k])
        covering = votes.cells[kept, k]
        uncovered[covering[covering >= 0]] = False
        cell = votes.cells[candidates, k]
        needed += (cell >= 0) & uncovered[np.maximum(cell, 0)] & (votes.denied[candidates, k] == 0)
    kept[candidates[needed >= _NEEDED_BY * denied[candidates]]] = True
    return kept


def _cell_side(view: Silhouette, depth: np.ndarray, spacing: float) -> int:
    """Side [pixels] of squares that neighbouring voxels at ``depth`` [m] cover without gaps."""
    if len(depth) == 0:
        return 1
    return max(1, int(np.ceil(1.5 * spacing * view.camera.intrinsics[0, 0] / float(np.median(depth)))))


def _columns(view: Silhouette, side: int) -> int:
    return view.distance.shape[1] // side + 1


def _cells_inside(view: Silhouette, side: int) -> np.ndarray:
    """Which cells contain only pixels well inside of the mask, flat bool."""
    height, width = view.distance.shape
    rows, columns = height // side + 1, _columns(view, side)
    padded = np.full((rows * side, columns * side), np.inf, np.float32)
    padded[:height, :width] = np.where(view.valid, view.distance, np.inf)
    return (padded.reshape(rows, side, columns, side).max(axis=(1, 3)) <= -_INSIDE).ravel()
