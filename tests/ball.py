"""A ball that stands in the air, filled evenly with particles, as the image terms of a fit compare it."""

from __future__ import annotations

import numpy as np
from cube import Seen
from ring_scene import ring, spheres_scene
from small import SMALL

from masiv.continuum.fill import DensityField, even_points
from masiv.identification.losses.images import ImageTerms
from masiv.models.filmed_body import FilmedBody
from masiv.scene.scene import Scene

CENTRE, RADIUS, FRAMES = np.array([0.0, 0.45, 0.0]), 0.25, 2


def ball_scene() -> Scene:
    cameras = ring(size=128, focal=200.0)
    return spheres_scene(lambda frame: [(CENTRE, RADIUS)], frame_count=FRAMES, cameras=cameras)


def ball_terms(scene: Scene, spacing: float) -> ImageTerms:
    """Particles of ``spacing`` [m]."""
    step = 0.01
    axis = np.arange(-0.3, 0.3 + step, step)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    inside = (np.linalg.norm(grid, axis=-1) < RADIUS).astype(np.float32)
    points = even_points(DensityField(inside, CENTRE - 0.3, step), spacing)
    still = np.repeat(points[None], FRAMES, axis=0).astype(np.float32)
    seen = Seen(still, np.arange(FRAMES) / scene.fps, len(points) * spacing**3)
    return ImageTerms(FilmedBody(scene, seen, SMALL, samples=2), with_colors=True)
