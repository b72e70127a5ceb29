"""Tensor algebra of constitutive laws as Taichi functions, without a singular value decomposition: the derivative of
sorted singular values is undefined at F = I, where every rollout starts, and Taichi's is slow and stops at 1e-6."""

import taichi as ti

ARTANH = tuple((2 * k - 1, 2 * k + 1) for k in range(1, 9))
EXPM1 = tuple((1, k) for k in range(2, 9))
"""artanh(z) / z in z^2 and (exp(x) - 1) / x in x for ``power_series``: float64's digits where tr(Z^2) < 0.02, |X|^2 <
0.004."""


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
def neural_stress(strain, c):
    """Kirchhoff stress from coefficients c = (g1, g2, kappa, m) [Pa]:
    g1 dev(b) - g2 dev(b^-1) + (kappa (J - 1/J)/2 + m (tr b - 3)) I. Zero at F = I whatever c is."""
    j, b, b_inverse = strain[1], strain[3], strain[4]
    pressure = c[2] * 0.5 * (j - 1.0 / j) + c[3] * (b.trace() - 3.0)
    return c[0] * deviator(b) - c[1] * deviator(b_inverse) + pressure * identity3()


@ti.func
def neural_stress_adjoint(strain, c, stress_bar):
    """Adjoints of c, ln J, b and b^-1 in ``neural_stress``."""
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
def neural_flow(f, strain, c):
    """Elastic F after a share c[0] of its isochoric and c[1] of its volumetric Hencky strain has flowed.

    F <- J^(-c1/3) M F with M the Cayley map of Gamma = c0/4 dev(b - b^-1) / sqrt(1 + q/3), q = (tr b + tr b^-1 - 6)/2,
    scaled to det M = 1: the exponential return mapping of finite plasticity to third order (Simo 1992). F = I is kept.
    """
    direction, per_share = flow_direction(strain)
    below, _, log_det = cayley((c[0] * per_share) * direction)
    scale = ti.exp(-(log_det + c[1] * strain[2]) / 3.0)
    return scale * ((2.0 * below - identity3()) @ f)


@ti.func
def neural_flow_adjoint(f, strain, c, out, out_bar):
    """Adjoints of c, F where the strain is held, ln J, b and b^-1 in ``neural_flow``, whose result was ``out``."""
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


@ti.func
def invariants(strain):
    """(ln J, I1 - 3, I2 - 3) of the isochoric left Cauchy-Green tensor."""
    return ti.Vector([strain[2], strain[3].trace() - 3.0, strain[4].trace() - 3.0])


