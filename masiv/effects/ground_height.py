"""Ground at another height."""

from __future__ import annotations

from masiv.effects.context import EffectParameter
from masiv.effects.effect import GeometryEffect
from masiv.effects.search_hints import SearchHints


class GroundHeight(GeometryEffect):
    r"""The ground is at $y = \theta$ in place of $y = 0$.

    Every fit has a ground offset of a few centimetres, since no floor is known to the millimetre; this effect replaces
    it and may be larger.
    """

    name = "ground_height"
    looks_like = "contact begins early or late, and the body rests too high or too low"
    parameters = (EffectParameter("height", "m", -0.3, 0.3, 0.001),)
    hints = SearchHints(replaces_parameter="ground_offset")

    def ground_shift(self, theta):
        return theta[0]
