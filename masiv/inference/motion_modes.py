"""Modes of a body's motion: translation, rotation, uniform strain, and polynomials of second degree.

A residual field is written in fields that are orthonormal over the body's points. Errors of one kind have sizes and
time scales of their own: a calibration that is off shifts the mean, texture that slides turns about the centre, few
cameras leave finer modes open. Modes beyond the second degree are no evidence: they are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from scipy.spatial.transform import Rotation

MAX_DEGREE = 2
RANK_TOL = 1e-3
"""Singular value over the largest below which points do not tell two polynomials apart."""
TRANSLATION, ROTATION, STRAIN = "translation", "rotation", "strain"
OF_DEGREE = {2: "quadratic"}


@dataclass(frozen=True)
class MotionModes:
    """names: of G groups of modes. bases: of each (N * A, K_g), orthonormal over the N points and A axes."""

    names: tuple[str, ...]
    bases: tuple[np.ndarray, ...]
    points: int
    axes: int

    @classmethod
    def of(cls, points: np.ndarray, axes: int) -> MotionModes:
        """The modes of ``points`` (N, 3) [m] that are measured along ``axes`` axes."""
        count = len(points)
        arms = points - points.mean(0)
        size = float(np.abs(arms).max(initial=0.0))
        known = np.full((count, 1), count**-0.5)
        names, bases = [TRANSLATION], [np.kron(known, np.eye(axes))]
        for degree in range(1, MAX_DEGREE + 1):
            if size == 0.0 or known.shape[1] == count:
                break
            new = _independent(_monomials(arms / size, degree), known)
            if not new.shape[1]:
                continue
            known = np.concatenate([known, new], axis=1)
            fields = np.kron(new, np.eye(axes))
            if degree == 1 and axes == 3:
                turning = _rotations(arms / size)
                names.append(ROTATION)
                bases.append(turning)
                fields = _independent(fields, turning)
            if fields.shape[1]:
                names.append(STRAIN if degree == 1 else OF_DEGREE[degree])
                bases.append(fields)
        return cls(tuple(names), tuple(bases), count, axes)

    def coefficients(self, field: np.ndarray, turned: np.ndarray | None = None) -> tuple[np.ndarray, ...]:
        """Coefficients (T, K_g, ...) of each group of a ``field`` (T, N, A, ...) [m]; the sum of their squares over the
        groups is the mean square over the points, but for finer modes. turned (T, 3, 3): rotation of the body since the
        start, by which all but the mean is turned back, so that an error that moves with the material stays one."""
        mean = field.mean(1, keepdims=True)
        rest = field if turned is None else np.einsum("tba,tnb...->tna...", turned, field - mean)
        out = []
        for name, basis in zip(self.names, self.bases, strict=True):
            part = mean + np.zeros_like(field) if name == TRANSLATION else rest
            flat = part.reshape(len(field), self.points * self.axes, *field.shape[3:])
            out.append(np.einsum("nk,tn...->tk...", basis, flat) / np.sqrt(self.points))
        return tuple(out)


def rotations_since_start(points: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Rotations (T, 3, 3) that take ``points`` (N, 3) nearest to ``positions`` (T, N, 3), about their means."""
    start = points - points.mean(0)
    return np.stack([Rotation.align_vectors(p - p.mean(0), start)[0].as_matrix() for p in positions])


def _monomials(arms: np.ndarray, degree: int) -> np.ndarray:
    return np.stack([np.prod(arms[:, list(c)], axis=1) for c in combinations_with_replacement(range(3), degree)], 1)


def _rotations(arms: np.ndarray) -> np.ndarray:
    """Orthonormal infinitesimal rotations (3 N, up to 3)."""
    fields = np.stack([np.cross(axis, arms).ravel() for axis in np.eye(3)], axis=1)
    return _independent(fields, np.zeros((fields.shape[0], 0)))


def _independent(columns: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Orthonormal columns that span those of ``columns`` that ``known``, orthonormal itself, does not."""
    size = np.linalg.norm(columns)
    left = columns - known @ (known.T @ columns)
    left -= known @ (known.T @ left)
    u, s, _ = np.linalg.svd(left, full_matrices=False)
    return u[:, s > RANK_TOL * size]
