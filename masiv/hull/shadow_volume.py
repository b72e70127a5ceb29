"""Remove the part of a visual hull that no camera can see, above a body that lies on the ground.

A visual hull is the largest shape that the silhouettes allow (Laurentini 1994). If all cameras look down on a flat
body, the hull is the body and a cone of shadow volume above it. The volume of the body is known from the first frame,
so the surplus is shadow volume. A heavy body that does not hold its shape lies low: the highest voxels are removed.
"""

from __future__ import annotations

import numpy as np

from masiv.hull.carve import VisualHull, surface_of
from masiv.hull.silhouette import Silhouette, silhouettes
from masiv.scene.scene import Scene

MAX_VOLUME_RATIO = 1.1
"""Hulls of one body in two poses differ by about this factor. A larger hull contains shadow volume."""
_CONTACT_TOLERANCE = 2.0
"""A hull touches the ground if it is at most this far above it [voxels]: the ground's height is uncertain."""


def remove_shadow_volume(
    scene: Scene, frame: int, hull: VisualHull, volume: float, views: tuple[Silhouette, ...] | None = None
) -> VisualHull:
    """``hull`` of ``frame`` without its highest voxels, so that ``MAX_VOLUME_RATIO`` times ``volume`` [m³] is left.

    volume: of the hull at frame 0. The hull is returned unchanged if it is not larger than that, if it does not touch
    the ground, and if the scene has no ground or gravity does not point towards it. views: ``silhouettes`` of the
    frame, if they are at hand.
    """
    ground = scene.ground
    if ground is None or scene.gravity @ ground.normal >= 0 or hull.volume <= MAX_VOLUME_RATIO * volume:
        return hull
    if (hull.points @ ground.normal).min() - ground.height > _CONTACT_TOLERANCE * hull.spacing:
        return hull
    if views is None:
        views = silhouettes(scene, frame, hull.resolution)
    kept = keep_lowest_voxels(hull.points, hull.spacing, views, ground.normal, MAX_VOLUME_RATIO * volume)
    points = hull.points[kept]
    index = np.rint((points - points.min(axis=0)) / hull.spacing).astype(int)
    occupied = np.zeros(index.max(axis=0) + 1, bool)
    occupied[tuple(index.T)] = True
    return VisualHull(points, hull.spacing, surface_of(occupied)[tuple(index.T)])


def keep_lowest_voxels(
    points: np.ndarray, spacing: float, views: tuple[Silhouette, ...], up: np.ndarray, volume: float
) -> np.ndarray:
    """Which voxels of a hull remain, (M,) bool, if the highest are removed until ``volume`` [m³] is left.

    points (M, 3) [m, world]: centres of voxels with side ``spacing`` [m]; up (3,) unit vector. A voxel is removed only
    if in every view another voxel covers its pixels, so each silhouette stays covered, and the volume that is left can
    be larger than ``volume``.
    """
    surplus = len(points) - max(1, int(volume / spacing**3))
    kept = np.ones(len(points), bool)
    if surplus <= 0:
        return kept
    cells = np.stack([_pixel_cells(view, points, spacing) for view in views], axis=1)
    # One row of counters for all views. A voxel that a view does not show has cell -1 there.
    offset = np.concatenate([[0], np.cumsum(cells.max(axis=0) + 1)[:-1]])
    cells = np.where(cells >= 0, cells + offset, -1)
    cover = np.bincount(cells[cells >= 0], minlength=int(cells.max()) + 2)
    cover[-1] = np.iinfo(np.int64).max
    for voxel in np.argsort(-(points @ up), kind="stable"):
        covered = cells[voxel]
        if cover[covered].min() > 1:
            cover[covered] -= 1
            kept[voxel] = False
            surplus -= 1
            if surplus == 0:
                break
    return kept


def _pixel_cells(view: Silhouette, points: np.ndarray, spacing: float) -> np.ndarray:
    """Index (M,) of the square of pixels that each voxel covers in ``view``, -1 if the view does not show the voxel.

    A square is about as wide as the image of a voxel and at least one pixel: smaller ones would leave gaps.
    """
    pixels, depth = view.project(points)
    visible = view.distances(points)[2]
    if not visible.any():
        return np.full(len(points), -1)
    side = max(1.0, spacing * view.camera.intrinsics[0, 0] / float(np.median(depth[visible])))
    column, row = np.floor(np.where(visible[:, None], pixels, 0.0).T / side).astype(int)
    return np.where(visible, row * (column.max() + 1) + column, -1)
