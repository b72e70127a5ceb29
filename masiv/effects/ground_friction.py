"""Ground that lets go sideways."""

import taichi as ti

from masiv.effects.effect import Effect, EffectParameter

_GRIP = 0.1
"""[m/s^2]: what the ground can hold back without pressure. It keeps the response to a little slipperiness finite where
matter only grazes the ground, and is a hundredth of gravity."""


@ti.func
def _slid(x, v, held, t, dt, dx, c):
    lost = ti.Vector([v[0] - held[0], 0.0, v[2] - held[2]])
    speed = ti.sqrt(lost.dot(lost) + 1e-12)
    pressed = ti.max(-v[1], 0.0) + dt * _GRIP
    return held + (c[0] * speed / (c[0] * speed + pressed)) * lost


class GroundFriction(Effect):
    """Coulomb friction with the ground. The parameter is the slipperiness 1/mu, which is zero in a model whose ground
    holds what is pressed to it (sticky, release); where friction mu0 is declared, 1/mu = 1/mu0 + theta.

    The ground takes from a node, of the tangential velocity j that the model's contact would take, j p / (theta j + p)
    with p the normal velocity it stops. Sliding is theta j >> p, where that is Coulomb's p / theta; matter that sticks
    creeps at millimetres a second. So the response is of first order at zero, where Coulomb's own law has none.
    """

    name = "ground_friction"
    looks_like = "after it lands the body slides on, where it should have stuck"
    parameters = (EffectParameter("slipperiness", "1", 0.0, 100.0, 0.1),)
    on_grid = "ground"

    def node_velocity(self):
        return _slid
