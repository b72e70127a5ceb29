"""The silhouette of particles against the masks (L_sil of MASIV, eq. 8)."""

from __future__ import annotations

import functools

import numpy as np
import torch
from scipy.optimize import brentq

from masiv.identify.problem import Problem
from masiv.scene.camera import Camera
from masiv.scene.scene import Scene
from masiv.splat.rasteriser import render

MARGIN = 6  # pixels around the mask's box
OPACITY = 0.9
SIZES = 0.1, 1.0
"""Standard deviations that a particle's blob may have, in particle spacings."""


def blob_size(problem: Problem) -> float:
    """Standard deviation [m] of a particle's blob at which the body covers, at frame 0, as many pixels as the masks.

    There the particles fill what the masks show. A size for all bodies is too large for most (a sphere's silhouette had
    a tenth too many pixels at half a spacing), and a law that is fitted to such silhouettes learns to shrink the body.
    """
    spacing = (problem.volume / problem.count) ** (1 / 3)
    points = _to_world(problem, problem.start)

    @functools.lru_cache
    def excess(size: float) -> float:
        with torch.no_grad():
            pictures = [_compared(problem.scene, view, 0, points, size * spacing) for view in problem.scene.views]
        return sum(float(difference.sum()) / max(area, 1.0) for difference, area in pictures)

    if excess(SIZES[0]) >= 0 or excess(SIZES[1]) <= 0:
        return spacing * min(SIZES, key=lambda size: abs(excess(size)))
    return spacing * float(brentq(excess, *SIZES, xtol=0.005))


def silhouette_errors(problem: Problem, positions: torch.Tensor, pictures: list[tuple[int, int]]) -> torch.Tensor:
    """Mean error of ``pictures`` (frame, view); positions (K, N, 3) [m, simulation frame] as ``Problem.run`` has
    them."""
    errors = [
        silhouette_error(
            problem.scene, view, frame, _to_world(problem, positions[frame * problem.samples - 1]), problem.blob_size
        )
        for frame, view in pictures
    ]
    return torch.stack(errors).mean()


def _to_world(problem: Problem, points: torch.Tensor) -> torch.Tensor:
    rotation = torch.as_tensor(problem.axes.rotation, dtype=torch.float32)
    translation = torch.as_tensor(problem.axes.translation, dtype=torch.float32)
    return (points - translation) @ rotation


def some_of_each(problem: Problem, frames: int, count: int = 1) -> list[tuple[int, int]]:
    """``count`` pictures (all, where there are fewer) of each of the first ``frames`` frames, the views in turn:
    (frame, view)."""
    views = problem.scene.views
    count = min(count, len(views))
    return [
        (frame, views[(frame + k * len(views) // count) % len(views)])
        for frame in range(1, frames + 1) for k in range(count)
    ]  # fmt: skip


def discrepancy(problem: Problem, positions: torch.Tensor) -> float:
    """What candidates are compared by: the geometrical objective [m], or, without one, the silhouettes [1]."""
    with torch.no_grad():
        if problem.config.geometry_loss == "none":
            frames = len(positions) // problem.samples
            return float(silhouette_errors(problem, positions, some_of_each(problem, frames)))
        return float(problem.geometry_error(positions))


def silhouette_error(scene: Scene, view: int, frame: int, points: torch.Tensor, size: float) -> torch.Tensor:
    """Mean |alpha - mask| around the mask of a picture, over the mask's area. points (N, 3) [m, world]; size [m]: see
    ``blob_size``."""
    difference, area = _compared(scene, view, frame, points, size)
    return difference.abs().sum() / max(area, 1.0)


def _compared(scene: Scene, view: int, frame: int, points: torch.Tensor, size: float) -> tuple[torch.Tensor, float]:
    """alpha - mask (H, W) around the mask of a picture, and the area of the mask [pixels]."""
    camera, mask, valid = _crop(scene, view, frame)
    count = len(points)
    sizes, opacities = torch.full((count,), size), torch.full((count,), OPACITY)
    picture = render(camera, points, sizes, opacities, torch.zeros(count, 3), torch.zeros(3))
    return (picture.alpha - mask) * valid, float((mask * valid).sum())


def _crop(scene: Scene, view: int, frame: int) -> tuple[Camera, torch.Tensor, torch.Tensor]:
    picture = scene.frame(view, frame)
    camera = scene.cameras[view]
    rows, columns = np.nonzero(picture.mask > 0.5)
    if len(rows) == 0:
        return camera, torch.as_tensor(picture.mask), torch.as_tensor(picture.valid)
    y0, y1 = max(rows.min() - MARGIN, 0), min(rows.max() + MARGIN + 1, camera.height)
    x0, x1 = max(columns.min() - MARGIN, 0), min(columns.max() + MARGIN + 1, camera.width)
    window = slice(y0, y1), slice(x0, x1)
    crop = camera.cropped(int(x0), int(y0), int(x1 - x0), int(y1 - y0))
    return crop, torch.as_tensor(picture.mask[window]), torch.as_tensor(picture.valid[window])
