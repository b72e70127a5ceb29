"""A steady force in proportion to mass."""

import taichi as ti

from masiv.effects.effect import Effect, EffectParameter


@ti.func
def _pushed(x, v, held, t, dt, dx, c):
    return v + dt * ti.Vector([c[0], c[1], c[2]])


class BodyForce(Effect):
    """dv/dt = a: wind, gravity that is tilted or of another size, a pull from so far that it is the same all along the
    path; one run cannot tell these apart."""

    name = "body_force"
    looks_like = (
        "the whole body drifts off its parabola, faster and faster, always the same way: wind, tilted gravity, a pull "
        "from afar"
    )
    parameters = tuple(EffectParameter(f"acceleration_{axis}", "m/s^2", -20.0, 20.0, 0.05) for axis in "xyz")
    strengths = 3
    on_grid = "nodes"

    def node_velocity(self):
        return _pushed
