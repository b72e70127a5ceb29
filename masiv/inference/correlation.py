"""How many independent residuals a correlated field of them is worth."""

from __future__ import annotations

import numpy as np

SAMPLE = 400
BINS = 24


def effective_samples(field: np.ndarray, positions: np.ndarray) -> int:
    """Independent values in ``field`` (K, N, A), residuals at K instants of N points that lie at ``positions`` (N, 3).

    A x times x places, where a set of n values with correlations rho is worth n^2 / sum(rho_ij^2), the participation
    ratio of its covariance; rho is taken as a function of time lag, and of distance at the start. An estimate: the
    field is treated as stationary, and time and space as separable.
    """
    instants, count, axes = field.shape
    variance = float((field**2).mean())
    if variance == 0.0:
        return field.size
    lags = [float((field[k:] * field[: instants - k]).mean()) / variance for k in range(instants)]
    lag = np.abs(np.subtract.outer(np.arange(instants), np.arange(instants)))
    times = instants**2 / float((np.clip(lags, -1, 1)[lag] ** 2).sum())
    coarse = np.random.default_rng(0).choice(count, min(SAMPLE, count), replace=False)
    some = field[:, np.sort(coarse)]
    product = np.einsum("kia,kja->ij", some, some) / (axes * instants * variance)
    points = positions[np.sort(coarse)]
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    upper = np.triu_indices(len(points), 1)
    if len(upper[0]) == 0:
        return max(1, round(axes * times))
    edges = np.linspace(0, apart.max() * 1.001, BINS + 1)
    index = np.digitize(apart[upper], edges) - 1
    weight = np.bincount(index, minlength=BINS)
    sums = np.bincount(index, product[upper], minlength=BINS)
    rho = np.clip(sums / np.maximum(weight, 1), -1, 1)
    squares = float((weight * rho**2).sum() / weight.sum())
    places = 1 / (1 / count + (1 - 1 / count) * squares)
    return max(1, round(axes * times * places))
