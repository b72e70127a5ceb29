"""Drag that grows with speed."""

import math

import taichi as ti

from masiv.effects.effect import Effect, EffectParameter


@ti.func
def _slowed(x, v, held, t, dt, dx, c):
    return ti.exp(-c[0] * dt) * v


class LinearDrag(Effect):
    """dv/dt = -k v (Stokes), exact over a substep."""

    name = "linear_drag"
    looks_like = "everything slows down at a rate, whatever its speed; spins die out as falls do"
    parameters = (EffectParameter("rate", "1/s", 0.0, 20.0, 0.05),)
    on_grid = "nodes"
    shared = (EffectParameter("viscosity_of_medium", "Pa s", 0.0, 10.0, 0.005),)

    def of(self, theta, body):
        """k = 3 pi mu d / m of a sphere."""
        return theta * (3 * math.pi * body.diameter / body.mass)

    def violates_bounds(self, theta, body):
        """No shape has more than a few times the drag of a sphere."""
        if float(theta[0]) <= 10 * body.medium_viscosity:
            return None
        return f"it takes a medium of {float(theta[0]):.2g} Pa s, and that has {body.medium_viscosity:.2g} Pa s"

    def node_velocity(self):
        return _slowed
