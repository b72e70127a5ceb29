"""Drag that grows with the square of speed."""

import math

import taichi as ti

from masiv.effects.effect import Effect, EffectParameter


@ti.func
def _slowed(x, v, held, t, dt, dx, c):
    # The tiny term keeps the derivative of the square root finite at rest.
    return v / (1.0 + c[0] * dt * ti.sqrt(v.dot(v) + 1e-12))


class QuadraticDrag(Effect):
    """dv/dt = -c |v| v (Newton), exact over a substep. For a body in air c = rho_air C_d A / (2 m)."""

    name = "quadratic_drag"
    looks_like = "fast parts slow down most: a throw loses speed early, a slow spin hardly changes"
    parameters = (EffectParameter("coefficient", "1/m", 0.0, 20.0, 0.02),)
    on_grid = "nodes"
    per_body = True
    shared = (EffectParameter("drag_coefficient", "1", 0.0, 3.0, 0.05),)

    def of(self, theta, body):
        """C_d -> c, with A that of a sphere."""
        return theta * (body.medium_density * math.pi * body.diameter**2 / (8 * body.mass))

    def node_velocity(self):
        return _slowed
