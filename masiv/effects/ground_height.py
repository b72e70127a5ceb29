"""Ground at another height."""

from __future__ import annotations

from masiv.effects.effect import Effect, EffectParameter


class GroundHeight(Effect):
    """The ground is at y = theta instead of y = 0: by more than the few centimetres that are fitted anyway, since no
    floor is known to the millimetre."""

    name = "ground_height"
    looks_like = "contact begins early or late, and the body rests too high or too low"
    parameters = (EffectParameter("height", "m", -0.3, 0.3, 0.001),)
    replaces_parameter = "ground_offset"

    def ground_shift(self, theta):
        return theta[0]
