"""Quadratic drag whose coefficient falls at a critical Reynolds number."""

import math

import taichi as ti
import torch

from masiv.effects.context import EffectParameter
from masiv.effects.effect import NodalEffect
from masiv.effects.per_body import PerBody
from masiv.effects.search_hints import SearchHints

STEEPNESS = 8.0
"""Slope of the fall in ln Re: C_d goes through 80 % of it while Re grows by a factor of 1.7 (smooth sphere: from 0.5 at
2·10⁵ to 0.1 at 3.7·10⁵; Achenbach 1972)."""
AIR_VISCOSITY = 1.5e-5
"""Kinematic [m²/s], at 20 °C: the medium of a body that was filmed."""
CRITICAL_REYNOLDS_NUMBERS = (0.4e5, 0.8e5, 1.6e5, 3.0e5)
"""Where a search begins: rough balls have their crisis earlier than smooth ones."""


@ti.func
def _slowed(x, v, t, dt, dx, c):
    # The tiny term keeps the derivative of the square root finite at rest.
    speed = ti.sqrt(v.dot(v) + 1e-12)
    beyond = (speed / c[2]) ** STEEPNESS
    return v / (1.0 + (c[0] + (c[1] - c[0]) * beyond / (1.0 + beyond)) * dt * speed)


def _guesses(context):
    return [(number * AIR_VISCOSITY / context.size,) for number in CRITICAL_REYNOLDS_NUMBERS]


class _DragOfSphere(PerBody):
    r"""$c = \rho C_d A / (2 m)$ as of ``quadratic_drag``, and the speed $v = \mathrm{Re}_c\, \mu / (\rho d)$."""

    parameters = (
        EffectParameter("drag_coefficient_below", "1", 0.0, 3.0, 0.05),
        EffectParameter("drag_coefficient_above", "1", 0.0, 3.0, 0.05),
        EffectParameter("critical_reynolds_number", "1", 1e4, 6e5, 1e4, 2e5),
    )
    differs_by_body = True

    def of_body(self, theta, body):
        rate = body.medium_density * math.pi * body.diameter**2 / (8 * body.mass)
        viscous_speed = body.medium_viscosity / (body.medium_density * body.diameter)
        return theta * torch.tensor([rate, rate, viscous_speed], dtype=theta.dtype)

    def guesses(self):
        return [(number,) for number in CRITICAL_REYNOLDS_NUMBERS]


class DragCrisis(NodalEffect):
    r"""$\dot v = -c(|v|)\, |v|\, v$ with $c = c_b + (c_a - c_b)\, s^n / (1 + s^n)$, $s = |v| / v_c$, $n = 8$.

    The flow around a ball turns turbulent at a critical Reynolds number $\mathrm{Re} = \rho |v| d / \mu$, between
    $0.4 \cdot 10^5$ (rough) and $3 \cdot 10^5$ (smooth): its drag coefficient falls from about 0.5 to 0.1 to 0.3.
    Looked for on request: only flights that pass that speed differ from one with ``quadratic_drag``.
    """

    name = "drag_crisis"
    looks_like = "fast flights lose less speed than slow ones would tell: a golf ball, a smooth ball in a hard throw"
    parameters = (
        EffectParameter("coefficient_below", "1/m", 0.0, 20.0, 0.02),
        EffectParameter("coefficient_above", "1/m", 0.0, 20.0, 0.02),
        EffectParameter("critical_speed", "m/s", 0.1, 200.0, 0.1, 2.0),
    )
    strengths = 2
    per_body = _DragOfSphere()
    hints = SearchHints(guesses=_guesses, on_request=True)

    def node_velocity(self):
        return _slowed
