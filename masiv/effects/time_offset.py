"""A clock that is off."""

from __future__ import annotations

from masiv.effects.context import EffectParameter
from masiv.effects.effect import ClockEffect


class TimeOffset(ClockEffect):
    r"""The frame with time stamp $t$ was taken at $t + \theta$; $t = 0$ is the instant at which the body starts."""

    name = "time_offset"
    looks_like = "the motion is right but early or late by the same time throughout, most visible where it is fast"
    parameters = (EffectParameter("delay", "s", -0.1, 0.1, 0.001),)

    def time_shift(self, theta):
        return theta[0]