@ti.func
def invariants_adjoint(f, bar):
    """Adjoint of F in the ``invariants`` of its strain."""
    return strain_adjoint(f, isochoric_strain(f), bar[0], bar[1] * identity3(), bar[2] * identity3())


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
def symmetric(xx, xy, xz, yy, yz, zz):
    return ti.Matrix([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


@ti.func
def symmetric_part(a):
    return symmetric(
        a[0, 0], 0.5 * (a[0, 1] + a[1, 0]), 0.5 * (a[0, 2] + a[2, 0]),
        a[1, 1], 0.5 * (a[1, 2] + a[2, 1]), a[2, 2],
    )  # fmt: skip


@ti.func
def sandwich(a, x):
    """A X A of symmetric matrices."""
    return symmetric_product(a @ x, a)


@ti.func
def symmetric_product(a, b):
    """A B where both it and B are symmetric: of symmetric matrices, where they have the same eigenvectors."""
    return symmetric(
        a[0, 0] * b[0, 0] + a[0, 1] * b[0, 1] + a[0, 2] * b[0, 2],
        a[0, 0] * b[0, 1] + a[0, 1] * b[1, 1] + a[0, 2] * b[1, 2],
        a[0, 0] * b[0, 2] + a[0, 1] * b[1, 2] + a[0, 2] * b[2, 2],
        a[1, 0] * b[0, 1] + a[1, 1] * b[1, 1] + a[1, 2] * b[1, 2],
        a[1, 0] * b[0, 2] + a[1, 1] * b[1, 2] + a[1, 2] * b[2, 2],
        a[2, 0] * b[0, 2] + a[2, 1] * b[1, 2] + a[2, 2] * b[2, 2],
    )


@ti.func
def adjugate(s):
    """det(S) S^-1 of a symmetric matrix."""
    return symmetric(
        s[1, 1] * s[2, 2] - s[1, 2] * s[1, 2],
        s[0, 2] * s[1, 2] - s[0, 1] * s[2, 2],
        s[0, 1] * s[1, 2] - s[0, 2] * s[1, 1],
        s[0, 0] * s[2, 2] - s[0, 2] * s[0, 2],
        s[0, 1] * s[0, 2] - s[1, 2] * s[0, 0],
        s[0, 0] * s[1, 1] - s[0, 1] * s[0, 1],
    )


@ti.func
def power_series(a, ratios: ti.template()):
    """I + r1 A (I + r2 A (I + ...)) of a symmetric matrix; by the theorem of Cayley and Hamilton each bracket is
    x I + y A + z A^2. Ratios are pairs of integers: a literal fraction would be rounded to float32."""
    minors = adjugate(a)
    first, second = a.trace(), minors.trace()
    third = a[0, 0] * minors[0, 0] + a[0, 1] * minors[0, 1] + a[0, 2] * minors[0, 2]
    x, y, z = ti.one(first), ti.zero(first), ti.zero(first)
    for k in ti.static(range(len(ratios))):
        n, d = ti.static(ratios[-1 - k])
        x, y, z = 1.0 + z * third * n / d, (x - z * second) * n / d, (y + z * first) * n / d
    # A^2 = adj(A) + tr(A) A - tr(adj(A)) I
    return (x - z * second) * identity3() + (y + z * first) * a + z * minors


@ti.func
def isolated_root(r):
    """Largest root of x^3 - 3 x = 2 r for r in [0, 1], a simple one: a cubic in r, off by 1e-4, and two steps of
    Newton's method."""
    x = 1.73212 + r * (0.33081 + r * (-0.08176 + r * 0.01889))
    for _ in ti.static(range(2)):
        x = (2.0 * x * x * x + 2.0 * r) / (3.0 * x * x - 3.0)
    return x


@ti.func
def eigenvectors(a):
    """Those of a symmetric A with tr(A) = 0 and tr(A^2) = 6, as columns.

    The eigenvalue furthest from 0 is at least sqrt(3) from the other two: it and its vector are well conditioned
    however close these are to each other, and one Jacobi rotation separates them (Scherzinger & Dohrmann 2008, "A
    robust algorithm for finding the eigenvalues and eigenvectors of 3x3 symmetric matrices").
    """
    r = 0.5 * a.determinant()
    sign = ti.select(r < 0.0, -1.0, 1.0)
    # The adjugate of a matrix with one eigenvalue 0 is a multiple of w w^T.
    minors = adjugate(a - (sign * isolated_root(ti.min(ti.abs(r), 1.0))) * identity3())
    w = minors[:, 0]
    if minors[1, 1] > minors[0, 0] and minors[1, 1] >= minors[2, 2]:
        w = minors[:, 1]
    elif minors[2, 2] > minors[0, 0]:
        w = minors[:, 2]
    w /= w.norm()
    # Two vectors orthogonal to it (Duff et al. 2017, "Building an orthonormal basis, revisited").
    up = ti.select(w[2] < 0.0, -1.0, 1.0)
    k = -1.0 / (up + w[2])
    u = ti.Vector([1.0 + up * w[0] * w[0] * k, up * w[0] * w[1] * k, -up * w[0]])
    v = ti.Vector([w[0] * w[1] * k, up + w[1] * w[1] * k, -w[1]])
    # The smaller of the two rotations that make u^T A v zero (Golub & Van Loan 2013, section 8.5.2).
    av = a @ v
    twice = 2.0 * u.dot(av)
    gap = v.dot(av) - u.dot(a @ u)
    t = twice / ti.max(ti.abs(gap) + ti.sqrt(gap * gap + twice * twice), 1e-30)
    t = ti.select(gap < 0.0, -t, t)
    cosine = 1.0 / ti.sqrt(1.0 + t * t)
    return ti.Matrix.cols([w, cosine * (u - t * v), cosine * (t * u + v)])


@ti.func
def hencky_strain(f):
    """ln V of the left stretch V, V^2 = F F^T. NaN for a body turned inside out, which ends the rollout."""
    e = f - identity3()
    x = e + e.transpose() + e @ e.transpose()  # F F^T - I without cancellation: a small strain keeps its digits
    # ln V = artanh(Z), Z = X (2 I + X)^-1: a short series up to stretches of 0.87 and 1.15, and no eigenvectors.
    b = x + 2.0 * identity3()
    minors = adjugate(b)
    z = symmetric_product(x, minors) / (b[0, 0] * minors[0, 0] + b[0, 1] * minors[0, 1] + b[0, 2] * minors[0, 2])
    z2 = symmetric_product(z, z)
    j = f.determinant()
    strain = ti.zero(z)
    if z2.trace() < 0.02 and j > 0.0:
        strain = symmetric_product(z, power_series(z2, ARTANH))
    else:
        x = deviator(x)
        size = ti.sqrt(x.norm_sqr() / 6.0)
        q = ti.zero(x) + identity3()
        if size > 1e-15:
            q = eigenvectors(x / size)
        # Stretches are the lengths of the rows of Q^T F: eigenvalues of F F^T have lost the digits of the small ones.
        rows = q.transpose() @ f
        for i in ti.static(range(3)):
            squared = ti.select(j > 0.0, 1.0, -1.0) * rows[i, :].norm_sqr()
            strain += 0.5 * ti.log(squared) * q[:, i].outer_product(q[:, i])
    return strain


@ti.func
def strained(f, change):
    """exp(change) F: what F becomes when ``change``, which commutes with ln V, is added to its Hencky strain."""
    near = change.norm_sqr() < 0.004
    part = ti.select(near, 1.0, 1.0 / 64.0) * change
    grown = symmetric_product(part, power_series(part, EXPM1))
    if not near:  # (I + G)^64 - I
        for _ in ti.static(range(6)):
            grown = 2.0 * grown + symmetric_product(grown, grown)
    return f + grown @ f


@ti.func
def hencky_stress(strain, mu, lam):
    """tau = 2 mu eps + lambda tr(eps) I."""
    return 2.0 * mu * strain + (lam * strain.trace()) * identity3()


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
        kept = strained(f, change)
    return kept, hencky_stress(strain, c[0], c[1])


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
        kept = strained(f, change)
    return kept, hencky_stress(strain, c[0], c[1])


@ti.func
def newtonian(f, c):
    """c = (G, K/7, share) [Pa, Pa, 1]: a Maxwell fluid whose relaxation time is too short to be seen.

    A substep keeps 1 - share = 1 / (1 + dt G / eta) of the isochoric strain (backward Euler), so that at a steady rate
    D the strain kept is D eta / G and the stress 2 eta D, at any dt. A law sees no velocity gradient, and an explicit
    viscous stress would bound the substep by dx^2; this one is bounded by the speed of sound. Pressure is Tait's with
    exponent 7, tau = K/7 (J - J^-6) I (Becker & Teschner 2007; PAC-NeRF's fluid has viscosity mu / 2 and K = 7 kappa).
    """
    kept = neural_flow(f, isochoric_strain(f), ti.Vector([c[2], 0.0 * c[2]]))
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
    strain = hencky_strain(f)
    dev = deviator(strain)
    size = dev.norm()
    limit = c[2] / (2.0 * c[0])
    kept = f
    if size > limit:
        change = -((size - limit) / size / (1.0 + c[3])) * dev
        strain += change
        kept = strained(f, change)
    return kept, hencky_stress(strain, c[0], c[1])


CLASSICAL = {
    "neo_hookean": neo_hookean,
    "water": water,
    "newtonian": newtonian,
    "von_mises": von_mises,
    "non_newtonian": non_newtonian,
    "drucker_prager": drucker_prager,
}
