"""Hencky (logarithmic) strain without a singular value decomposition: the derivative of sorted singular values is
undefined at F = I, where every rollout starts, and Taichi's is slow and stops at 1e-6."""

import taichi as ti

from masiv.kernels.tensor import adjugate, deviator, identity3, symmetric_product

ARTANH_RATIOS = tuple((2 * k - 1, 2 * k + 1) for k in range(1, 9))
EXPM1_RATIOS = tuple((1, k) for k in range(2, 9))
"""artanh(z) / z in z^2 and (exp(x) - 1) / x in x for ``power_series``: accurate to float64 for tr(Z^2) < 0.02 and
|X|^2 < 0.004."""


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
        strain = symmetric_product(z, power_series(z2, ARTANH_RATIOS))
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
def with_strain_change(f, change):
    """exp(change) F: what F becomes when ``change``, which commutes with ln V, is added to its Hencky strain."""
    near = change.norm_sqr() < 0.004
    part = ti.select(near, 1.0, 1.0 / 64.0) * change
    grown = symmetric_product(part, power_series(part, EXPM1_RATIOS))
    if not near:  # (I + G)^64 - I
        for _ in ti.static(range(6)):
            grown = 2.0 * grown + symmetric_product(grown, grown)
    return f + grown @ f


@ti.func
def hencky_stress(strain, mu, lam):
    """tau = 2 mu eps + lambda tr(eps) I."""
    return 2.0 * mu * strain + (lam * strain.trace()) * identity3()
