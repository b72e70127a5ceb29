"""Viscosity inside the body."""

import taichi as ti

from masiv.effects.effect import Effect, EffectParameter
from masiv.kernels.tensor import deviator


@ti.func
def _thickened(tau, f, c_affine, c):
    return tau + (f.determinant() * c[0]) * deviator(c_affine + c_affine.transpose())


class Viscosity(Effect):
    """Kelvin-Voigt: a dashpot beside the law, tau += J 2 eta dev(D), D the symmetric part of the velocity gradient.

    There is no bulk part: the bodies of this method hardly change volume, so that a video says nothing about it.
    """

    name = "viscosity"
    looks_like = "wobbles and bounces die out, while flight and spin are as they were"
    parameters = (EffectParameter("viscosity", "Pa s", 0.0, 500.0, 10.0),)
    on_stress = True

    def particle_stress(self):
        return _thickened
