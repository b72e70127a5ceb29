"""Elastoplastic solid with a constant yield stress."""

import taichi as ti

from masiv.kernels.hencky import hencky_strain, hencky_stress, with_strain_change
from masiv.kernels.tensor import deviator


@ti.func
def von_mises(f, c):
    """c = (mu, lambda, yield stress) [Pa]. Hencky elasticity, return to |dev eps| = yield / (2 mu), so that |dev tau| =
    yield (Simo 1992; PAC-NeRF's and textbooks' yield stress, of uniaxial tension, is sqrt(3/2) times it)."""
    strain = hencky_strain(f)
    dev = deviator(strain)
    size = dev.norm()
    limit = c[2] / (2.0 * c[0])
    kept = f
    if size > limit:
        change = (limit / size - 1.0) * dev
        strain += change
        kept = with_strain_change(f, change)
    return kept, hencky_stress(strain, c[0], c[1])
