"""Drag that grows with speed."""

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

    def node_velocity(self):
        return _slowed
