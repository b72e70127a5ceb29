"""Ground that throws back."""

import taichi as ti

from masiv.effects.effect import Effect, EffectParameter


@ti.func
def _thrown_back(x, v, held, t, dt, dx, c):
    return held + ti.Vector([0.0, c[0] * ti.abs(v[1] - held[1]), 0.0])


class Restitution(Effect):
    """A grounded node gets back, upwards, the share e of the normal velocity that the model's contact takes from it.

    With sticky ground that also lets go what is pulled: at e = 1 it is free to leave. It is e of the matter at the
    ground; the bounce of the body as a whole depends on its elasticity too.
    """

    name = "restitution"
    looks_like = "the body bounces higher than it should, or leaves a ground that should have kept it"
    parameters = (EffectParameter("coefficient", "1", 0.0, 1.0, 0.02),)
    on_grid = "ground"
    nonsmooth = True

    def node_velocity(self):
        return _thrown_back
