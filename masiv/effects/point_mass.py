"""A mass in the body or on it."""

from __future__ import annotations

import torch

from masiv.effects.context import EffectContext, EffectParameter
from masiv.effects.effect import MassEffect
from masiv.effects.places import PLACE, as_guesses, cluster_centres, face_centres, weights_around
from masiv.effects.search_hints import SearchHints


def _guesses(context: EffectContext) -> list[tuple[float, ...]]:
    """Centres of six parts of the body (mass at its very centre would hardly show) and of its faces."""
    return as_guesses(torch.cat([cluster_centres(context.rest, 6), face_centres(context.rest)]))


class PointMass(MassEffect):
    r"""$m_p \leftarrow m_p + w_p M$ with $\sum_p w_p = 1$: mass $M$ added around a place of the body at frame 0.

    The weights are a Gaussian of radius 1/8 of the body's size whose mean is the place. The mass of the body grows by
    exactly $M$, wherever the place is. At a surface the mass is in the outermost particles.
    """

    name = "point_mass"
    looks_like = "the body turns about a point that is not its middle, and swings round its heavy end"
    parameters = (EffectParameter("mass", "kg", 0.0, 1000.0, 1.0), *PLACE)
    hints = SearchHints(guesses=_guesses, inside=True)

    def mass_factor(self, theta, context):
        return 1 + theta[0] / context.particle_mass * weights_around(context.rest, theta[1:4], context.size / 8)
