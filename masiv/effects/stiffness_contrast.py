"""A part that is stiffer or softer than the rest."""

import math

import taichi as ti
import torch

from masiv.effects.context import EffectContext, EffectParameter
from masiv.effects.effect import StressEffect
from masiv.effects.places import PLACE, as_guesses, cluster_centres, square_distance
from masiv.effects.search_hints import SearchHints
from masiv.effects.stability import SubstepDemand


@ti.func
def _scaled(tau, f, c_affine, c):
    return ti.exp(c[0]) * tau


def _guesses(context: EffectContext) -> list[tuple[float, ...]]:
    """Eight parts of the body, each with the radius of such a part."""
    return as_guesses(cluster_centres(context.rest, 8), 0.25 * context.size)


class StiffnessContrast(StressEffect):
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
    hints = SearchHints(guesses=_guesses)

    def particle_stress(self):
        return _scaled

    def coefficients(self, theta, context):
        bump = torch.exp(-0.5 * square_distance(context.rest, theta[1:4]) / theta[4] ** 2)
        return (theta[0] * bump)[:, None]

    def substep_demand(self, theta, context):
        # At the stiffest particle; around a softer part the body is as the law has it.
        stiffest = float(self.coefficients(theta, context).max())
        return SubstepDemand(modulus_factor=math.exp(max(stiffest, 0.0)))
