"""Where the object is, from its outlines alone: nothing is carved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from masiv.calibration.frontier import Outlines, world_rays
from masiv.scene.camera import Camera

PER_OUTLINE = 8
"""Points of an outline: they say how far a correction of a camera moves the object in its picture."""


@dataclass(frozen=True)
class OutlinePoints:
    """points (P, 3) [m]: vertices of outlines, as deep as the object's centre; velocities (P, 3) [m/s]: the centre's.

    pivot (3,) [m]: their mean.
    """

    pivot: np.ndarray
    points: np.ndarray
    velocities: np.ndarray


def ray_centres(cameras: Sequence[Camera], outlines: Outlines) -> tuple[np.ndarray, np.ndarray]:
    """Index (K,) of the frames that two of V cameras show, and the object's centre (K, 3) [m] in them: the point
    nearest to the rays through the middles of the outlines."""
    if not outlines.hulls.size:
        return np.zeros(0, int), np.zeros((0, 3))
    rays = [world_rays(camera, hulls) for camera, hulls in zip(cameras, outlines.hulls, strict=True)]
    middles = _unit(np.stack(rays).mean(axis=2))
    seen = np.asarray(np.isfinite(middles).all(axis=-1))
    frames = np.flatnonzero(seen.sum(axis=0) >= 2)
    along = np.where(seen[..., None], middles, 0)[:, frames]
    across = seen[:, frames, None, None] * (np.eye(3) - along[..., :, None] * along[..., None, :])
    total = np.einsum("vfij,vj->fi", across, np.stack([camera.centre for camera in cameras]))
    return frames, (np.linalg.pinv(across.sum(axis=0)) @ total[..., None])[..., 0]


def outline_points(cameras: Sequence[Camera], outlines: Outlines, fps: float) -> OutlinePoints | None:
    """Of V cameras, about their ``ray_centres``; None if no frame has one."""
    frames, centres = ray_centres(cameras, outlines)
    if not len(frames):
        return None
    velocities = np.zeros_like(centres)
    if len(frames) > 1:
        velocities = np.gradient(centres, outlines.frames[frames] / fps, axis=0)
    points, moving = [], []
    for camera, hulls in zip(cameras, outlines.hulls, strict=True):
        chosen = np.linspace(0, hulls.shape[1], PER_OUTLINE, endpoint=False).astype(int)
        ray = _unit(world_rays(camera, hulls[np.ix_(frames, chosen)]))
        depth = ((centres - camera.centre)[:, None] * ray).sum(axis=-1, keepdims=True)
        found = camera.centre + depth * ray
        known = np.isfinite(found).all(axis=-1)
        points.append(found[known])
        moving.append(np.broadcast_to(velocities[:, None], found.shape)[known])
    on = np.concatenate(points)
    return OutlinePoints(on.mean(axis=0), on, np.concatenate(moving))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
