"""A force around a vertical axis."""

import taichi as ti
import torch

from masiv.effects.context import EffectContext, EffectParameter
from masiv.effects.effect import NodalEffect
from masiv.effects.search_hints import SearchHints

MAX_UNIFORM_FRACTION = 0.9
"""Fraction [1] of the mean square force along the body's path above which a swirl counts as a uniform force."""


@ti.func
def _accelerated(x, v, t, dt, dx, c):
    return v + (dt * c[0]) * ti.Vector([x[2] - c[2], 0.0, c[1] - x[0]])


def _far_axis(theta: torch.Tensor, duration: float, places: torch.Tensor) -> str | None:
    """If the axis is far from the body, the force is the same everywhere in it."""
    arms = places[:, ::2].double() - theta[1:].double()
    middle = arms.mean(0)
    if float(middle.square().sum()) < MAX_UNIFORM_FRACTION * float(arms.square().sum(1).mean()):
        return None
    return f"its axis is {float(torch.linalg.vector_norm(middle)):.2g} m away, where it is no more than a uniform force"


def _guesses(context: EffectContext) -> list[tuple[float, ...]]:
    """An axis through the body, and four axes a body's size away from it."""
    x, _, z = context.rest.double().mean(0).tolist()
    d = context.size
    return [(x, z), (x + d, z), (x - d, z), (x, z + d), (x, z - d)]


class Swirl(NodalEffect):
    r"""$\dot v = \theta\, e_y \times (x - c)$: spins the body up at $\theta$ rad/s^2 and carries it around the axis."""

    name = "swirl"
    looks_like = "the body turns about the vertical faster and faster, or slower and slower, and moves round"
    parameters = (
        EffectParameter("strength", "1/s^2", -100.0, 100.0, 0.05),
        EffectParameter("x", "m", -100.0, 100.0, 0.02),
        EffectParameter("z", "m", -100.0, 100.0, 0.02),
    )
    hints = SearchHints(guesses=_guesses, identifiability_issue=_far_axis)

    def node_velocity(self):
        return _accelerated
