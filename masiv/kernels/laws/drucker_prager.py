"""Sand: frictional plasticity without cohesion."""

import taichi as ti

from masiv.kernels.hencky import hencky_strain, hencky_stress, with_strain_change
from masiv.kernels.tensor import deviator


@ti.func
def drucker_prager(f, c):
    """c = (mu, lambda, alpha) [Pa, Pa, 1], alpha = sqrt(2/3) 2 sin(phi)/(3 - sin(phi)), no cohesion
    (Klar et al. 2016, "Drucker-Prager elastoplasticity for sand animation", section 6)."""
    strain = hencky_strain(f)
    trace = strain.trace()
    dev = deviator(strain)
    size = dev.norm()
    excess = size + (3.0 * c[1] + 2.0 * c[0]) / (2.0 * c[0]) * trace * c[2]
    kept = f
    if trace >= 0.0 or (excess > 0.0 and size > 0.0):
        change = -strain
        if trace < 0.0:
            change = -(excess / size) * dev
        strain += change
        kept = with_strain_change(f, change)
    return kept, hencky_stress(strain, c[0], c[1])
