"""Drag that grows with the square of speed."""

import math

import taichi as ti

from masiv.effects.context import EffectParameter
from masiv.effects.effect import NodalEffect
from masiv.effects.per_body import PerBody


@ti.func
def _slowed(x, v, t, dt, dx, c):
    # The tiny term keeps the derivative of the square root finite at rest.
    return v / (1.0 + c[0] * dt * ti.sqrt(v.dot(v) + 1e-12))


class _NewtonDrag(PerBody):
    r"""$c = \rho C_d A / (2 m)$ with the cross section $A$ of a sphere: bodies of one shape share $C_d$."""

    parameters = (EffectParameter("drag_coefficient", "1", 0.0, 3.0, 0.05),)
    differs_by_body = True

    def of_body(self, theta, body):
        return theta * (body.medium_density * math.pi * body.diameter**2 / (8 * body.mass))


class QuadraticDrag(NodalEffect):
    r"""$\dot v = -c\,|v|\,v$ (Newton), exact over a substep: $v \leftarrow v / (1 + c\,\Delta t\,|v|)$."""

    name = "quadratic_drag"
    looks_like = "fast parts slow down most: a flight loses speed early, a slow spin hardly changes"
    parameters = (EffectParameter("coefficient", "1/m", 0.0, 20.0, 0.02),)
    per_body = _NewtonDrag()

    def node_velocity(self):
        return _slowed
