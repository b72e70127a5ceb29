"""The silhouette of particles against the masks (L_sil of MASIV, eq. 8)."""

from __future__ import annotations

import numpy as np
import torch

from masiv.identify.problem import Problem
from masiv.scene.camera import Camera
from masiv.scene.scene import Scene
from masiv.splat.rasteriser import render

MARGIN = 6  # pixels around the mask's box
OPACITY = 0.9


def silhouette_errors(problem: Problem, positions: torch.Tensor, pictures: list[tuple[int, int]]) -> torch.Tensor:
    """Mean error of ``pictures`` (frame, view); positions (K, N, 3) [m, simulation frame] as ``Problem.run`` has
    them."""
    spacing = (problem.volume / problem.count) ** (1 / 3)
    rotation = torch.as_tensor(problem.axes.rotation, dtype=torch.float32)
    translation = torch.as_tensor(problem.axes.translation, dtype=torch.float32)
    errors = [
        silhouette_error(
            problem.scene, view, frame, (positions[frame * problem.samples - 1] - translation) @ rotation, spacing
        )
        for frame, view in pictures
    ]
    return torch.stack(errors).mean()


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


def silhouette_error(scene: Scene, view: int, frame: int, points: torch.Tensor, spacing: float) -> torch.Tensor:
    """Mean |alpha - mask| around the mask of a picture, over the mask's area. points (N, 3) [m, world], spacing [m]."""
    camera, mask, valid = _crop(scene, view, frame)
    count = len(points)
    sizes = torch.full((count,), 0.5 * spacing)
    picture = render(camera, points, sizes, torch.full((count,), OPACITY), torch.zeros(count, 3), torch.zeros(3))
    return ((picture.alpha - mask).abs() * valid).sum() / (mask * valid).sum().clamp_min(1.0)


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
