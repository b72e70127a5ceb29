"""What particles look like beside the pictures: their silhouette against the masks (L_sil of MASIV, eq. 8), their paint
against the colours."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import brentq

from masiv.identify.problem import Problem
from masiv.materials.law import Law
from masiv.models.initial_state import InitialState
from masiv.scene.camera import Camera
from masiv.scene.scene import Scene
from masiv.splat.rasteriser import Rendering, render

MARGIN = 6  # pixels around the mask's box
OPACITY = 0.9
VIEWS = 3
SIZES = 0.1, 1.0
"""Standard deviations that a particle's blob may have, in particle spacings."""


@dataclass(frozen=True)
class Window:
    """The part of a picture around its mask: image (H, W, 3) in [0, 1], mask (H, W), valid (H, W) bool."""

    camera: Camera
    image: torch.Tensor
    mask: torch.Tensor
    valid: torch.Tensor


def window(scene: Scene, view: int, frame: int) -> Window:
    """All of the picture where nothing is masked."""
    picture, camera = scene.frame(view, frame), scene.cameras[view]
    rows, columns = np.nonzero(picture.mask > 0.5)
    part = slice(None), slice(None)
    if len(rows) > 0:
        y0, y1 = max(rows.min() - MARGIN, 0), min(rows.max() + MARGIN + 1, camera.height)
        x0, x1 = max(columns.min() - MARGIN, 0), min(columns.max() + MARGIN + 1, camera.width)
        part = slice(y0, y1), slice(x0, x1)
        camera = camera.cropped(int(x0), int(y0), int(x1 - x0), int(y1 - y0))
    image = torch.as_tensor(picture.image[part].astype(np.float32) / 255)
    return Window(camera, image, torch.as_tensor(picture.mask[part]), torch.as_tensor(picture.valid[part]))


def drawn(seen: Window, points: torch.Tensor, size: float, channels: torch.Tensor) -> Rendering:
    """Particles (N, 3) [m, world] as blobs of standard deviation ``size`` [m] with three ``channels`` (N, 3), over
    nothing."""
    count = len(points)
    return render(
        seen.camera, points, torch.full((count,), size), torch.full((count,), OPACITY), channels, torch.zeros(3)
    )


def blob_size(problem: Problem) -> float:
    """Standard deviation [m] of a particle's blob at which the body covers, at frame 0, as many pixels as the masks.

    There the particles fill what the masks show. A size for all bodies is too large for most (a sphere's silhouette had
    a tenth too many pixels at half a spacing), and a law that is fitted to such silhouettes learns to shrink the body.
    """
    spacing = (problem.volume / problem.count) ** (1 / 3)
    points, nothing = to_world(problem, problem.particles), torch.zeros(problem.count, 3)

    @functools.lru_cache
    @torch.no_grad()
    def excess(size: float) -> float:
        total = 0.0
        for view in problem.scene.views:
            seen = window(problem.scene, view, 0)
            difference, area = _outside(drawn(seen, points, size * spacing, nothing), seen)
            total += float(difference.sum()) / area
        return total

    if excess(SIZES[0]) >= 0 or excess(SIZES[1]) <= 0:
        return spacing * min(SIZES, key=lambda size: abs(excess(size)))
    return spacing * float(brentq(excess, *SIZES, xtol=0.005))


def picture_errors(
    problem: Problem, positions: torch.Tensor, pictures: list[tuple[int, int]]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean errors of the silhouettes and of the paint in ``pictures`` (frame, view).

    Silhouettes: |alpha - mask| over the mask's area. Paint: ``masiv.identify.paint.paint_error``, 0 where
    ``problem.paint`` is None. positions (K, N, 3) [m, simulation frame] as ``Problem.run`` has them.
    """
    parts = [(d.abs().sum() / area, paint) for d, area, paint in _beside(problem, positions, pictures)]
    outlines, paints = zip(*parts, strict=True)
    return torch.stack(outlines).mean(), torch.stack(paints).mean()


def beside_pictures(
    problem: Problem, positions: torch.Tensor, pictures: list[tuple[int, int]]
) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """For each of ``pictures``, as in ``picture_errors``: alpha - mask (H, W) over the root of the mask's area, and the
    paint's error."""
    for difference, area, paint in _beside(problem, positions, pictures):
        yield difference / math.sqrt(area), paint


def _beside(
    problem: Problem, positions: torch.Tensor, pictures: list[tuple[int, int]]
) -> Iterator[tuple[torch.Tensor, float, torch.Tensor]]:
    from masiv.identify.paint import paint_error

    paint, nothing = problem.paint, torch.zeros(problem.count, 3)
    for frame, view in pictures:
        seen = window(problem.scene, view, frame)
        points = to_world(problem, positions[frame * problem.samples - 1])
        difference, area = _outside(drawn(seen, points, problem.blob_size, nothing), seen)
        yield difference, area, torch.zeros(()) if paint is None else paint_error(paint, points, seen)


@torch.no_grad()
def shown(problem: Problem, law: Law, motion: InitialState, contact: str) -> tuple[torch.Tensor, torch.Tensor]:
    """``picture_errors`` of a rollout in ``VIEWS`` pictures of each frame, by which fits are compared."""
    positions = problem.run(law, motion, contact, problem.frames)
    return picture_errors(problem, positions, some_of_each(problem, problem.frames, VIEWS))


def picture_objective(problem: Problem, errors: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
    """What ``errors`` of silhouettes and paint add to an objective."""
    return problem.config.silhouette_weight * errors[0] + problem.config.paint_weight * errors[1]


def compared(problem: Problem) -> bool:
    """Whether there are pictures, and a rollout is to be compared with them."""
    config = problem.config
    weighty = config.silhouette_weight > 0 or config.paint_weight > 0
    return bool(problem.scene.views) and config.pictures > 0 and weighty


def to_world(problem: Problem, points: torch.Tensor) -> torch.Tensor:
    """Points (N, 3) [m] of the simulation frame."""
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


def _outside(picture: Rendering, seen: Window) -> tuple[torch.Tensor, float]:
    """alpha - mask (H, W), and the area of the mask [pixels]."""
    return (picture.alpha - seen.mask) * seen.valid, max(float((seen.mask * seen.valid).sum()), 1.0)
