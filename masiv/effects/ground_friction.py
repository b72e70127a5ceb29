"""Ground that lets go sideways."""

import taichi as ti

from masiv.effects.effect import Effect, EffectParameter


@ti.func
def _slid(x, v, held, t, dt, dx, c):
    out = held
    lost = ti.Vector([v[0] - held[0], 0.0, v[2] - held[2]])
    speed = ti.sqrt(lost.dot(lost) + 1e-20)  # with a derivative at rest
    pressed = ti.abs(v[1] - held[1])
    if c[0] * speed > pressed:
        out = held + (1.0 - pressed / (c[0] * speed)) * lost
    return out


class GroundFriction(Effect):
    """Coulomb friction with the ground. The parameter is the slipperiness 1/mu, which is zero in a model whose ground
    holds what is pressed to it (sticky, release). Where friction is declared, the smaller coefficient counts.

    Of the tangential velocity that the model's contact would take from a node, no more than mu times the normal
    velocity that it takes is taken (on sticky ground, also where that keeps matter from leaving). Little slips while mu
    is large, so the response at zero is weak: a score needs a change as large as ``step`` (mu = 2).
    """

    name = "ground_friction"
    looks_like = "after it lands the body slides on, where it should have stuck"
    parameters = (EffectParameter("slipperiness", "1", 0.0, 100.0, 0.5),)
    on_grid = "ground"
    nonsmooth = True

    def node_velocity(self):
        return _slid
