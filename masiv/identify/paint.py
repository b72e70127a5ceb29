"""Colours that particles carry along.

Silhouettes say where a body is, not which matter is where: a ball may spin, and matter may stream inside of a puddle,
with the same outline. The body's paint tells them apart. Particles have the colours by which the body looks, at frame
0, as in the pictures; those that no camera saw there have none, and what a picture shows of them counts for nothing.
Light falls otherwise on a body that turns and spreads, so pictures are compared by correlation.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from masiv.identify.pictures import Window, drawn, to_world, window
from masiv.identify.problem import Problem

SWEEPS = 12
BRUSH = 0.5
"""Standard deviation of a particle's blob, in particle spacings: what is behind others must not show between them."""
SEEN = 0.2
"""A particle is known where the pictures of frame 0 show this share of what they show of the best seen ones (of the
95th of 100): in a ball, the outermost layer."""
SHOWN = 0.2
"""A pixel counts where known particles make up this share of it."""
PLAIN = 0.03
"""Variations of colour of this size or less, of 1, tell nothing: noise and shade."""


@dataclass(frozen=True)
class Paint:
    """channels (N, 3) of particles: the two principal components of their colours where they are known, else 0; and
    whether they are known. mean (3,) and axes (3, 2) of the components. size: standard deviation of the blobs [m]."""

    channels: torch.Tensor
    mean: torch.Tensor
    axes: torch.Tensor
    size: float


@torch.enable_grad()
def paint(problem: Problem) -> Paint:
    """The paint of ``problem``'s particles at frame 0.

    A picture is linear in colours: they are found by sweeps of back-projection, each particle moved by the mean of what
    is missing in the pixels that it makes up (SIRT, Gilbert 1972).
    """
    count, size = problem.count, BRUSH * (problem.volume / problem.count) ** (1 / 3)
    points = to_world(problem, problem.particles)
    windows = [window(problem.scene, view, 0) for view in problem.scene.views]
    colours = torch.full((count, 3), 0.5, requires_grad=True)
    weight = torch.zeros(count)
    for sweep in range(SWEEPS):
        missing = torch.zeros(count, 3)
        for seen in windows:
            picture = drawn(seen, points, size, colours)
            inside = (seen.mask * seen.valid)[..., None]
            if sweep == 0:
                weight += torch.autograd.grad((picture.rgb * inside).sum(), colours, retain_graph=True)[0][:, 0]
            full = picture.rgb / picture.alpha.clamp_min(SHOWN)[..., None]
            residual = ((seen.image - full) * inside).detach()
            missing += torch.autograd.grad((picture.rgb * residual).sum(), colours)[0]
        with torch.no_grad():
            colours += missing / weight.clamp_min(1e-3)[:, None]
            colours.clamp_(0, 1)
    found, known = colours.detach(), weight >= SEEN * weight.quantile(0.95)
    if weight.max() == 0 or known.sum() < 3:
        return Paint(torch.zeros(count, 3), torch.zeros(3), torch.zeros(3, 2), size)
    mean = found[known].mean(0)
    axes = torch.linalg.svd(found[known] - mean, full_matrices=False).Vh[:2].T
    channels = torch.cat([(found - mean) @ axes, torch.ones(count, 1)], dim=1)
    return Paint(channels * known[:, None], mean, axes.contiguous(), size)


def paint_error(paint: Paint, points: torch.Tensor, seen: Window) -> torch.Tensor:
    """1 - correlation of the painted ``points`` (N, 3) [m, world] with what is filmed; in [0, 2], 1 where they have
    nothing to do with each other or are plain."""
    picture = drawn(seen, points, paint.size, paint.channels)
    known = picture.rgb[..., 2]
    weight = (known * (known > SHOWN) * seen.mask * seen.valid)[..., None]
    total = weight.sum().clamp_min(1.0)
    here = picture.rgb[..., :2] / known.clamp_min(SHOWN)[..., None]
    there = (seen.image - paint.mean) @ paint.axes
    here, there = (p - (weight * p).sum((0, 1)) / total for p in (here, there))
    squares = [(weight * p.square()).sum() / total + PLAIN**2 for p in (here, there)]
    return 1 - (weight * here * there).sum() / total / (squares[0] * squares[1]).sqrt()
