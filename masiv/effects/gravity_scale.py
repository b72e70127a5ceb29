"""Gravity of another size."""

import taichi as ti

from masiv.effects.effect import Effect, EffectParameter


@ti.func
def _pulled(x, v, held, t, dt, dx, c):
    return v + dt * ti.Vector([c[0], c[1], c[2]])


class GravityScale(Effect):
    """dv/dt = theta g, on top of gravity g: buoyancy (theta < 0), or lengths of the scene that are off by a factor."""

    name = "gravity_scale"
    looks_like = "everything falls faster or slower than it should, straight down"
    parameters = (EffectParameter("relative_change", "1", -1.0, 3.0, 0.01),)
    on_grid = "nodes"

    def node_velocity(self):
        return _pulled

    def coefficients(self, theta, setting):
        return theta * setting.gravity
