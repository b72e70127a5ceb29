"""The mean velocity of the object, for silhouettes that show other times than the frame's: rolling shutter, clock."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from masiv.hull.carve import visual_hull
from masiv.scene.gaps import interpolated
from masiv.scene.scene import Scene

_RESOLUTION = 24
"""Voxels along the longest side of the hulls whose centroids give a first estimate of the velocity."""


def with_velocities(scene: Scene, positions: np.ndarray | None = None) -> Scene:
    """``scene`` with the mean velocity of the object at each frame, if a camera needs it.

    positions (T, 3) [m]: of the object's centre at the T frames; None: centroids of hulls that take all pixels at the
    frame's time.
    The velocity at a frame is the central difference. Raises MasivError if a hull is empty.
    """
    if not any(scene.shows_other_times(view) for view in scene.views):
        return scene
    if positions is None:
        hulls = [visual_hull(scene, frame, resolution=_RESOLUTION) for frame in scene.observed_frames]
        centroids = np.stack([hull.points.mean(axis=0) for hull in hulls])
        positions = interpolated(scene.observed_frames, centroids, scene.frame_count)
    return replace(scene, velocities=np.gradient(positions, 1 / scene.fps, axis=0))
