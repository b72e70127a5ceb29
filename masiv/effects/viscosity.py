"""Viscosity inside the body."""

import taichi as ti

from masiv.effects.context import EffectParameter
from masiv.effects.effect import StressEffect
from masiv.effects.stability import SubstepDemand
from masiv.kernels.tensor import deviator


@ti.func
def _viscous(tau, f, c_affine, c):
    return tau + (f.determinant() * c[0]) * deviator(c_affine + c_affine.transpose())


class Viscosity(StressEffect):
    r"""Kelvin-Voigt: $\tau \leftarrow \tau + 2 J \eta \operatorname{dev} D$, with $D$ the symmetric part of the
    velocity gradient.

    There is no bulk part: bodies hardly change their volume, so a video does not determine it.
    """

    name = "viscosity"
    looks_like = "wobbles and bounces die out, while flight and spin are as they were"
    parameters = (EffectParameter("viscosity", "Pa s", 0.0, 500.0, 10.0),)

    def particle_stress(self):
        return _viscous

    def substep_demand(self, theta, context):
        return SubstepDemand(viscosity=float(theta[0]))
