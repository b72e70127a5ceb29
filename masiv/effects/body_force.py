"""A steady force in proportion to mass."""

import taichi as ti

from masiv.effects.context import EffectParameter
from masiv.effects.effect import NodalEffect


@ti.func
def _accelerated(x, v, t, dt, dx, c):
    return v + dt * ti.Vector([c[0], c[1], c[2]])


class BodyForce(NodalEffect):
    r"""$\dot v = a$: wind, gravity of another direction or size, the attraction of something far away. One observation
    does not distinguish these."""

    name = "body_force"
    looks_like = (
        "the whole body drifts off its parabola, faster and faster, always the same way: wind, tilted gravity, a pull "
        "from afar"
    )
    parameters = tuple(EffectParameter(f"acceleration_{axis}", "m/s^2", -20.0, 20.0, 0.05) for axis in "xyz")
    strengths = 3

    def node_velocity(self):
        return _accelerated
