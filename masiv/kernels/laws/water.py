"""Compressible fluid without shear strength."""

import taichi as ti

from masiv.kernels.tensor import identity3, power_of_third


@ti.func
def water(f, c):
    """c = (lambda,) [Pa]. tau = lambda J (J - 1) I, and F keeps only its volume (NCLaw, Ma et al. 2023)."""
    j = f.determinant()
    return power_of_third(j, 1) * identity3(), c[0] * j * (j - 1.0) * identity3()
