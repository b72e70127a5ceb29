"""Viscoplastic solid (Bingham)."""

import taichi as ti

from masiv.kernels.hencky import hencky_strain, hencky_stress, with_strain_change
from masiv.kernels.tensor import deviator


@ti.func
def non_newtonian(f, c):
    """c = (mu, lambda, yield stress, a) [Pa, Pa, Pa, 1], a = eta / (mu dt). A Bingham body on Hencky elasticity.

    |dev tau| = yield + 2 eta |plastic rate| (Perzyna's overstress with exponent 1, backward Euler), in simple shear
    yield / sqrt(2) + eta rate: the viscoplastic return mapping of Yue et al. 2015, "Continuum foam", as in PAC-NeRF,
    whose yield stress is sqrt(3/2) and whose plastic viscosity is twice those here.
    """
    strain = hencky_strain(f)
    dev = deviator(strain)
    size = dev.norm()
    limit = c[2] / (2.0 * c[0])
    kept = f
    if size > limit:
        change = -((size - limit) / size / (1.0 + c[3])) * dev
        strain += change
        kept = with_strain_change(f, change)
    return kept, hencky_stress(strain, c[0], c[1])
