"""Physics that the library of effects does not have: what does refine say of it?"""

import taichi as ti

from masiv.effects.context import EffectParameter
from masiv.effects.effect import NodalEffect, StressEffect


@ti.func
def _attracted(x, v, t, dt, dx, c):
    arm = ti.Vector([c[1], c[2], c[3]]) - x
    distance = ti.sqrt(arm.dot(arm) + 0.01)
    return v + dt * c[0] / (distance * distance * distance) * arm


@ti.func
def _gust(x, v, t, dt, dx, c):
    out = v
    if t >= c[1] and t < c[2]:
        out += dt * ti.Vector([c[0], 0.0, 0.3 * c[0]])
    return out


@ti.func
def _swollen(tau, f, c_affine, c):
    return tau - c[0] * ti.Matrix.identity(float, 3)


class Attraction(NodalEffect):
    """A charged or magnetic body near the path: dv/dt = k r / |r|^3."""

    name = "attraction"
    looks_like = "the path bends towards a point"
    parameters = (
        EffectParameter("strength", "m^3/s^2", 0.0, 10.0, 0.02),
        *(EffectParameter(axis, "m", -10.0, 10.0, 0.05) for axis in "xyz"),
    )

    def node_velocity(self):
        return _attracted


class Gust(NodalEffect):
    """A push that begins and ends in mid-flight."""

    name = "gust"
    looks_like = "a jolt"
    parameters = (
        EffectParameter("acceleration", "m/s^2", -100.0, 100.0, 0.5),
        EffectParameter("begin", "s", 0.0, 10.0, 0.02),
        EffectParameter("end", "s", 0.0, 10.0, 0.02),
    )

    def node_velocity(self):
        return _gust


class Swelling(StressEffect):
    """Pressure from within, as of a body that takes up water: tau - p I."""

    name = "swelling"
    looks_like = "the body grows"
    parameters = (EffectParameter("pressure", "Pa", 0.0, 1e6, 100.0),)

    def particle_stress(self):
        return _swollen


UNKNOWN = {effect.name: effect for effect in (Attraction(), Gust(), Swelling())}
