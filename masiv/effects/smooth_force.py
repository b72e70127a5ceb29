"""What is left when no cause is known: a force that changes slowly in time and space."""

import taichi as ti

from masiv.effects.effect import Effect, EffectParameter

KNOTS = 4


@ti.func
def _pushed(x, v, held, t, dt, dx, c):
    span = c[3 * KNOTS + 9]
    at = ti.min(ti.max(t / span, 0.0), 1.0) * (KNOTS - 1)
    a = ti.Vector([c[3 * KNOTS], c[3 * KNOTS + 1], c[3 * KNOTS + 2]]) * x[0]
    a += ti.Vector([c[3 * KNOTS + 3], c[3 * KNOTS + 4], c[3 * KNOTS + 5]]) * x[1]
    a += ti.Vector([c[3 * KNOTS + 6], c[3 * KNOTS + 7], c[3 * KNOTS + 8]]) * x[2]
    for k in ti.static(range(KNOTS)):
        a += ti.max(0.0, 1.0 - ti.abs(at - k)) * ti.Vector([c[3 * k], c[3 * k + 1], c[3 * k + 2]])
    return v + dt * a


class SmoothForce(Effect):
    """dv/dt = a(t) + G x: a is linear between four instants of [0, span] and stays as it is after, x is the place.

    No cause, but a stop-gap: it stands in for one that the library lacks.
    """

    name = "smooth_force"
    looks_like = "not a cause: a smooth force that stands in for one that is not known"
    cause = False
    parameters = (
        *(
            EffectParameter(f"acceleration_{k}_{axis}", "m/s^2", -50.0, 50.0, 0.1)
            for k in range(KNOTS)
            for axis in "xyz"
        ),
        *(
            EffectParameter(f"gradient_{on}_along_{along}", "1/s^2", -200.0, 200.0, 0.2)
            for along in "xyz"
            for on in "xyz"
        ),
        EffectParameter("span", "s", 1e-3, 1e3, 0.05, start=1.0),
    )
    strengths = 3 * KNOTS + 9
    on_grid = "nodes"

    def node_velocity(self):
        return _pushed

    def guesses(self, setting):
        return [(setting.duration,)]
