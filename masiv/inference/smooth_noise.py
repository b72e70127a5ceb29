"""How certain an estimate is whose errors are smooth in space and time.

Residuals that are fitted tell little of the noise where it looks like what was fitted: law and throw take over what is
smooth over the body and the time. So the noise's lengths are those whose residual *after the same fit* would be
correlated as the one that was found (moments in the sense of restricted maximum likelihood; Patterson and Thompson
1971), and the covariance of an estimate is the sandwich A⁺ Σ A⁺ᵀ: a pattern as smooth as the noise is known less well
than a rough one, which one effective number of samples cannot say.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SAMPLE = 150
"""Points from which lengths are estimated."""
BINS = 12
TIMES = tuple(0.3 * 1.25**k for k in range(16))
"""Lengths in time that are tried, in instants."""
PLACES = tuple(0.02 * 1.2**k for k in range(20))
"""Lengths in space that are tried, over the largest distance of two points."""
LEAST_INSTANTS, LEAST_POINTS = 4, 8
AT_ONCE = 512
"""Points whose covariance with all others is held at a time."""


@dataclass(frozen=True)
class Smoothness:
    """A noise of ``variance`` [m^2] in each axis, correlated as exp(-(lag / instants)^2 / 2) in time and as
    exp(-(distance / metres)^2 / 2) in space."""

    variance: float
    time_count: float
    metres: float


def smoothness(field: np.ndarray, sensitivities: np.ndarray, positions: np.ndarray) -> Smoothness | None:
    """Of the noise in ``field`` (K, N, A) [m], what a fit with ``sensitivities`` (K, N, A, P) left of it, of points
    that lie at ``positions`` (N, 3) [m]. None where there are too few instants or points to tell."""
    instants, count, axes = field.shape
    if instants < LEAST_INSTANTS or count < LEAST_POINTS or not field.any():
        return None
    coarse = np.sort(np.random.default_rng(0).choice(count, min(SAMPLE, count), replace=False))
    apart = _apart(positions[coarse], positions[coarse])
    size = float(apart.max())
    if size == 0.0:
        return None
    some = field[:, coarse]
    basis = basis_of(sensitivities[:, coarse].reshape(some.size, -1))
    # The same fit, to these instants and points alone, so that what it left of them is known exactly.
    left = some.ravel() - basis @ (basis.T @ some.ravel())
    shaped = basis.reshape(*some.shape, -1)
    lag = _lags(instants)
    bins = np.digitize(apart, np.linspace(0, size, BINS + 1)[1:])
    np.fill_diagonal(bins, BINS)  # of a point with itself, which the first time lag is
    pairs = np.bincount(bins.ravel(), minlength=BINS + 1)[:BINS]
    seen = pairs > 0

    def moments(in_time: np.ndarray, in_space: np.ndarray) -> np.ndarray:
        """Means of products at each time lag, but the longest, and at each distance."""
        times = np.bincount(lag.ravel(), in_time.ravel()) / (np.bincount(lag.ravel()) * len(coarse) * axes)
        places = np.bincount(bins.ravel(), in_space.ravel(), minlength=BINS + 1)[:BINS] / np.maximum(pairs, 1)
        return np.concatenate([times[:-1], places[seen] / (instants * axes)])

    found = moments(*_grams(left.reshape(*some.shape, 1), left.reshape(*some.shape, 1)))
    weights = np.r_[np.full(instants - 2, 1 / (instants - 2)), np.full(int(seen.sum()), 1 / seen.sum())]
    best, least = None, np.inf
    for metres in size * np.array(PLACES):
        in_space = np.exp(-0.5 * (apart / metres) ** 2)
        spread = np.tensordot(in_space, shaped, (1, 1)).swapaxes(0, 1)
        for length in TIMES:
            in_time = np.exp(-0.5 * (lag / length) ** 2)
            rows = np.tensordot(in_time, spread, (1, 0))
            core = basis.T @ rows.reshape(basis.shape)
            taken = shaped @ core - 2 * rows
            expected = moments(in_time * len(coarse) * axes, in_space * instants * axes) + moments(
                *_grams(taken, shaped)
            )
            if expected[0] <= 0:
                continue
            misfit = float(weights @ ((expected / expected[0] - found / found[0])[1:] ** 2))
            if misfit < least:
                best, least = Smoothness(float(found[0] / expected[0]), length, float(metres)), misfit
    return best


def covariance_of(estimator: np.ndarray, noise: Smoothness, positions: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Covariance (P, P) of ``estimator`` (K, N, A, P) times a noise, ``scale`` (K,) times as large at each instant."""
    in_time = np.exp(-0.5 * (_lags(len(scale)) / noise.time_count) ** 2) * np.outer(scale, scale)
    later = np.tensordot(in_time, estimator, (1, 0))
    total = np.zeros((estimator.shape[-1],) * 2)
    for begin in range(0, len(positions), AT_ONCE):
        part = slice(begin, begin + AT_ONCE)
        in_space = np.exp(-0.5 * (_apart(positions[part], positions) / noise.metres) ** 2)
        spread = np.tensordot(in_space, later, (1, 1)).swapaxes(0, 1)
        total += np.tensordot(estimator[:, part], spread, ((0, 1, 2), (0, 1, 2)))
    return noise.variance * total


def _grams(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sums of products of fields (K, N, A, P): over all but instants (K, K), and over all but points (N, N)."""
    in_time = a.reshape(len(a), -1) @ b.reshape(len(b), -1).T
    a, b = (np.moveaxis(x, 1, 0).reshape(x.shape[1], -1) for x in (a, b))
    return in_time, a @ b.T


def basis_of(a: np.ndarray) -> np.ndarray:
    """Orthonormal columns that span those of ``a`` (M, P)."""
    lengths = np.linalg.norm(a, axis=0)
    seen = lengths > 1e-9 * lengths.max(initial=0.0)
    u, s, _ = np.linalg.svd(a[:, seen] / lengths[seen], full_matrices=False)
    return u[:, s > 1e-6 * s[0]] if len(s) else u


def _lags(count: int) -> np.ndarray:
    return np.abs(np.subtract.outer(np.arange(count), np.arange(count)))


def _apart(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - others[None], axis=2)
