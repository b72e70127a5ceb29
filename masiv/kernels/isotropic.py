"""Isotropic laws with coefficients that depend on the strain invariants: stress and flow as functions of F and these
coefficients, and their adjoints by hand. The neural law and the adapter give the coefficients."""

import taichi as ti

from masiv.kernels.tensor import adjugate, deviator, identity3, sandwich, symmetric_part, symmetric_product


@ti.func
def isochoric_strain(f):
    """(J^(-2/3), J, ln J, b, b^-1) with J = det F and b = J^(-2/3) F F^T, the isochoric left Cauchy-Green tensor.

    Functions of a law in invariants take this in place of F: it is most of their cost."""
    j = f.determinant()
    log_j = ti.log(j)
    shrink = ti.exp(-2.0 * log_j / 3.0)
    b = shrink * (f @ f.transpose())
    return shrink, j, log_j, b, adjugate(b)  # det b = 1


@ti.func
def strain_adjoint(f, strain, log_j_bar, b_bar, b_inverse_bar):
    """Adjoint of F in ``isochoric_strain``, from those of ln J, b and b^-1, the last two symmetric."""
    shrink, b, b_inverse = strain[0], strain[3], strain[4]
    along = log_j_bar - 2.0 * ((b_bar * b).sum() - (b_inverse_bar * b_inverse).sum()) / 3.0
    return shrink * ((2.0 * (b_bar - sandwich(b_inverse, b_inverse_bar)) + along * b_inverse) @ f)


@ti.func
def invariants(strain):
    """(ln J, I1 - 3, I2 - 3) of the isochoric left Cauchy-Green tensor."""
    return ti.Vector([strain[2], strain[3].trace() - 3.0, strain[4].trace() - 3.0])


@ti.func
def invariants_adjoint(f, bar):
    """Adjoint of F in the ``invariants`` of its strain."""
    return strain_adjoint(f, isochoric_strain(f), bar[0], bar[1] * identity3(), bar[2] * identity3())


@ti.func
def stress(strain, c):
    """Kirchhoff stress from coefficients c = (g1, g2, kappa, m) [Pa]:
    g1 dev(b) - g2 dev(b^-1) + (kappa (J - 1/J)/2 + m (tr b - 3)) I. Zero at F = I for all c."""
    j, b, b_inverse = strain[1], strain[3], strain[4]
    pressure = c[2] * 0.5 * (j - 1.0 / j) + c[3] * (b.trace() - 3.0)
    return c[0] * deviator(b) - c[1] * deviator(b_inverse) + pressure * identity3()


@ti.func
def stress_adjoint(strain, c, stress_bar):
    """Adjoints of c, ln J, b and b^-1 in ``stress``."""
    j, b, b_inverse = strain[1], strain[3], strain[4]
    trace = stress_bar.trace()
    dev = symmetric_part(deviator(stress_bar))
    c_bar = ti.Vector(
        [(b * dev).sum(), -(b_inverse * dev).sum(), 0.5 * (j - 1.0 / j) * trace, (b.trace() - 3.0) * trace]
    )
    return c_bar, 0.5 * c[2] * (j + 1.0 / j) * trace, c[0] * dev + (c[3] * trace) * identity3(), -c[1] * dev


@ti.func
def cayley(h):
    """(I + H)^-1, (I - H)^-1 and ln det((I + H)^-1 (I - H)) of a symmetric H without a trace."""
    square = symmetric_product(h, h)
    even, odd = 1.0 - 0.5 * square.trace(), (h * square).sum() / 3.0  # det(I + H) = even + odd
    outer = square + even * identity3()
    return (outer - h) / (even + odd), (outer + h) / (even - odd), ti.log((even - odd) / (even + odd))


@ti.func
def flow_direction(strain):
    """dev(b - b^-1), and sqrt(1 + q/3) / 8 that divides it, with q = (tr b + tr b^-1 - 6)/2."""
    b, b_inverse = strain[3], strain[4]
    q = 0.5 * (b.trace() + b_inverse.trace()) - 3.0
    return deviator(b - b_inverse), 0.125 / ti.sqrt(1.0 + q / 3.0)


@ti.func
def flow(f, strain, c):
    """Elastic F after a share c[0] of its isochoric and c[1] of its volumetric Hencky strain has flowed.

    F <- J^(-c1/3) M F with M the Cayley map of Gamma = c0/4 dev(b - b^-1) / sqrt(1 + q/3), q = (tr b + tr b^-1 - 6)/2,
    scaled to det M = 1: the exponential return mapping of finite plasticity to third order (Simo 1992). F = I is kept.
    """
    direction, per_share = flow_direction(strain)
    below, _, log_det = cayley((c[0] * per_share) * direction)
    scale = ti.exp(-(log_det + c[1] * strain[2]) / 3.0)
    return scale * ((2.0 * below - identity3()) @ f)


@ti.func
def flow_adjoint(f, strain, c, out, out_bar):
    """Adjoints of c, of F at constant strain, of ln J, b and b^-1 in ``flow``, whose result was ``out``."""
    direction, per_share = flow_direction(strain)
    factor = c[0] * per_share
    below, above, log_det = cayley(factor * direction)
    scale = ti.exp(-(log_det + c[1] * strain[2]) / 3.0)
    log_scale_bar = (out_bar * out).sum()
    # M = 2 (I + H)^-1 - I, so that dM = -2 (I + H)^-1 dH (I + H)^-1.
    m_bar = symmetric_part(scale * (out_bar @ f.transpose()))
    half_bar = (log_scale_bar / 3.0) * (below + above) - 2.0 * sandwich(below, m_bar)
    factor_bar = (half_bar * direction).sum()
    # 64 per_share^2 = 1 / (1 + q/3)
    q_bar = -factor_bar * factor * 64.0 * per_share * per_share / 6.0
    push, same = factor * deviator(half_bar), (0.5 * q_bar) * identity3()
    c_bar = ti.Vector([factor_bar * per_share, -log_scale_bar * strain[2] / 3.0])
    f_bar = scale * ((2.0 * below - identity3()) @ out_bar)
    return c_bar, f_bar, -log_scale_bar * c[1] / 3.0, push + same, same - push
