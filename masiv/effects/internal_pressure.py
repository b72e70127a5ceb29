"""A gas inside the body that is at a higher pressure than the surroundings."""

import taichi as ti

from masiv.effects.context import EffectParameter
from masiv.effects.effect import StressEffect
from masiv.effects.search_hints import SearchHints
from masiv.kernels.tensor import identity3


@ti.func
def _pressurised(tau, f, c_affine, c):
    return tau - c[0] * identity3()


class InternalPressure(StressEffect):
    r"""$\tau \leftarrow \tau - p_0 I$: a gas that fills the body and stays at its temperature (Boyle's law).

    The Cauchy stress of the gas is $-(p_0 / J) I$, so its Kirchhoff stress $\tau = J \sigma$ is constant. $p_0$ is the
    pressure above that of the surroundings where $J = 1$, the shape at frame 0. The body is not in equilibrium there:
    it swells, to the stretch $\lambda$ at which the law's $\tau(\lambda I)$ is $p_0 I$. A body that was squeezed and is
    let go moves in the same way. Looked for on request: few motions show how a body breathes.
    """

    name = "internal_pressure"
    looks_like = "the body swells, or shrinks, as soon as it is let go, and breathes"
    parameters = (EffectParameter("pressure", "Pa", -2e4, 2e4, 50.0),)
    hints = SearchHints(on_request=True)

    def particle_stress(self):
        return _pressurised
