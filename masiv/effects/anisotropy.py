"""Fibres: a body that is stiffer along one direction of its material."""

from __future__ import annotations

import taichi as ti
import torch

from masiv.effects.context import EffectContext, EffectParameter
from masiv.effects.directions import AXES, DIAGONALS, INCLINATION, direction
from masiv.effects.effect import StressEffect
from masiv.effects.search_hints import SearchHints
from masiv.effects.stability import SubstepDemand


@ti.func
def _reinforced(tau, f, c_affine, c):
    fibre = f @ ti.Vector([c[1], c[2], c[3]])
    return tau + (0.5 * c[0] * (fibre.dot(fibre) - 1.0)) * fibre.outer_product(fibre)


def _guesses(context: EffectContext) -> list[tuple[float, ...]]:
    """Along the axes, and halfway between two of them."""
    return [*AXES, *DIAGONALS]


class Anisotropy(StressEffect):
    r"""$\tau \leftarrow \tau + \tfrac12 E_f (|F a|^2 - 1)\, F a \otimes F a$: fibres along $a$ beside the law.

    The standard reinforcing model (Qiu and Pence 1997), with the energy $\tfrac18 E_f (|F a|^2 - 1)^2$ a volume and the
    unit vector $a$ in the shape of frame 0. $E_f$ is what the fibres add to Young's modulus along them: a law with
    Young's modulus $E$ becomes $1 + E_f / E$ times as stiff along the fibres, and stays as it was across. The
    inclination of $a$ is the horizontal vector whose length is the angle from the vertical to $a$, and which points the
    way that $a$ leans. In a law that flows, $F$ is the elastic part, and the fibres yield with the rest. Looked for on
    request: a motion that bends a body one way does not tell a direction.
    """

    name = "anisotropy"
    looks_like = "the body gives way less along one direction of its material than across it"
    parameters = (EffectParameter("fibre_modulus", "Pa", 0.0, 1e7, 1e3), *INCLINATION)
    hints = SearchHints(guesses=_guesses, on_request=True)

    def particle_stress(self):
        return _reinforced

    def coefficients(self, theta, context):
        own = torch.cat([theta[:1], direction(theta[1:3]).to(theta.dtype)])
        return own.expand(len(context.rest), -1)

    def substep_demand(self, theta, context):
        return SubstepDemand(modulus=max(float(theta[0]), 0.0))
