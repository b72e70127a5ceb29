"""How much larger than the object a visual hull is, for given cameras: a prior for the volume, with its uncertainty.

A hull contains the object. By how much it is larger depends on the cameras, and on a shape that is not known. So shapes
are drawn at random, carved by silhouettes in the scene's own cameras, and compared with their hulls. A body whose
volume is constant bounds it in each frame: the smallest hull of the recording is nearest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from masiv.hull.carve import VisualHull
from masiv.hull.silhouette import Silhouette, silhouette
from masiv.hull.votes import consensus, vote
from masiv.scene.scene import Scene

_SHAPES = 16
_RESOLUTION = 32
"""Voxels along the box of a random shape, whose longest half-axis is one in a box of half-side 1.3."""
_HALF_SIDE = 1.3
_SAMPLES = 30000
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
        """Two standard deviations below the median [m³]: a smaller volume is improbable (2.3 %)."""
        return self.volume * float(np.exp(-2 * self.log_sd))


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
    rng = np.random.default_rng(seed)
    axis = ((np.arange(_RESOLUTION) + 0.5) / _RESOLUTION * 2 - 1) * _HALF_SIDE
    unit = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    voxels, side = centre + half_extent * unit, 2 * _HALF_SIDE / _RESOLUTION * half_extent
    found = []
    while len(found) < _SHAPES:
        shape = random_shape(rng)
        samples = rng.uniform(-_HALF_SIDE, _HALF_SIDE, (_SAMPLES, 3))
        inside = shape(samples)
        if inside.mean() < _MIN_SHAPE:
            continue
        solid = centre + half_extent * samples[inside]
        views = tuple(_silhouette_of(scene, view, solid) for view in scene.views)
        hull = consensus(views, vote(views, voxels, 0.25 * spacing, None, side))
        found.append(hull.mean() / inside.mean())
    return np.array(found)


def random_shape(rng: np.random.Generator) -> Shape:
    """An ellipsoid, a box, a union of three balls or a bent rod, turned at random: points (N, 3) -> inside (N,)."""
    kind, turn = rng.integers(4), Rotation.random(rng=rng).as_matrix()
    axes = rng.uniform(0.35, 1.0, 3)
    axes /= axes.max()
    if kind == 0:
        return lambda points: ((points @ turn / axes) ** 2).sum(axis=1) < 1
    if kind == 1:
        return lambda points: (np.abs(points @ turn) / axes < 0.8).all(axis=1)
    if kind == 2:
        centres, radii = rng.normal(0, 0.4, (3, 3)), rng.uniform(0.3, 0.55, 3)
        return lambda points: (np.linalg.norm(points[:, None] - centres, axis=2) < radii).any(axis=1)
    ends = np.clip(rng.normal(0, 0.5, (3, 3)), -0.9, 0.9)
    return lambda points: np.minimum(*(_to_segment(points, ends[i], ends[i + 1]) for i in (0, 1))) < 0.3


def _to_segment(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    along = end - start
    share = np.clip((points - start) @ along / (along @ along), 0, 1)
    return np.linalg.norm(points - start - share[:, None] * along, axis=1)


def _silhouette_of(scene: Scene, view: int, solid: np.ndarray) -> Silhouette:
    """The silhouette of a solid, from samples of it: their pixels, with the gaps between samples closed."""
    camera = scene.cameras[view]
    pixels, depth = camera.project(solid)
    columns, rows = np.floor(pixels[depth > 0]).astype(int).T
    seen = (rows >= 0) & (rows < camera.height) & (columns >= 0) & (columns < camera.width)
    mask = np.zeros((camera.height, camera.width), np.uint8)
    mask[rows[seen], columns[seen]] = 1
    # The mean distance of neighbouring samples in the picture: a mask of A pixels holds n samples.
    gap = int(np.ceil(2 * np.sqrt(max(_area(mask), 1.0) / max(len(rows), 1)))) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * gap + 1, 2 * gap + 1))
    closed = cv2.morphologyEx(
        cv2.copyMakeBorder(mask, gap, gap, gap, gap, cv2.BORDER_CONSTANT), cv2.MORPH_CLOSE, kernel
    )
    mask = closed[gap:-gap, gap:-gap]
    return silhouette(view, camera, mask.astype(np.float32), np.ones(mask.shape, bool))


def _area(mask: np.ndarray) -> float:
    """Pixels of the silhouette: of the box of ``mask``, at most."""
    rows, columns = np.nonzero(mask)
    return 0.0 if len(rows) == 0 else float((np.ptp(rows) + 1) * (np.ptp(columns) + 1))
