"""Gravity of another size."""

import taichi as ti

from masiv.effects.context import EffectParameter
from masiv.effects.effect import NodalEffect


@ti.func
def _accelerated(x, v, t, dt, dx, c):
    return v + dt * ti.Vector([c[0], c[1], c[2]])


class GravityScale(NodalEffect):
    r"""$\dot v = \theta g$ in addition to gravity $g$: buoyancy ($\theta < 0$), or lengths of the scene that
    are off by a factor."""

    name = "gravity_scale"
    looks_like = "everything falls faster or slower than it should, straight down"
    parameters = (EffectParameter("relative_change", "1", -1.0, 3.0, 0.01),)

    def node_velocity(self):
        return _accelerated

    def coefficients(self, theta, context):
        return theta * context.gravity
