"""Noise that is smooth in space and time: its correlation lengths, and the covariance of estimates under it.

A fit absorbs the part of the noise that looks like what is fitted: law and initial state take over what is smooth over
body and time. So the lengths are those whose residual *after the same fit* would be correlated as the given one
(moments in the sense of restricted maximum likelihood; Patterson and Thompson 1971). The covariance of an estimate is
the sandwich A⁺ Σ A⁺ᵀ: a pattern as smooth as the noise is known less well than a rough one, which one effective number
of samples cannot say.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

MAX_POINTS, DISTANCE_BINS = 150, 12
"""Points, and bins of their distances, from which lengths are estimated."""
TIME_LENGTHS = tuple(0.3 * 1.25**k for k in range(16))
"""Correlation times that are tried, in instants."""
RELATIVE_LENGTHS = tuple(0.02 * 1.2**k for k in range(20))
"""Correlation lengths that are tried, over the largest distance of two points."""
MIN_INSTANTS, MIN_POINTS = 4, 8
"""Fewer than these do not tell how smooth a noise is."""
BLOCK_POINTS = 512
"""Points whose covariance with all others is held in memory at a time."""


@dataclass(frozen=True)
class SmoothNoise:
    """A noise of ``variance`` [m²] in each axis, correlated as exp(-(lag / correlation_time)² / 2) in time [instants]
    and as exp(-(distance / correlation_length)² / 2) in space [m]."""

    variance: float
    correlation_time: float
    correlation_length: float


def estimate_smooth_noise(field: np.ndarray, sensitivities: np.ndarray, positions: np.ndarray) -> SmoothNoise | None:
    """The noise of which a fit with ``sensitivities`` (T, N, A, P) left the ``field`` (T, N, A) [m], of points at
    ``positions`` (N, 3) [m]. None if there are too few instants or points to tell."""
    instants, count, axes = field.shape
    if instants < MIN_INSTANTS or count < MIN_POINTS or not field.any():
        return None
    chosen = np.sort(np.random.default_rng(0).choice(count, min(MAX_POINTS, count), replace=False))
    distance = _distances(positions[chosen], positions[chosen])
    size = float(distance.max())
    if size == 0.0:
        return None
    some = field[:, chosen]
    basis = basis_of(sensitivities[:, chosen].reshape(some.size, -1))
    # The same fit to these instants and points alone, so that what it left of them is known exactly.
    left = some.ravel() - basis @ (basis.T @ some.ravel())
    shaped = basis.reshape(*some.shape, -1)
    lag = _lags(instants)
    bins = np.digitize(distance, np.linspace(0, size, DISTANCE_BINS + 1)[1:])
    np.fill_diagonal(bins, DISTANCE_BINS)  # of a point with itself, which the first time lag is
    pairs = np.bincount(bins.ravel(), minlength=DISTANCE_BINS + 1)[:DISTANCE_BINS]
    seen = pairs > 0

    def moments(in_time: np.ndarray, in_space: np.ndarray) -> np.ndarray:
        """Means of products at each time lag, but the longest, and at each distance."""
        times = np.bincount(lag.ravel(), in_time.ravel()) / (np.bincount(lag.ravel()) * len(chosen) * axes)
        places = np.bincount(bins.ravel(), in_space.ravel(), minlength=DISTANCE_BINS + 1)[:DISTANCE_BINS] / np.maximum(
            pairs, 1
        )
        return np.concatenate([times[:-1], places[seen] / (instants * axes)])

    measured = moments(*_grams(left.reshape(*some.shape, 1), left.reshape(*some.shape, 1)))
    weights = np.r_[np.full(instants - 2, 1 / (instants - 2)), np.full(int(seen.sum()), 1 / seen.sum())]
    best, least = None, np.inf
    for metres in size * np.array(RELATIVE_LENGTHS):
        in_space = np.exp(-0.5 * (distance / metres) ** 2)
        spread = np.tensordot(in_space, shaped, (1, 1)).swapaxes(0, 1)
        for length in TIME_LENGTHS:
            in_time = np.exp(-0.5 * (lag / length) ** 2)
            rows = np.tensordot(in_time, spread, (1, 0))
            core = basis.T @ rows.reshape(basis.shape)
            taken = shaped @ core - 2 * rows
            expected = moments(in_time * len(chosen) * axes, in_space * instants * axes) + moments(
                *_grams(taken, shaped)
            )
            if expected[0] <= 0:
                continue
            mismatch = float(weights @ ((expected / expected[0] - measured / measured[0])[1:] ** 2))
            if mismatch < least:
                best, least = SmoothNoise(float(measured[0] / expected[0]), length, float(metres)), mismatch
    return best


def covariance_of(estimator: np.ndarray, noise: SmoothNoise, positions: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Covariance (P, P) of ``estimator`` (T, N, A, P) times a noise that is ``scale`` (T,) times as large at each
    instant, of points at ``positions`` (N, 3) [m]."""
    in_time = np.exp(-0.5 * (_lags(len(scale)) / noise.correlation_time) ** 2) * np.outer(scale, scale)
    later = np.tensordot(in_time, estimator, (1, 0))
    total = np.zeros((estimator.shape[-1],) * 2)
    for begin in range(0, len(positions), BLOCK_POINTS):
        part = slice(begin, begin + BLOCK_POINTS)
        in_space = np.exp(-0.5 * (_distances(positions[part], positions) / noise.correlation_length) ** 2)
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


def _distances(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - others[None], axis=2)
