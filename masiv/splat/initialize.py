"""Initial state of the fit: Gaussians on the surface of the first frame's hull, and the motion of the hulls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from masiv.errors import MasivError
from masiv.hull.carve import VisualHull, visual_hull
from masiv.hull.shadow_volume import remove_shadow_volume
from masiv.hull.velocity import with_velocities
from masiv.scene.gaps import interpolated
from masiv.scene.scene import Scene


@dataclass(frozen=True)
class InitialGaussians:
    """means (N, 3) [m]; scale [m]: standard deviation of all; colours (N, 3) in [0, 1].

    centre (3,) and half_extent [m]: of the first hull. base_motion (T, 3) [m]: centroids of the hulls relative to frame
    0, interpolated at frames without a picture. hulls: of the other ``frames``, without shadow volume.
    """

    means: np.ndarray
    scale: float
    colours: np.ndarray
    centre: np.ndarray
    half_extent: float
    base_motion: np.ndarray
    hulls: tuple[VisualHull, ...]
    frames: tuple[int, ...]


def initial_gaussians(scene: Scene, count: int, resolution: int, rng: np.random.Generator) -> InitialGaussians:
    """At most ``count`` Gaussians on the first visual hull, which has ``resolution`` voxels along its longest side.

    Raises MasivError if a hull is empty or the first one is a single voxel.
    """
    scene = with_velocities(scene)
    hull = visual_hull(scene, 0, resolution=resolution)
    frames = scene.observed_frames
    later = ((frame, visual_hull(scene, frame, resolution=resolution)) for frame in frames[1:])
    hulls = (hull, *(remove_shadow_volume(scene, frame, h, hull.volume) for frame, h in later))
    centroids = interpolated(frames, np.stack([h.points.mean(axis=0) for h in hulls]), scene.frame_count)
    shell = hull.points[hull.surface]
    if len(shell) < 2:
        raise MasivError(
            f"the visual hull of frame 0 of {scene.path} is a single voxel: raise reconstruct.hull_resolution"
        )
    area = len(shell) * hull.spacing**2
    chosen = np.sort(rng.permutation(len(shell))[: min(count, len(shell))])
    means = shell[chosen] + rng.uniform(-0.25, 0.25, (len(chosen), 3)) * hull.spacing
    low, high = hull.points.min(axis=0), hull.points.max(axis=0)
    return InitialGaussians(
        means=means,
        scale=0.6 * float(np.sqrt(area / len(means))),
        colours=_colours(scene, hull, means),
        centre=(low + high) / 2,
        half_extent=float((high - low).max() / 2 + hull.spacing),
        base_motion=centroids - centroids[0],
        hulls=hulls,
        frames=frames,
    )


def _colours(scene: Scene, hull: VisualHull, means: np.ndarray) -> np.ndarray:
    """Mean colour (N, 3) of each point over the views of frame 0 that show it; grey if no view does.

    A view shows a point if it is at most two voxels behind the nearest point of the hull in its pixel.
    """
    total, weight = np.zeros((len(means), 3)), np.zeros(len(means))
    shell = hull.points[hull.surface]
    for view in scene.views:
        camera, picture = scene.cameras[view], scene.frame(view, 0)
        nearest = np.full((camera.height + 2, camera.width + 2), np.inf)
        row, column, depth = _pixels(camera, shell)
        for dy in (-1, 0, 1):
            for dx in (-1, 0, 1):
                target = (np.clip(row + dy, -1, camera.height) + 1, np.clip(column + dx, -1, camera.width) + 1)
                np.minimum.at(nearest, target, depth)
        row, column, depth = _pixels(camera, means)
        inside = (row >= 0) & (row < camera.height) & (column >= 0) & (column < camera.width) & (depth > 0)
        index = np.flatnonzero(inside)
        row, column = row[index], column[index]
        in_front = depth[index] <= nearest[row + 1, column + 1] + 2 * hull.spacing
        shown = picture.mask[row, column] * picture.valid[row, column] * in_front
        total[index] += shown[:, None] * picture.image[row, column] / 255
        weight[index] += shown
    return np.where(weight[:, None] > 0, total / np.maximum(weight, 1e-9)[:, None], 0.5)


def _pixels(camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    pixels, depth = camera.project(points)
    pixels = np.where((depth > 0)[:, None], pixels, -1.0)
    limit = [camera.width, camera.height]
    whole = np.clip(np.floor(pixels), -1, limit).astype(np.int64)
    return whole[:, 1], whole[:, 0], depth
