"""Visual hull: the volume that projects into every silhouette of a frame (Laurentini 1994)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from masiv.errors import MasivError
from masiv.hull.depth import DepthView, depth_views, seen_points
from masiv.hull.silhouette import Silhouette, silhouettes
from masiv.hull.votes import consensus, vote
from masiv.scene.scene import Ground, Scene

_COARSE = 24
_BOX_ROUNDS = 4


@dataclass(frozen=True)
class VisualHull:
    """Occupied voxels of a regular lattice.

    points (M, 3) float64 centres [m, world]; spacing [m]; surface (M,) bool, voxels with an empty 6-neighbour.
    """

    points: np.ndarray
    spacing: float
    surface: np.ndarray

    @property
    def volume(self) -> float:
        """Volume of the hull [m³]."""
        return len(self.points) * self.spacing**3

    @property
    def resolution(self) -> int:
        """Voxels along the longest side."""
        return round(float(np.ptp(self.points, axis=0).max()) / self.spacing) + 1


def visual_hull(
    scene: Scene, frame: int, *, resolution: int = 64, views: tuple[Silhouette, ...] | None = None
) -> VisualHull:
    """Carve the hull of the object at ``frame`` from the masks of all views that are not held out.

    The bounding box follows from the masks; its longest side gets ``resolution`` voxels. A voxel is kept if its centre
    is at most a quarter voxel outside of every mask that shows it (so that thin parts survive) and if it is inside the
    image of at least two views and of half of them. Measured depth removes what is in front of the surface; with it
    one view suffices, and the hidden side is a guess (``masiv.hull.depth``). views: ``silhouettes`` of the frame, if
    they are at hand. Raises MasivError if fewer than two masks show the object, fewer than one with depth, or no voxel
    is left.
    """
    if views is None:
        views = silhouettes(scene, frame, resolution)
    depths = depth_views(scene, frame, views)
    occupied_views = [v for v in views if (v.distance < 0).any()]
    if len(occupied_views) < 2 and (not depths or not occupied_views):
        raise MasivError(
            f"frame {frame} of {scene.path}: the object is in the mask of {len(occupied_views)} of {len(views)} views, "
            "a visual hull needs 2, or 1 with depth; check the masks of that frame"
        )
    grid = occupancy_grid(views, scene, frame, resolution, depths)
    occupied = occupancy(views, grid.points, 0.25 * grid.spacing, grid.spacing, scene.ground, depths)
    occupied = occupied.reshape(grid.counts)
    if not occupied.any():
        raise MasivError(_no_volume(views, occupied_views, scene, frame))
    return VisualHull(grid.points[occupied.ravel()], grid.spacing, surface_of(occupied)[occupied])


@dataclass(frozen=True)
class OccupancyGrid:
    """Voxels around the object: centres ``points`` (N, 3) [m] of ``counts`` (3,) voxels with side ``spacing`` [m]."""

    points: np.ndarray
    spacing: float
    counts: np.ndarray


def occupancy_grid(
    views: tuple[Silhouette, ...], scene: Scene, frame: int, resolution: int, depths: tuple[DepthView, ...] = ()
) -> OccupancyGrid:
    """The grid of the hull's bounding box, whose longest side has ``resolution`` voxels.

    Raises MasivError if the box is empty.
    """
    occupied_views = [view for view in views if (view.distance < 0).any()]
    lower, upper = _object_box(views, occupied_views, depths, scene.ground, frame, scene)
    spacing = float((upper - lower).max()) / resolution
    counts = np.maximum(np.ceil((upper - lower) / spacing - 1e-9).astype(int), 1)
    return OccupancyGrid(_cell_centres(lower, spacing, counts), spacing, counts)


def occupancy(
    views: tuple[Silhouette, ...],
    points: np.ndarray,
    tolerance: float,
    spacing: float,
    ground: Ground | None = None,
    depths: tuple[DepthView, ...] = (),
) -> np.ndarray:
    """Which voxels with centres ``points`` (N, 3) [m] and side ``spacing`` [m] belong to the hull, (N,) bool.

    A voxel is above the ground, inside the image of at least two views (one of those with depth) and of half of them,
    and at most ``tolerance`` [m] outside of every mask, except where the views outvote one of them: see
    ``masiv.hull.votes``. It is at most ``tolerance`` in front of what ``depths`` show.
    """
    votes = vote(views, points, tolerance, ground, spacing, fewest_views=1 if depths else 2)
    for depth in depths:
        empty = np.maximum(depth.in_front(points), depth.behind(points)) > tolerance
        votes = replace(votes, allowed=votes.allowed & ~empty)
    return consensus(views, votes)


def surface_of(occupied: np.ndarray) -> np.ndarray:
    """Which cells (I, J, K) of ``occupied`` have an empty one among their six neighbours; outside the box is empty."""
    return occupied & ~ndimage.binary_erosion(occupied)


def _object_box(views, seen, depths, ground, frame: int, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Corners (3,), (3,) [m] of the hull's bounding box, from coarse grids that shrink."""
    centre = _middle(seen, depths)
    radius = max(_radius_around(view, centre) for view in seen)
    lower, upper = centre - radius, centre + radius
    for _ in range(_BOX_ROUNDS):
        spacing = float((upper - lower).max()) / _COARSE
        counts = np.maximum(np.ceil((upper - lower) / spacing - 1e-9).astype(int), 1)
        grid = _cell_centres(lower, spacing, counts)
        # Half of a cell's diagonal: no cell that contains a part of the object is removed.
        kept = grid[occupancy(views, grid, 0.87 * spacing, spacing, ground, depths)]
        if len(kept) == 0:
            raise MasivError(_no_volume(views, seen, scene, frame))
        lower, upper = (
            np.maximum(lower, kept.min(axis=0) - 0.5 * spacing),
            np.minimum(upper, kept.max(axis=0) + 0.5 * spacing),
        )
    return lower, upper


