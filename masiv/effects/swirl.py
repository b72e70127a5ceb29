"""A force round a vertical axis."""

import taichi as ti

from masiv.effects.effect import Effect, EffectParameter


@ti.func
def _swirled(x, v, held, t, dt, dx, c):
    return v + (dt * c[0]) * ti.Vector([x[2] - c[2], 0.0, c[1] - x[0]])


class Swirl(Effect):
    """dv/dt = theta up x (x - c), up = (0, 1, 0): spins the body up at theta rad/s^2 and carries it round the axis."""

    name = "swirl"
    looks_like = "the body turns about the vertical faster and faster, or slower and slower, and is carried round"
    parameters = (
        EffectParameter("strength", "1/s^2", -100.0, 100.0, 0.05),
        EffectParameter("x", "m", -100.0, 100.0, 0.02),
        EffectParameter("z", "m", -100.0, 100.0, 0.02),
    )
    on_grid = "nodes"

    def node_velocity(self):
        return _swirled

    def guesses(self, setting):
        """Through the body, and a body's size away from it on four sides."""
        x, _, z = setting.rest.double().mean(0).tolist()
        d = setting.size
        return [(x, z), (x + d, z), (x - d, z), (x, z + d), (x, z - d)]
