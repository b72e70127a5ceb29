"""Tensor algebra of constitutive laws as Taichi functions, without a singular value decomposition where a gradient is
needed: the derivative of sorted singular values is undefined at F = I, where every rollout starts."""

import taichi as ti


@ti.func
def identity3():
    return ti.Matrix([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


@ti.func
def deviator(a):
    return a - (a.trace() / 3.0) * identity3()


@ti.func
def power_of_third(x, n: ti.template()):
    """x^(n / 3). A literal exponent would be rounded to float32 in a float64 kernel."""
    return ti.exp(n * ti.log(x) / 3.0)


@ti.func
def isochoric_strain(f):
    """det F, the isochoric left Cauchy-Green tensor J^(-2/3) F F^T, and its inverse."""
    j = f.determinant()
    b = power_of_third(j, -2) * (f @ f.transpose())
    return j, b, b.inverse()


@ti.func
def neural_stress(f, c):
    """Kirchhoff stress from coefficients c = (g1, g2, kappa, m) [Pa]:
    g1 dev(b) - g2 dev(b^-1) + (kappa (J - 1/J)/2 + m (tr b - 3)) I, b isochoric. Zero at F = I whatever c is."""
    j, b, b_inverse = isochoric_strain(f)
    pressure = c[2] * 0.5 * (j - 1.0 / j) + c[3] * (b.trace() - 3.0)
    return c[0] * deviator(b) - c[1] * deviator(b_inverse) + pressure * identity3()


@ti.func
def neural_flow(f, c):
    """Elastic F after a share c[0] of its isochoric and c[1] of its volumetric Hencky strain has flowed.

    F <- J^(-c1/3) M F with M the Cayley map of Gamma = c0/4 dev(b - b^-1) / sqrt(1 + q/3), q = (tr b + tr b^-1 - 6)/2,
    scaled to det M = 1: the exponential return mapping of finite plasticity to third order (Simo 1992). F = I is kept.
    """
    j, b, b_inverse = isochoric_strain(f)
    q = 0.5 * (b.trace() + b_inverse.trace()) - 3.0
    half = (0.125 * c[0] / ti.sqrt(1.0 + q / 3.0)) * deviator(b - b_inverse)
    m = (identity3() + half).inverse() @ (identity3() - half)
    return (power_of_third(m.determinant(), -1) * ti.pow(j, -c[1] / 3.0)) * (m @ f)


@ti.func
def isochoric_adjoint(f, j, b, b_bar, j_bar):
    """Adjoint of (J, b) = (det F, J^(-2/3) F F^T) with respect to F."""
    along_j = j_bar * j - 2.0 * (b_bar * b).sum() / 3.0
    return power_of_third(j, -2) * ((b_bar + b_bar.transpose()) @ f) + along_j * f.inverse().transpose()


@ti.func
def neural_stress_adjoint(f, c, stress_bar):
    """Adjoints of F and c in ``neural_stress``."""
    j, b, b_inverse = isochoric_strain(f)
    trace = stress_bar.trace()
    dev = deviator(stress_bar)
    c_bar = ti.Vector(
        [(b * dev).sum(), -(b_inverse * dev).sum(), 0.5 * (j - 1.0 / j) * trace, (b.trace() - 3.0) * trace]
    )
    b_bar = c[0] * dev + c[1] * (b_inverse @ dev @ b_inverse) + (c[3] * trace) * identity3()
    j_bar = 0.5 * c[2] * (1.0 + 1.0 / (j * j)) * trace
    return isochoric_adjoint(f, j, b, b_bar, j_bar), c_bar


@ti.func
def neural_flow_adjoint(f, c, out_bar):
    """Adjoints of F and c in ``neural_flow``, from that of its result."""
    j, b, b_inverse = isochoric_strain(f)
    q = 0.5 * (b.trace() + b_inverse.trace()) - 3.0
    per_share = 0.125 / ti.sqrt(1.0 + q / 3.0)
    direction = deviator(b - b_inverse)
    half = (c[0] * per_share) * direction
    a_inverse = (identity3() + half).inverse()
    m = a_inverse @ (identity3() - half)
    scale = power_of_third(m.determinant(), -1) * ti.pow(j, -c[1] / 3.0)
    log_scale_bar = scale * (out_bar * (m @ f)).sum()
    m_bar = scale * (out_bar @ f.transpose()) - (log_scale_bar / 3.0) * m.inverse().transpose()
    half_bar = -1.0 * (a_inverse.transpose() @ m_bar @ (m.transpose() + identity3()))
    factor_bar = (half_bar * direction).sum()
    q_bar = -factor_bar * c[0] * per_share / (6.0 + 2.0 * q)
    push = (c[0] * per_share) * deviator(half_bar)
    squared = b_inverse @ b_inverse
    b_bar = push + b_inverse @ push @ b_inverse + (0.5 * q_bar) * (identity3() - squared)
    j_bar = -log_scale_bar * c[1] / (3.0 * j)
    f_bar = scale * (m.transpose() @ out_bar) + isochoric_adjoint(f, j, b, b_bar, j_bar)
    return f_bar, ti.Vector([factor_bar * per_share, -log_scale_bar * ti.log(j) / 3.0])


@ti.func
def invariants(f):
    """(ln J, I1 - 3, I2 - 3) of the isochoric left Cauchy-Green tensor."""
    j, b, b_inverse = isochoric_strain(f)
    return ti.Vector([ti.log(j), b.trace() - 3.0, b_inverse.trace() - 3.0])


@ti.func
def invariants_adjoint(f, bar):
    """Adjoint of F in ``invariants``."""
    j, b, b_inverse = isochoric_strain(f)
    b_bar = bar[1] * identity3() - bar[2] * (b_inverse @ b_inverse)
    return isochoric_adjoint(f, j, b, b_bar, bar[0] / j)


@ti.func
def neo_hookean(f, c):
    """c = (mu, lambda) [Pa]. tau = mu (b - I) + lambda ln J I (Bonet & Wood 2008, eq. 6.28). No plasticity."""
    tau = c[0] * (f @ f.transpose() - identity3()) + (c[1] * ti.log(f.determinant())) * identity3()
    return f, tau


@ti.func
def water(f, c):
    """c = (lambda,) [Pa]. tau = lambda J (J - 1) I, and F keeps only its volume (NCLaw, Ma et al. 2023)."""
    j = f.determinant()
    return power_of_third(j, 1) * identity3(), c[0] * j * (j - 1.0) * identity3()


@ti.func
def hencky(u, strain, v, mu, lam):
    """F and tau of principal Hencky strains: tau = U (2 mu eps + lambda tr(eps)) U^T."""
    stretch = ti.exp(strain)
    principal = 2.0 * mu * strain + lam * strain.sum()
    zero = 0.0 * stretch[0]
    f = u @ ti.Matrix([[stretch[0], zero, zero], [zero, stretch[1], zero], [zero, zero, stretch[2]]]) @ v.transpose()
    tau = (
        u
        @ ti.Matrix([[principal[0], zero, zero], [zero, principal[1], zero], [zero, zero, principal[2]]])
        @ u.transpose()
    )
    return f, tau


@ti.func
def principal_strain(f):
    u, s, v = ti.svd(f)
    return u, ti.log(ti.Vector([s[0, 0], s[1, 1], s[2, 2]])), v


@ti.func
def von_mises(f, c):
    """c = (mu, lambda, yield stress) [Pa]. Hencky elasticity, return to |dev eps| = yield / (2 mu), so that |dev tau| =
    yield (Simo 1992; PAC-NeRF's and textbooks' yield stress, of uniaxial tension, is sqrt(3/2) times it)."""
    u, strain, v = principal_strain(f)
    mean = strain.sum() / 3.0
    dev = strain - mean
    size = dev.norm()
    limit = c[2] / (2.0 * c[0])
    kept = strain
    if size > limit:
        kept = mean + (limit / size) * dev
    return hencky(u, kept, v, c[0], c[1])


@ti.func
def drucker_prager(f, c):
    """c = (mu, lambda, alpha) [Pa, Pa, 1], alpha = sqrt(2/3) 2 sin(phi)/(3 - sin(phi)), no cohesion
    (Klar et al. 2016, "Drucker-Prager elastoplasticity for sand animation", section 6)."""
    u, strain, v = principal_strain(f)
    trace = strain.sum()
    dev = strain - trace / 3.0
    size = dev.norm()
    kept = strain
    excess = size + (3.0 * c[1] + 2.0 * c[0]) / (2.0 * c[0]) * trace * c[2]
    if trace >= 0.0 or size == 0.0:
        if trace >= 0.0:
            kept = 0.0 * strain
    elif excess > 0.0:
        kept = strain - (excess / size) * dev
    return hencky(u, kept, v, c[0], c[1])


@ti.func
def newtonian(f, c):
    """c = (G, K/7, share) [Pa, Pa, 1]: a Maxwell fluid whose relaxation time is too short to be seen.

    A substep keeps 1 - share = 1 / (1 + dt G / eta) of the isochoric strain (backward Euler), so that at a steady rate
    D the strain kept is D eta / G and the stress 2 eta D, at any dt. A law sees no velocity gradient, and an explicit
    viscous stress would bound the substep by dx^2; this one is bounded by the speed of sound. Pressure is Tait's with
    exponent 7, tau = K/7 (J - J^-6) I (Becker & Teschner 2007; PAC-NeRF's fluid has viscosity mu / 2 and K = 7 kappa).
    """
    kept = neural_flow(f, ti.Vector([c[2], 0.0 * c[2]]))
    j = kept.determinant()
    b = power_of_third(j, -2) * (kept @ kept.transpose())
    j2 = j * j
    return kept, c[0] * deviator(b) + (c[1] * (j - 1.0 / (j2 * j2 * j2))) * identity3()


@ti.func
def non_newtonian(f, c):
    """c = (mu, lambda, yield stress, a) [Pa, Pa, Pa, 1], a = eta / (mu dt). A Bingham body on Hencky elasticity.

    |dev tau| = yield + 2 eta |plastic rate| (Perzyna's overstress with exponent 1, backward Euler), in simple shear
    yield / sqrt(2) + eta rate: the viscoplastic return mapping of Yue et al. 2015, "Continuum foam", as in PAC-NeRF,
    whose yield stress is sqrt(3/2) and whose plastic viscosity is twice those here.
    """
    u, strain, v = principal_strain(f)
    mean = strain.sum() / 3.0
    dev = strain - mean
    size = dev.norm()
    limit = c[2] / (2.0 * c[0])
    kept = strain
    if size > limit:
        kept = mean + ((limit + (size - limit) * c[3] / (1.0 + c[3])) / size) * dev
    return hencky(u, kept, v, c[0], c[1])


CLASSICAL = {
    "neo_hookean": neo_hookean,
    "water": water,
    "newtonian": newtonian,
    "von_mises": von_mises,
    "non_newtonian": non_newtonian,
    "drucker_prager": drucker_prager,
}
