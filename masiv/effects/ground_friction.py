"""Ground that lets go sideways."""

import taichi as ti

from masiv.effects.context import EffectParameter
from masiv.effects.effect import ContactEffect
from masiv.effects.search_hints import SearchHints


@ti.func
def _sliding(x, v, held, t, dt, dx, c):
    out = held
    lost = ti.Vector([v[0] - held[0], 0.0, v[2] - held[2]])
    speed = ti.sqrt(lost.dot(lost) + 1e-20)  # with a derivative at rest
    pressed = ti.abs(v[1] - held[1])
    if c[0] * speed > pressed:
        out = held + (1.0 - pressed / (c[0] * speed)) * lost
    return out


class GroundFriction(ContactEffect):
    r"""Coulomb friction with the ground:

    $$v_i = \hat v_i + \max\!\left(0,\; 1 - \frac{\mu\,|\Delta v_n|}{|\Delta v_t|}\right) \Delta v_t,
    \qquad \Delta v = v_i - \hat v_i$$

    with normal part n (y) and tangential part t. The parameter is the slipperiness $1/\mu$: zero in a model whose
    ground holds what is pressed to it (contact sticky, release). If friction is declared too, the smaller coefficient
    counts. On sticky ground the normal part also counts if it keeps matter from leaving. Little slips if $\mu$ is
    large, so the response at zero is weak: a score needs a change as large as ``step`` ($\mu$ = 2).
    """

    name = "ground_friction"
    looks_like = "after it lands the body slides on, where it should have stuck"
    parameters = (EffectParameter("slipperiness", "1", 0.0, 100.0, 0.5),)
    hints = SearchHints(nonsmooth=True)

    def contact_velocity(self):
        return _sliding
