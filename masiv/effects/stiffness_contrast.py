"""A part that is stiffer or softer than the rest: a region around a place, or one side of a plane."""

from __future__ import annotations

import math
from abc import abstractmethod

import taichi as ti
import torch

from masiv.effects.context import EffectContext, EffectParameter
from masiv.effects.directions import AXES, INCLINATION, direction, inclination_of, longest_axis
from masiv.effects.effect import StressEffect
from masiv.effects.places import PLACE, as_guesses, cluster_centres, square_distance
from masiv.effects.search_hints import SearchHints
from masiv.effects.stability import SubstepDemand

NEAR_AXIS = 0.94
"""Cosine of 20 degrees: a direction nearer than that to an axis is not tried beside it."""


@ti.func
def _scaled(tau, f, c_affine, c):
    return ti.exp(c[0]) * tau


class _Contrast(StressEffect):
    r"""$\tau_p \leftarrow e^{\theta b_p} \tau_p$ with shares $b_p$ of 0 to 1."""

    @abstractmethod
    def shares(self, theta: torch.Tensor, context: EffectContext) -> torch.Tensor:
        """Shares b (N,) [1] of the particles in the stiffer part; differentiable."""

    def particle_stress(self):
        return _scaled

    def coefficients(self, theta, context):
        return (theta[0] * self.shares(theta, context))[:, None]

    def substep_demand(self, theta, context):
        # At the stiffest particle; around a softer part the body is as the law has it.
        stiffest = float(self.coefficients(theta, context).max())
        return SubstepDemand(modulus_factor=math.exp(max(stiffest, 0.0)))


def _parts(context: EffectContext) -> list[tuple[float, ...]]:
    """Eight parts of the body, each with the radius of such a part."""
    return as_guesses(cluster_centres(context.rest, 8), 0.25 * context.size)


class StiffnessContrast(_Contrast):
    r"""$\tau_p \leftarrow e^{\theta b_p} \tau_p$ with $b_p = e^{-|X_p - X_0|^2 / (2 r^2)}$.

    $X_p$ is the position of the particle at frame 0, $X_0$ the place and $r$ the radius.
    """

    name = "stiffness_contrast"
    looks_like = "one part gives way less, or more, than the rest when the body hits something"
    parameters = (
        EffectParameter("log_stiffness_ratio", "1", -2.0, 2.0, 0.1),
        *PLACE,
        EffectParameter("radius", "m", 0.01, 10.0, 0.02, start=0.15),
    )
    hints = SearchHints(guesses=_parts)

    def shares(self, theta, context):
        return torch.exp(-0.5 * square_distance(context.rest, theta[1:4]) / theta[4] ** 2)


def _planes(context: EffectContext) -> list[tuple[float, ...]]:
    """Planes through the middle of the body and halfway from it to either end, across each axis, and across the body's
    longest axis if that is another one; the transition has a standard deviation of an eighth of the extent."""
    leaning = list(AXES)
    longest = longest_axis(context.rest)
    if float(longest.abs().max()) < NEAR_AXIS:
        leaning.append(inclination_of(longest))
    guesses = []
    for inclination in leaning:
        normal = direction(torch.tensor(inclination, dtype=context.rest.dtype))
        along = (context.rest - context.rest.mean(0)) @ normal
        extent = float(along.max() - along.min())
        guesses += [(*inclination, part * extent, extent / 8) for part in (-0.25, 0.0, 0.25)]
    return guesses


class HalfSpaceStiffnessContrast(_Contrast):
    r"""$\tau_p \leftarrow e^{\theta b_p} \tau_p$ with $b_p = \Phi\left((n \cdot (X_p - \bar X) - d) / w\right)$.

    One side of a plane is $e^\theta$ times as stiff as the other. $X_p$ is the position of the particle at frame 0 and
    $\bar X$ the mean of all; $n$ is the normal of the plane, $d$ its offset from the mean and $\Phi$ the normal
    distribution function: stiffness goes from 16 % to 84 % of its logarithm within $2 w$. The inclination of $n$ is the
    horizontal vector whose length is the angle from the vertical to $n$, and which points the way that $n$ leans. A
    second shape of the cause ``stiffness_contrast``: looked for if ``refine.effects`` names either of them.
    """

    name = "stiffness_contrast_half_space"
    looks_like = "one half gives way less, or more, than the other when the body hits something, or swings"
    parameters = (
        EffectParameter("log_stiffness_ratio", "1", -4.0, 4.0, 0.1),
        *INCLINATION,
        EffectParameter("offset", "m", -100.0, 100.0, 0.02),
        EffectParameter("width", "m", 0.002, 10.0, 0.02, start=0.05),
    )
    hints = SearchHints(guesses=_planes, on_request=True, inside=True, shape_of=StiffnessContrast.name)

    def shares(self, theta, context):
        along = (context.rest - context.rest.mean(0)) @ direction(theta[1:3]).to(context.rest.dtype)
        return torch.special.ndtr((along - theta[3]) / theta[4])
