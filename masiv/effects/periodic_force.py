"""A force that oscillates."""

import math

import numpy as np
import taichi as ti
import torch

from masiv.effects.context import EffectContext, EffectParameter
from masiv.effects.effect import NodalEffect
from masiv.effects.search_hints import SearchHints

GUESSES = 3


@ti.func
def _accelerated(x, v, t, dt, dx, c):
    phase = c[6] * (t + 0.5 * dt)
    cosine, sine = ti.cos(phase), ti.sin(phase)
    return v + dt * (cosine * ti.Vector([c[0], c[1], c[2]]) + sine * ti.Vector([c[3], c[4], c[5]]))


def _no_period(theta: torch.Tensor, duration: float, places: torch.Tensor) -> str | None:
    """A force that was observed for less than a period changes, and nothing shows that it is periodic."""
    frequency = float(theta[6])
    if frequency * duration >= 1:
        return None
    return f"no whole period of {frequency:.2g} Hz was seen in {duration:.2g} s"


def _guesses(context: EffectContext) -> list[tuple[float, ...]]:
    """Frequencies from half a period in the observation to two frames a period, denser where a force moves a body
    most."""
    low, high = 0.5 / context.duration, 0.5 / context.frame_time
    return [(float(f),) for f in np.geomspace(min(low, high), high, GUESSES)]


class PeriodicForce(NodalEffect):
    r"""$\dot v = A \cos 2\pi f t + B \sin 2\pi f t$, $t$ since frame 0: a fan, a shaken frame, a trembling hand."""

    name = "periodic_force"
    looks_like = "the whole body sways about its parabola at a steady rhythm"
    parameters = (
        *(EffectParameter(f"cosine_{axis}", "m/s^2", -50.0, 50.0, 0.1) for axis in "xyz"),
        *(EffectParameter(f"sine_{axis}", "m/s^2", -50.0, 50.0, 0.1) for axis in "xyz"),
        EffectParameter("frequency", "Hz", 0.05, 200.0, 0.1, start=2.0),
    )
    strengths = 6
    hints = SearchHints(guesses=_guesses, identifiability_issue=_no_period)

    def node_velocity(self):
        return _accelerated

    def coefficients(self, theta, context):
        return torch.cat([theta[:6], 2 * math.pi * theta[6:]])
