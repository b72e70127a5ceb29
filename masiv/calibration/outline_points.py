"""Where the object is, from its outlines alone: nothing is carved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from masiv.calibration.frontier import Outlines, world_rays
from masiv.calibration.tangency import Outline
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


def area_middles(cameras: Sequence[Camera], outlines: Sequence[Sequence[Outline | None]]) -> np.ndarray:
    """Unit rays (V, F, 3) through the centroids of the areas of V lists of F outlines, NaN where there is none."""
    middles = np.full((len(cameras), len(outlines[0]), 2), np.nan)
    for row, seen in zip(middles, outlines, strict=True):
        for middle, one in zip(row, seen, strict=True):
            if one is not None:
                moments = cv2.moments(one.hull.astype(np.float32))
                if moments["m00"] > 0:
                    middle[:] = moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]
    return np.stack([_unit(world_rays(camera, row)) for camera, row in zip(cameras, middles, strict=True)])


def ray_centres(cameras: Sequence[Camera], middles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index (K,) of the frames that two of V cameras show, and the point (K, 3) [m] nearest to the unit rays
    ``middles`` (V, F, 3) in them; NaN where a camera shows nothing."""
    seen = np.asarray(np.isfinite(middles).all(axis=-1))
    frames = np.flatnonzero(seen.sum(axis=0) >= 2)
    along = np.where(seen[..., None], middles, 0)[:, frames]
    across = seen[:, frames, None, None] * (np.eye(3) - along[..., :, None] * along[..., None, :])
    total = np.einsum("vfij,vj->fi", across, np.stack([camera.centre for camera in cameras]))
    return frames, (np.linalg.pinv(across.sum(axis=0)) @ total[..., None])[..., 0]


def outline_points(cameras: Sequence[Camera], outlines: Outlines, fps: float) -> OutlinePoints | None:
    """Of V cameras. The centre at a frame is the point nearest to the rays through the middles of the outlines; None if
    no frame has two."""
    if not outlines.hulls.size:
        return None
    rays = [world_rays(camera, hulls) for camera, hulls in zip(cameras, outlines.hulls, strict=True)]
    frames, centres = ray_centres(cameras, _unit(np.stack(rays).mean(axis=2)))
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
