"""Which particles of a motion are in the pictures: what no two cameras show is not measured."""

from __future__ import annotations

import numpy as np

from masiv.scene.assemble import format_ranges
from masiv.scene.scene import Scene

MIN_VIEWS = 2
"""One camera leaves the distance open."""
MIN_SHARE = 0.01
"""Of the particles, from which on a frame is reported."""


def view_counts(scene: Scene, positions: np.ndarray) -> np.ndarray:
    """In the pictures of how many cameras that are not held out a particle at ``positions`` (T, Q, 3) [m, world] is,
    (T, Q) int. Particles behind others count as if they were seen."""
    counts = np.zeros(positions.shape[:2], int)
    for view in scene.views:
        camera = scene.cameras[view]
        for frame, points in enumerate(positions):
            if (view, frame) not in scene.missing:
                pixels, depth = camera.project(points.astype(np.float64))
                inside = (pixels >= 0).all(axis=1) & (pixels < (camera.width, camera.height)).all(axis=1)
                counts[frame] += inside & (depth > 0)
    return counts


def view_problems(scene: Scene, positions: np.ndarray) -> list[str]:
    """A sentence if particles at ``positions`` (T, Q, 3) [m, world] are in the pictures of too few cameras at some
    frames; none for point clouds, and none if a camera that measures depth sees them."""
    if scene.load_cloud is not None:
        return []
    needed = 1 if scene.depth_noise is not None else MIN_VIEWS
    lost = (view_counts(scene, positions) < needed).mean(axis=1)
    frames = np.flatnonzero(lost >= MIN_SHARE)
    if not len(frames):
        return []
    few = "no camera" if needed == 1 else "fewer than two cameras"
    return [
        f"frames {format_ranges(frames.tolist())}: up to {lost.max():.0%} of the particles are in the pictures of "
        f"{few}: their motion there is not measured; leave these frames out, or film from farther away"
    ]
