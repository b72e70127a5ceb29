"""How much larger than the object a visual hull is, for given cameras: a prior for the volume, with its uncertainty.

A hull contains the object. By how much it is larger depends on the cameras, and on a shape that is not known. So shapes
are drawn at random, carved by silhouettes in the scene's own cameras, and compared with their hulls. A body whose
volume is constant bounds it in each frame: the smallest hull of the recording is nearest.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from masiv.hull.carve import VisualHull
from masiv.hull.silhouette import Silhouette, silhouette
from masiv.hull.votes import consensus, vote
from masiv.scene.camera import Camera
from masiv.scene.scene import Scene

_SHAPES = 24
_RESOLUTION = 32
"""Voxels along the box of a random shape, whose longest half-axis is one in a box of half-side 1.3."""
_HALF_SIDE = 1.3
_SAMPLES = 50_000
"""Random points of the box, which tell the volume of a shape to a percent."""
_SILHOUETTE_PIXELS, _DEPTHS = 32, 48
"""Side of a silhouette, at most (a larger picture is reduced), and points along the ray of each of its pixels."""
_MIN_SHAPE = 0.01
"""Share of the box that a shape fills at least."""

Shape = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class VolumePrior:
    """Log-normal distribution of the object's volume: median ``volume`` [m³], standard deviation ``log_sd`` of its
    logarithm."""

    volume: float
    log_sd: float

    @property
    def lower(self) -> float:
        """One standard deviation below the median [m³]."""
        return self.volume * float(np.exp(-self.log_sd))


def volume_prior(scene: Scene, hulls: dict[int, VisualHull]) -> VolumePrior:
    """The volume of the object from the ``hulls`` of some frames, carved in the cameras of ``scene``."""
    frame = min(hulls, key=lambda k: hulls[k].volume)
    hull = hulls[frame]
    low, high = hull.points.min(axis=0), hull.points.max(axis=0)
    ratios = np.log(hull_ratios(scene, (low + high) / 2, float((high - low).max()) / 2, hull.spacing))
    return VolumePrior(hull.volume * float(np.exp(-ratios.mean())), float(ratios.std(ddof=1)))


def hull_ratios(scene: Scene, centre: np.ndarray, half_extent: float, spacing: float, *, seed: int = 0) -> np.ndarray:
    """Volumes of hulls over those of the random shapes in them, (K,).

    The shapes are at ``centre`` (3,) [m] with ``half_extent`` [m]. A hull has the tolerance of one whose voxels have
    side ``spacing`` [m].
    """
    rng, found = np.random.default_rng(seed), []
    while len(found) < _SHAPES:
        ratio = hull_ratio(random_shape(rng), scene, centre, half_extent, spacing, rng)
        if ratio is not None:
            found.append(ratio)
    return np.array(found)


def hull_ratio(
    shape: Shape, scene: Scene, centre: np.ndarray, half_extent: float, spacing: float, rng: np.random.Generator
) -> float | None:
    """Volume of the hull of one ``shape`` over its own; None if it fills less than ``_MIN_SHAPE`` of the box.

    A pixel is in its silhouette if the ray through its centre meets it. Other arguments as of ``hull_ratios``.
    """
    axis = ((np.arange(_RESOLUTION) + 0.5) / _RESOLUTION * 2 - 1) * _HALF_SIDE
    unit = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    voxels, side = centre + half_extent * unit, 2 * _HALF_SIDE / _RESOLUTION * half_extent
    samples = rng.uniform(-_HALF_SIDE, _HALF_SIDE, (_SAMPLES, 3))
    inside = shape(samples)
    if inside.mean() < _MIN_SHAPE:
        return None
    cameras = [(view, _reduced(scene.cameras[view], centre, half_extent)) for view in scene.views]
    views = tuple(_silhouette_of(view, camera, shape, centre, half_extent) for view, camera in cameras)
    hull = consensus(views, vote(views, voxels, 0.25 * spacing, None, side))
    return float(hull.mean() / inside.mean())


def random_shape(rng: np.random.Generator) -> Shape:
    """An ellipsoid, a box, a union of three balls, a bent rod, a torus or joined bars, turned at random: points (N, 3)
    -> inside (N,). Convex, branched and with a hole, so that hulls are larger than shapes by little and by much."""
    kind, turn = rng.integers(6), Rotation.random(rng=rng).as_matrix()
    axes = rng.uniform(0.35, 1.0, 3)
    axes /= axes.max()
    if kind == 0:
        return lambda points: ((points @ turn / axes) ** 2).sum(axis=1) < 1
    if kind == 1:
        return lambda points: (np.abs(points @ turn) / axes < 0.8).all(axis=1)
    if kind == 2:
        centres, radii = rng.normal(0, 0.4, (3, 3)), rng.uniform(0.3, 0.55, 3)
        return lambda points: (np.linalg.norm(points[:, None] - centres, axis=2) < radii).any(axis=1)
    if kind == 3:
        ends = np.clip(rng.normal(0, 0.5, (3, 3)), -0.9, 0.9)
        return lambda points: np.minimum(*(_to_segment(points, ends[i], ends[i + 1]) for i in (0, 1))) < 0.3
    if kind == 4:
        tube = rng.uniform(0.15, 0.35)
        return lambda points: _to_circle(points @ turn, 1 - tube) < tube
    return _joined_bars(rng, turn)


def _joined_bars(rng: np.random.Generator, turn: np.ndarray) -> Shape:
    """Three to five bars along the axes of ``turn`` (3, 3), each through a point of the one before: letters, crosses,
    tables."""
    centre, boxes = np.zeros(3), []
    for _ in range(rng.integers(3, 6)):
        half = rng.uniform(0.12, 0.3, 3)
        along = rng.integers(3)
        half[along] = rng.uniform(0.5, 0.9)
        boxes.append((centre, half))
        centre = centre.copy()
        centre[along] += rng.uniform(-1, 1) * half[along]
    low = np.min([c - h for c, h in boxes], axis=0)
    high = np.max([c + h for c, h in boxes], axis=0)
    middle, scale = (low + high) / 2, float((high - low).max()) / 2

    def inside(points: np.ndarray) -> np.ndarray:
        local = scale * (points @ turn) + middle
        return np.any([(np.abs(local - c) < h).all(axis=1) for c, h in boxes], axis=0)

    return inside


def _to_circle(points: np.ndarray, radius: float) -> np.ndarray:
    """Distances (N,) to a circle of ``radius`` about the third axis."""
    return np.hypot(np.hypot(points[:, 0], points[:, 1]) - radius, points[:, 2])


def _to_segment(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    along = end - start
    share = np.clip((points - start) @ along / (along @ along), 0, 1)
    return np.linalg.norm(points - start - share[:, None] * along, axis=1)


def _reduced(camera: Camera, centre: np.ndarray, half_extent: float) -> Camera:
    """``camera`` with larger pixels, if a ball of radius ``half_extent`` [m] at ``centre`` (3,) has too many."""
    depth = float(camera.project(centre[None])[1][0])
    side = 2 * half_extent * camera.intrinsics[0, 0] / max(depth, 1e-6)
    factor = max(1, math.ceil(side / _SILHOUETTE_PIXELS))
    intrinsics = camera.intrinsics.copy()
    intrinsics[:2] /= factor
    return replace(camera, width=-(-camera.width // factor), height=-(-camera.height // factor), intrinsics=intrinsics)


def _silhouette_of(view: int, camera: Camera, shape: Shape, centre: np.ndarray, half_extent: float) -> Silhouette:
    """The silhouette of ``shape`` at ``centre`` (3,) with ``half_extent`` [m]."""
    rows, columns = np.mgrid[: camera.height, : camera.width]
    pixels = np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5, np.ones(rows.size)], axis=1)
    rays = pixels @ np.linalg.inv(camera.intrinsics).T @ camera.world_to_camera[:3, :3]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    to_centre, reach = centre - camera.centre, np.sqrt(3) * _HALF_SIDE * half_extent
    nearest = rays @ to_centre
    candidates = np.flatnonzero((to_centre @ to_centre - nearest**2 < reach**2) & (nearest > 0))
    depths = nearest[candidates, None] + reach * np.linspace(-1, 1, _DEPTHS)
    points = (depths[..., None] * rays[candidates, None] - to_centre) / half_extent
    mask = np.zeros(rows.size, np.float32)
    mask[candidates] = shape(points.reshape(-1, 3)).reshape(depths.shape).any(axis=1)
    mask = mask.reshape(rows.shape)
    return silhouette(view, camera, mask, np.ones(mask.shape, bool))
