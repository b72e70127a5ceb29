"""Restitution of the ground."""

import taichi as ti

from masiv.effects.context import EffectParameter
from masiv.effects.effect import ContactEffect
from masiv.effects.search_hints import SearchHints


@ti.func
def _rebound(x, v, held, t, dt, dx, c):
    return held + ti.Vector([0.0, c[0] * ti.abs(v[1] - held[1]), 0.0])


class Restitution(ContactEffect):
    r"""$v_i = \hat v_i + e\,|v_{i,n} - \hat v_{i,n}|\,n$: a node at the ground gets back, upwards, the fraction $e$ of
    the normal velocity that the model's contact takes from it.

    On sticky ground, $e = 1$ also frees matter that is pulled away. $e$ is that of the matter at the ground; the bounce
    of the whole body depends on its elasticity too.
    """

    name = "restitution"
    looks_like = "the body bounces higher than it should, or leaves a ground that should have kept it"
    parameters = (EffectParameter("coefficient", "1", 0.0, 1.0, 0.02),)
    hints = SearchHints(nonsmooth=True)

    def contact_velocity(self):
        return _rebound
