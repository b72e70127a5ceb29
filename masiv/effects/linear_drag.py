"""Drag that grows with speed."""

import math

import taichi as ti

from masiv.effects.context import EffectParameter
from masiv.effects.effect import NodalEffect
from masiv.effects.per_body import PerBody


@ti.func
def _slowed(x, v, t, dt, dx, c):
    return ti.exp(-c[0] * dt) * v


class _StokesDrag(PerBody):
    r"""$k = 3\pi\mu d / m$ of a sphere: bodies share the viscosity $\mu$ of the medium."""

    parameters = (EffectParameter("viscosity_of_medium", "Pa s", 0.0, 10.0, 0.005),)
    differs_by_body = False

    def of_body(self, theta, body):
        return theta * (3 * math.pi * body.diameter / body.mass)

    def violates_bounds(self, theta, body):
        """No shape has more than a few times the drag of a sphere."""
        if float(theta[0]) <= 10 * body.medium_viscosity:
            return None
        return f"it takes a medium of {float(theta[0]):.2g} Pa s, and that has {body.medium_viscosity:.2g} Pa s"


class LinearDrag(NodalEffect):
    r"""$\dot v = -k v$ (Stokes), exact over a substep: $v \leftarrow e^{-k \Delta t} v$."""

    name = "linear_drag"
    looks_like = "everything slows down at a rate, whatever its speed; spins die out as falls do"
    parameters = (EffectParameter("rate", "1/s", 0.0, 20.0, 0.05),)
    per_body = _StokesDrag()

    def node_velocity(self):
        return _slowed