def _cell_centres(lower: np.ndarray, spacing: float, counts: np.ndarray) -> np.ndarray:
    axes = [lower[k] + (np.arange(counts[k]) + 0.5) * spacing for k in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def nearest_to_rays(seen: list[Silhouette]) -> np.ndarray:
    """The point (3,) [m] with the least sum of squared distances to the rays through the centroids of the masks."""
    normal_matrix, right_side = np.zeros((3, 3)), np.zeros(3)
    for view in seen:
        rows, columns = np.nonzero(view.distance < 0)
        pixel = np.array([columns.mean() + 0.5, rows.mean() + 0.5, 1.0])
        direction = view.camera.world_to_camera[:3, :3].T @ np.linalg.solve(view.camera.intrinsics, pixel)
        direction /= np.linalg.norm(direction)
        across = np.eye(3) - np.outer(direction, direction)
        normal_matrix += across
        right_side += across @ view.camera.centre
    return np.linalg.lstsq(normal_matrix, right_side, rcond=None)[0]


def _middle(seen: list[Silhouette], depths: tuple[DepthView, ...]) -> np.ndarray:
    """A point (3,) [m] in the middle of the object: of its rays, or of its depth if one view alone shows it."""
    if len(seen) > 1:
        return nearest_to_rays(seen)
    points = seen_points(depths)
    return (points.min(axis=0) + points.max(axis=0)) / 2


def _radius_around(view: Silhouette, centre: np.ndarray) -> float:
    """Distance [m] from ``centre`` to the farthest mask pixel of this view, at the centre's depth."""
    pixel, depth = view.camera.project(centre[None])
    rows, columns = np.nonzero(view.distance < 0)
    reach = np.hypot(columns + 0.5 - pixel[0, 0], rows + 0.5 - pixel[0, 1]).max()
    return float((reach + 1.0) * abs(depth[0]) / min(view.camera.intrinsics[0, 0], view.camera.intrinsics[1, 1]))


def _no_volume(views, seen: list[Silhouette], scene: Scene, frame: int) -> str:
    """The error message. It names the view that contradicts the others most: without it the volume is largest."""
    centre = nearest_to_rays(seen)
    radius = max(_radius_around(view, centre) for view in seen)
    spacing = 2 * radius / _COARSE
    grid = _cell_centres(centre - radius, spacing, np.full(3, _COARSE))
    left = {
        view.view: int(
            occupancy(tuple(v for v in views if v is not view), grid, 0.5 * spacing, spacing, scene.ground).sum()
        )
        for view in views
    }
    worst = max(left, key=lambda view: left[view])
    hint = f" (view {worst} contradicts the others: look at its mask first)" if left[worst] > 0 else ""
    return (
        f"frame {frame} of {scene.path}: no volume is inside the masks of all {len(views)} views{hint}; "
        "check the masks of that frame, the camera poses and the ground plane"
    )
