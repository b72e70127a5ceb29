"""A force that swings to and fro."""

import math

import numpy as np
import taichi as ti
import torch

from masiv.effects.effect import Effect, EffectParameter

_GUESSES = 5


@ti.func
def _shaken(x, v, held, t, dt, dx, c):
    phase = c[6] * (t + 0.5 * dt)
    cosine, sine = ti.cos(phase), ti.sin(phase)
    return v + dt * (cosine * ti.Vector([c[0], c[1], c[2]]) + sine * ti.Vector([c[3], c[4], c[5]]))


class PeriodicForce(Effect):
    """dv/dt = A cos(2 pi f t) + B sin(2 pi f t), t from frame 0: a fan, a shaken frame, a hand that trembles."""

    name = "periodic_force"
    looks_like = "the whole body sways about its parabola at a steady rhythm"
    parameters = (
        *(EffectParameter(f"cosine_{axis}", "m/s^2", -50.0, 50.0, 0.1) for axis in "xyz"),
        *(EffectParameter(f"sine_{axis}", "m/s^2", -50.0, 50.0, 0.1) for axis in "xyz"),
        EffectParameter("frequency", "Hz", 0.05, 200.0, 0.1, start=2.0),
    )
    strengths = 6
    on_grid = "nodes"

    def node_velocity(self):
        return _shaken

    def coefficients(self, theta, setting):
        return torch.cat([theta[:6], 2 * math.pi * theta[6:]])

    def identifiability_issue(self, theta, watched, places):
        """What has not come round once is a force that changes, and nothing says that it is periodic."""
        frequency = float(theta[6])
        if frequency * watched >= 1:
            return None
        return f"no whole period of {frequency:.2g} Hz was seen in {watched:.2g} s"

    def guesses(self, setting):
        """From half a period in the film to two frames a period, closer together where a force moves a body most."""
        low, high = 0.5 / setting.duration, 0.5 / setting.frame_time
        return [(float(f),) for f in np.geomspace(min(low, high), high, _GUESSES)]
