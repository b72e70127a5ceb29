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

    def contradiction(self, theta, body, speed):
        """Drag is linear where friction outweighs inertia, up to Reynolds numbers of about 1."""
        if float(theta[0]) == 0.0:
            return None
        reynolds = body.medium_density * speed * body.diameter / float(theta[0])
        return f"drag is not linear at its Reynolds number of {reynolds:.0f}" if reynolds > 10 else None

    def node_velocity(self):
        return _slowed
