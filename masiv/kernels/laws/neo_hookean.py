"""Neo-Hookean solid."""

import taichi as ti

from masiv.kernels.tensor import identity3


@ti.func
def neo_hookean(f, c):
    """c = (mu, lambda) [Pa]. tau = mu (b - I) + lambda ln J I (Bonet & Wood 2008, eq. 6.28). No plasticity."""
    tau = c[0] * (f @ f.transpose() - identity3()) + (c[1] * ti.log(f.determinant())) * identity3()
    return f, tau
