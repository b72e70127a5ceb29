"""A discrepancy force for motion that no effect of the library explains: a smooth field in space and time."""

import numpy as np
import taichi as ti

from masiv.effects.context import EffectContext, EffectParameter
from masiv.effects.effect import NodalEffect
from masiv.effects.places import PLACE
from masiv.effects.search_hints import SearchHints

SPLINES = 13
"""Quadratic B-splines in time of the acceleration at the centre: they resolve an eleventh of the record."""
GRADIENT_SPLINES = 3
"""Of its gradient in space, which is a parabola in time."""
STRENGTHS = 3 * SPLINES + 9 * GRADIENT_SPLINES


@ti.func
def _spline(u):
    """The quadratic B-spline of unit intervals about 0."""
    near, far = ti.abs(u), ti.max(0.0, 1.5 - ti.abs(u))
    return ti.select(near < 0.5, 0.75 - u * u, 0.5 * far * far)


@ti.func
def _accelerated(x, v, t, dt, dx, c):
    arm = x - ti.Vector([c[STRENGTHS + 1], c[STRENGTHS + 2], c[STRENGTHS + 3]])
    part = ti.min(ti.max(t / c[STRENGTHS], 0.0), 1.0)
    a = 0.0 * v
    for k in ti.static(range(SPLINES)):
        weight = _spline(part * (SPLINES - 2) + 0.5 - k)
        a += weight * ti.Vector([c[3 * k], c[3 * k + 1], c[3 * k + 2]])
    for k in ti.static(range(GRADIENT_SPLINES)):
        weight = _spline(part * (GRADIENT_SPLINES - 2) + 0.5 - k)
        for j in ti.static(range(3)):
            g = 3 * SPLINES + 9 * k + 3 * j
            a += weight * arm[j] * ti.Vector([c[g], c[g + 1], c[g + 2]])
    return v + dt * a


def acceleration(theta: np.ndarray, places: np.ndarray, times: np.ndarray) -> np.ndarray:
    """The field (T, N, 3) [m/s^2] of parameters ``theta`` (P,) at ``places`` (T, N, 3) [m] and ``times`` (T,) [s];
    simulation frame."""
    at_centre = theta[: 3 * SPLINES].reshape(SPLINES, 3)
    gradients = theta[3 * SPLINES : STRENGTHS].reshape(GRADIENT_SPLINES, 3, 3)
    span, centre = theta[STRENGTHS], theta[STRENGTHS + 1 :]
    uniform = splines(times / span, SPLINES) @ at_centre
    gradient = np.tensordot(splines(times / span, GRADIENT_SPLINES), gradients, 1)
    return uniform[:, None] + np.einsum("tnj,tji->tni", places - centre, gradient)


def splines(part: np.ndarray, count: int) -> np.ndarray:
    """Quadratic B-splines (T, count) of equal intervals of [0, 1] at ``part`` (T,); constant outside."""
    u = np.abs(np.clip(part, 0.0, 1.0)[:, None] * (count - 2) + 0.5 - np.arange(count))
    return np.where(u < 0.5, 0.75 - u**2, 0.5 * np.maximum(0.0, 1.5 - u) ** 2)


def _guesses(context: EffectContext) -> list[tuple[float, ...]]:
    """The whole record; the middle of the path."""
    points = context.rest if context.path is None else context.path.reshape(-1, 3)
    return [(context.duration, *points.double().mean(0).tolist())]


class SmoothForce(NodalEffect):
    r"""$\dot v = \sum_k B_k(t)\, a_k + \sum_l B'_l(t)\, G_l (x - c)$ with ``SPLINES`` and ``GRADIENT_SPLINES``
    quadratic B-splines of equal intervals of [0, span]; constant after it. $x$ is a place in space, not of the body.

    It is not a cause: it represents one that the library lacks. It is fitted with a prior that prefers small
    coefficients that change slowly (``masiv.refinement.discrepancy``).
    """

    name = "smooth_force"
    looks_like = "not a cause: a smooth force that stands in for one that is not known"
    hints = SearchHints(guesses=_guesses, cause=False)
    parameters = (
        *(
            EffectParameter(f"acceleration_{k}_{axis}", "m/s^2", -200.0, 200.0, 0.1)
            for k in range(SPLINES)
            for axis in "xyz"
        ),
        *(
            EffectParameter(f"gradient_{k}_{on}_along_{along}", "1/s^2", -1000.0, 1000.0, 1.0)
            for k in range(GRADIENT_SPLINES)
            for along in "xyz"
            for on in "xyz"
        ),
        EffectParameter("span", "s", 1e-3, 1e3, 0.05, start=1.0),
        *PLACE,
    )
    strengths = STRENGTHS

    def node_velocity(self):
        return _accelerated
