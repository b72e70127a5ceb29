"""Colors that the particles carry with them.

A silhouette shows where the body is, but not where each part of it is: a ball may spin, and a fluid may flow inside a
puddle, with the same outline. The colors show the difference. Each particle gets its color from the pictures of frame
0. A particle that no camera sees there has no color, and pixels that mostly show such particles do not count. The
shading of a body changes as it turns and spreads, so pictures are compared by correlation.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from masiv.identification.losses.picture_window import (
    PictureWindow,
    PictureWindows,
    particle_spacing,
    render_particles,
    to_world,
)

SIRT_SWEEPS = 12
COLOR_SPLAT_SIGMA = 0.5
"""Standard deviation of the Gaussians, in particle spacings. It is large enough that no particle behind others shows
between them."""
MIN_VISIBILITY = 0.2
"""A particle's color is known if its weight in the pictures of frame 0 is at least this fraction of the 95th percentile
of all weights. In a ball this selects the outermost layer."""
MIN_KNOWN_COVERAGE = 0.2
"""A pixel counts if particles of known color have at least this part of its alpha."""
COLOR_NOISE = 0.03
"""Standard deviation of colors, of 1, that is due to noise and shading."""


@dataclass(frozen=True)
class ParticleColors:
    """Colors in their two principal components.

    channels (N, 3): the two components, and 1; all 0 for a particle of unknown color. mean (3,) and axes (3, 2): of the
    components. splat_sigma: standard deviation of the Gaussians [m].
    """

    channels: torch.Tensor
    mean: torch.Tensor
    axes: torch.Tensor
    splat_sigma: float


@torch.enable_grad()
def estimate_particle_colors(windows: PictureWindows) -> ParticleColors:
    """The colors of the particles of ``windows.problem`` from all pictures of frame 0.

    A picture is linear in the colors. They are solved for by simultaneous back-projection (SIRT, Gilbert 1972): in each
    sweep a particle's color changes by the mean residual of the pixels to which it contributes.
    """
    problem = windows.problem
    count, sigma = problem.count, COLOR_SPLAT_SIGMA * particle_spacing(problem)
    points = to_world(problem, problem.particles)
    seen = [windows(view, 0) for view in problem.scene.views]
    colors = torch.full((count, 3), 0.5, requires_grad=True)
    weight = torch.zeros(count)
    for sweep in range(SIRT_SWEEPS):
        correction = torch.zeros(count, 3)
        for window in seen:
            picture = render_particles(window, points, sigma, colors)
            inside = (window.mask * window.valid)[..., None]
            if sweep == 0:
                weight += torch.autograd.grad((picture.rgb * inside).sum(), colors, retain_graph=True)[0][:, 0]
            opaque = picture.rgb / picture.alpha.clamp_min(MIN_KNOWN_COVERAGE)[..., None]
            residual = ((window.image - opaque) * inside).detach()
            correction += torch.autograd.grad((picture.rgb * residual).sum(), colors)[0]
        with torch.no_grad():
            colors += correction / weight.clamp_min(1e-3)[:, None]
            colors.clamp_(0, 1)
    return _principal_components(colors.detach(), weight, sigma)


def _principal_components(colors: torch.Tensor, weight: torch.Tensor, sigma: float) -> ParticleColors:
    """From colors (N, 3) and the weights (N,) with which the pictures show them."""
    count = len(colors)
    known = weight >= MIN_VISIBILITY * weight.quantile(0.95)
    if weight.max() == 0 or known.sum() < 3:
        return ParticleColors(torch.zeros(count, 3), torch.zeros(3), torch.zeros(3, 2), sigma)
    mean = colors[known].mean(0)
    axes = torch.linalg.svd(colors[known] - mean, full_matrices=False).Vh[:2].T
    channels = torch.cat([(colors - mean) @ axes, torch.ones(count, 1)], dim=1)
    return ParticleColors(channels * known[:, None], mean, axes.contiguous(), sigma)


def color_correlation_loss(colors: ParticleColors, points: torch.Tensor, window: PictureWindow) -> torch.Tensor:
    """1 - correlation () of the colored ``points`` (N, 3) [m, world] with the picture, in [0, 2].

    1 means no relation, or no contrast on either side.
    """
    picture = render_particles(window, points, colors.splat_sigma, colors.channels)
    known = picture.rgb[..., 2]
    weight = (known * (known > MIN_KNOWN_COVERAGE) * window.mask * window.valid)[..., None]
    total = weight.sum().clamp_min(1.0)
    simulated = picture.rgb[..., :2] / known.clamp_min(MIN_KNOWN_COVERAGE)[..., None]
    observed = (window.image - colors.mean) @ colors.axes
    simulated, observed = (p - (weight * p).sum((0, 1)) / total for p in (simulated, observed))
    variances = [(weight * p.square()).sum() / total + COLOR_NOISE**2 for p in (simulated, observed)]
    return 1 - (weight * simulated * observed).sum() / total / (variances[0] * variances[1]).sqrt()
