"""A discrepancy force for motion that no effect of the library explains."""

import taichi as ti

from masiv.effects.context import EffectContext, EffectParameter
from masiv.effects.effect import NodalEffect
from masiv.effects.search_hints import SearchHints

KNOTS = 4


@ti.func
def _accelerated(x, v, t, dt, dx, c):
    span = c[3 * KNOTS + 9]
    at = ti.min(ti.max(t / span, 0.0), 1.0) * (KNOTS - 1)
    a = ti.Vector([c[3 * KNOTS], c[3 * KNOTS + 1], c[3 * KNOTS + 2]]) * x[0]
    a += ti.Vector([c[3 * KNOTS + 3], c[3 * KNOTS + 4], c[3 * KNOTS + 5]]) * x[1]
    a += ti.Vector([c[3 * KNOTS + 6], c[3 * KNOTS + 7], c[3 * KNOTS + 8]]) * x[2]
    for k in ti.static(range(KNOTS)):
        a += ti.max(0.0, 1.0 - ti.abs(at - k)) * ti.Vector([c[3 * k], c[3 * k + 1], c[3 * k + 2]])
    return v + dt * a


def _guesses(context: EffectContext) -> list[tuple[float, ...]]:
    return [(context.duration,)]


class SmoothForce(NodalEffect):
    r"""$\dot v = a(t) + G x$: $a$ is linear between four instants of [0, span] and constant after it, $x$ is the place.

    It is not a cause: it represents one that the library lacks.
    """

    name = "smooth_force"
    looks_like = "not a cause: a smooth force that stands in for one that is not known"
    hints = SearchHints(guesses=_guesses, cause=False)
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

    def node_velocity(self):
        return _accelerated
