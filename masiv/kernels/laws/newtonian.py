"""Viscous fluid."""

import taichi as ti

from masiv.kernels import isotropic
from masiv.kernels.tensor import deviator, identity3, power_of_third


@ti.func
def newtonian(f, c):
    """c = (G, K/7, share) [Pa, Pa, 1]: a Maxwell fluid whose relaxation time is too short to be seen.

    A substep keeps 1 - share = 1 / (1 + dt G / eta) of the isochoric strain (backward Euler), so that at a steady rate
    D the strain kept is D eta / G and the stress 2 eta D, at any dt. A law sees no velocity gradient, and an explicit
    viscous stress would bound the substep by dx^2; this one is bounded by the speed of sound. Pressure is Tait's with
    exponent 7, tau = K/7 (J - J^-6) I (Becker & Teschner 2007; PAC-NeRF's fluid has viscosity mu / 2 and K = 7 kappa).
    """
    kept = isotropic.flow(f, isotropic.isochoric_strain(f), ti.Vector([c[2], 0.0 * c[2]]))
    j = kept.determinant()
    b = power_of_third(j, -2) * (kept @ kept.transpose())
    j2 = j * j
    return kept, c[0] * deviator(b) + (c[1] * (j - 1.0 / (j2 * j2 * j2))) * identity3()
