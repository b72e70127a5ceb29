"""What silhouettes leave open, decided by weight: of the shapes with the known volume, the one that lies lowest.

A visual hull is the largest shape that the silhouettes allow (Laurentini 1994). Where all cameras look down on a flat
body, that is the body and a cone of shadow above it. Matter does not grow, and what is heavy and does not hold its
shape lies low: the surplus is taken from the top.
"""

from __future__ import annotations

import numpy as np

from masiv.hull.carve import VisualHull, surface_of
from masiv.hull.silhouette import Silhouette, silhouettes
from masiv.scene.scene import Scene

VOLUME_SLACK = 1.1
"""Hulls of one body in different poses differ by about this factor; a larger one holds what no camera sees."""
_REACH = 2.0
"""Voxels between a hull and the ground that still count as touching: the ground is not known better."""


def settled_hull(scene: Scene, frame: int, hull: VisualHull, volume: float) -> VisualHull:
    """``hull`` of ``frame`` without what it has grown by since its volume was ``volume`` [m³], highest voxels first.

    It keeps ``VOLUME_SLACK`` times that volume. Only what lies on the ground under gravity settles: a hull in flight,
    and any in a scene without a ground, is returned as it is, as is one that has not grown.
    """
    ground = scene.ground
    if ground is None or scene.gravity @ ground.normal >= 0 or hull.volume <= VOLUME_SLACK * volume:
        return hull
    if (hull.points @ ground.normal).min() - ground.height > _REACH * hull.spacing:
        return hull
    views = silhouettes(scene, frame)
    points = hull.points[settled(hull.points, hull.spacing, views, ground.normal, VOLUME_SLACK * volume)]
    index = np.rint((points - points.min(axis=0)) / hull.spacing).astype(int)
    occupied = np.zeros(index.max(axis=0) + 1, bool)
    occupied[tuple(index.T)] = True
    return VisualHull(points, hull.spacing, surface_of(occupied)[tuple(index.T)])


def settled(
    points: np.ndarray, spacing: float, views: tuple[Silhouette, ...], up: np.ndarray, volume: float
) -> np.ndarray:
    """Which voxels of a hull stay, (M,) bool, when it loses its highest ones until it has ``volume`` [m³].

    points (M, 3) [m, world], the centres of voxels of side ``spacing`` [m] that no view rules out; up (3,) unit. A
    voxel goes only where each view still sees another one in its place, so every silhouette stays covered; where
    that leaves nothing more to take, the volume stays larger. Nothing goes from a hull that is no larger.
    """
    surplus = len(points) - max(1, int(volume / spacing**3))
    stays = np.ones(len(points), bool)
    if surplus <= 0:
        return stays
    cells = np.stack([_cells(view, points, spacing) for view in views], axis=1)
    # One row of counters for all views; a voxel that a view does not judge is no matter of that view.
    offset = np.concatenate([[0], np.cumsum(cells.max(axis=0) + 1)[:-1]])
    cells = np.where(cells >= 0, cells + offset, -1)
    cover = np.bincount(cells[cells >= 0], minlength=int(cells.max()) + 2)
    cover[-1] = np.iinfo(np.int64).max
    for voxel in np.argsort(-(points @ up), kind="stable"):
        seen = cells[voxel]
        if cover[seen].min() > 1:
            cover[seen] -= 1
            stays[voxel] = False
            surplus -= 1
            if surplus == 0:
                break
    return stays


def _cells(view: Silhouette, points: np.ndarray, spacing: float) -> np.ndarray:
    """Number of the square of pixels (M,) that each voxel covers in a view, -1 where the view does not judge it.

    Squares are about as wide as a voxel's picture and at least a pixel: finer ones would have gaps between voxels.
    """
    pixels, depth = view.camera.project(points)
    judged = view.outside(points)[2]
    if not judged.any():
        return np.full(len(points), -1)
    side = max(1.0, spacing * view.camera.intrinsics[0, 0] / float(np.median(depth[judged])))
    column, row = np.floor(np.where(judged[:, None], pixels, 0.0).T / side).astype(int)
    return np.where(judged, row * (column.max() + 1) + column, -1)
