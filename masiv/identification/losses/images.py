"""Image losses: silhouettes of the particles against the masks (L_sil of MASIV, eq. 10), their colors against the
pictures."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Iterator
from typing import cast

import torch
from scipy.optimize import brentq

from masiv.identification.losses.particle_colors import ParticleColors, color_correlation_loss, estimate_particle_colors
from masiv.identification.losses.picture_window import (
    PictureWindow,
    PictureWindows,
    particle_spacing,
    render_particles,
    to_world,
)
from masiv.models.filmed_body import FilmedBody
from masiv.splat.rasteriser import Rendering

SPLAT_SIGMA_RANGE = 0.1, 1.0
"""Bounds of the standard deviation of a particle's Gaussian, in particle spacings."""


class ImageTerms:
    """Silhouettes and colors of the particles of ``problem``, with what is computed once for them.

    with_colors: whether colors are compared. Without them, and without pictures, the color error is 0.
    """

    def __init__(self, problem: FilmedBody, *, with_colors: bool) -> None:
        self.problem = problem
        self.with_colors = with_colors
        self.windows = PictureWindows(problem)

    @functools.cached_property
    def splat_sigma(self) -> float:
        """Standard deviation [m] of the Gaussians that cover as many pixels as the masks do at frame 0.

        The particles fill the body that the masks show at frame 0. A fixed size is too large for most bodies: with
        half a spacing the silhouette of a sphere has a tenth too many pixels, and a law that is fitted to such
        silhouettes learns to shrink the body.
        """
        spacing = particle_spacing(self.problem)
        points, nothing = to_world(self.problem, self.problem.particles), torch.zeros(self.problem.count, 3)

        @functools.lru_cache
        @torch.no_grad()
        def relative_excess(size: float) -> float:
            total = 0.0
            for view in self.problem.scene.views:
                window = self.windows(view, 0)
                difference, area = _alpha_difference(render_particles(window, points, size * spacing, nothing), window)
                total += float(difference.sum()) / area
            return total

        low, high = SPLAT_SIGMA_RANGE
        if relative_excess(low) >= 0 or relative_excess(high) <= 0:
            return spacing * min(SPLAT_SIGMA_RANGE, key=lambda size: abs(relative_excess(size)))
        return spacing * float(cast(float, brentq(relative_excess, low, high, xtol=0.005)))

    @functools.cached_property
    def colors(self) -> ParticleColors | None:
        """The particles' colors; None without pictures or if colors are not compared."""
        return estimate_particle_colors(self.windows) if self.with_colors and self.problem.scene.views else None

    def prepare(self, pictures: Iterable[tuple[int, int]]) -> None:
        """Compute now what would be computed on first use, also for ``pictures``: copies of this object then have it,
        and need not read those pictures."""
        _ = self.splat_sigma, self.colors
        for frame, view in pictures:
            self.windows(view, frame)

    def errors(self, positions: torch.Tensor, pictures: Iterable[tuple[int, int]]) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean silhouette error () and mean color error () over ``pictures``, as ``errors_by_picture``."""
        silhouettes, colors = self.errors_by_picture(positions, pictures)
        return silhouettes.mean(), colors.mean()

    def errors_by_picture(
        self, positions: torch.Tensor, pictures: Iterable[tuple[int, int]]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Silhouette errors (P,) and color errors (P,) of ``pictures`` (frame, view).

        Silhouettes: sum of |alpha - mask| over the area of the mask. Colors: ``color_correlation_loss``.
        positions (K, N, 3) [m, simulation frame] as ``FilmedBody.run`` returns them.
        """
        parts = [(d.abs().sum() / area, color) for d, area, color in self._compared(positions, pictures)]
        silhouettes, colors = zip(*parts, strict=True)
        return torch.stack(silhouettes), torch.stack(colors)

    def residuals(
        self, positions: torch.Tensor, pictures: Iterable[tuple[int, int]]
    ) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        """For each picture alpha - mask (H, W), divided by the root of the mask's area, and the color error ().

        Arguments as of ``errors_by_picture``.
        """
        for difference, area, color in self._compared(positions, pictures):
            yield difference / math.sqrt(area), color

    def _compared(
        self, positions: torch.Tensor, pictures: Iterable[tuple[int, int]]
    ) -> Iterator[tuple[torch.Tensor, float, torch.Tensor]]:
        problem, colors = self.problem, self.colors
        nothing = torch.zeros(problem.count, 3)
        for frame, view in pictures:
            window = self.windows(view, frame)
            points = to_world(problem, positions[frame * problem.samples - 1])
            difference, area = _alpha_difference(render_particles(window, points, self.splat_sigma, nothing), window)
            yield (
                difference,
                area,
                torch.zeros(()) if colors is None else color_correlation_loss(colors, points, window),
            )


def pictures_of_each_frame(views: tuple[int, ...], frames: int, count: int = 1) -> list[tuple[int, int]]:
    """``count`` pictures (frame, view) of each of the frames 1…``frames``; the views take turns.

    All views of each frame if there are fewer than ``count``.
    """
    count = min(count, len(views))
    return [
        (frame, views[(frame + k * len(views) // count) % len(views)])
        for frame in range(1, frames + 1) for k in range(count)
    ]  # fmt: skip


def _alpha_difference(picture: Rendering, window: PictureWindow) -> tuple[torch.Tensor, float]:
    """alpha - mask (H, W), and the area of the mask [pixels]."""
    return (picture.alpha - window.mask) * window.valid, max(float((window.mask * window.valid).sum()), 1.0)
