"""Algebra of 3 x 3 matrices as Taichi functions."""

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
    """A B if it is symmetric, as that of symmetric matrices with the same eigenvectors; B is symmetric."""
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
