"""Variances of residuals with nothing missing, by which a search whitens and weights them.

Of each observation: ``noise_std`` [m], the measurement, and ``residual_std`` (T,) [m], measurement and discretization
together. Two regimes: instants that are *observation-limited*, simulated as well as they are observed, and the others.
What is named is decided with correlated errors (``masiv.inference.evidence``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from masiv.observations.base import Observation

OBSERVATION_LIMITED_RATIO = 1.5
"""``residual_std`` over ``noise_std`` below which an instant is observation-limited."""
MAX_POINTS, DISTANCE_BINS = 400, 24
"""Points, and bins of their distances, of which ``effective_samples`` takes the correlation."""


def one_more(count: int) -> float:
    """By how many times more one more draw differs from the mean of ``count`` than these do, root mean square."""
    return math.sqrt((count + 1) / (count - 1))


@dataclass(frozen=True)
class RegimeMeans:
    """Means over fitted instants of a quantity over its variance. None: no instant is of that regime."""

    observation_limited: float | None
    model_limited: float | None

    @property
    def largest(self) -> float:
        return max(mean for mean in (self.observation_limited, self.model_limited) if mean is not None)


@dataclass(frozen=True)
class NoiseModel:
    """See the module. Fields are residuals (T, N, A) [m] of each observation over all instants, squares (T,) [m²] their
    mean squares; the residual of a fit (M,) is what ``whiten`` makes of the fitted instants."""

    observations: Sequence[Observation]

    def whiten(self, fitted: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Fields of fitted instants, divided by ``residual_std`` and multiplied by ``noise_std`` [m]."""
        return [e.whiten(f) for f, e in zip(fitted, self.observations, strict=True)]

    def effective_samples(self, whitened: Sequence[np.ndarray]) -> int:
        """How many independent residuals the fitted instants are worth."""
        return sum(
            effective_samples(f, e.points) for f, e in zip(whitened, self.observations, strict=True) if e.fit_count
        )

    # -- variances -----------------------------------------------------------------------------------------------

    def over_variance(self, squares: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Mean squares (T,) of each observation over the variances of its residuals."""
        return [s / e.residual_std**2 for s, e in zip(squares, self.observations, strict=True)]

    def by_regime(self, ratios: Sequence[np.ndarray]) -> RegimeMeans:
        """Means of ``ratios`` (T,) of each observation over the fitted instants of each regime."""
        limited, others = [], []
        for ratio, e in zip(ratios, self.observations, strict=True):
            known = observation_limited(e)
            limited.append(ratio[: e.fit_count][known])
            others.append(ratio[: e.fit_count][~known])
        means = (float(part.mean()) if len(part) else None for part in map(np.concatenate, (limited, others)))
        return RegimeMeans(*means)

    def reduced_chi(self, squares: Sequence[np.ndarray]) -> float:
        """Root mean square residual over ``residual_std``, of the fitted instants of the regime where it is largest:
        about 1 if nothing is missing."""
        return math.sqrt(self.by_regime(self.over_variance(squares)).largest)


def observation_limited(observation: Observation) -> np.ndarray:
    """Which fitted instants (fit_count,) are simulated as well as they are observed."""
    return observation.residual_std[: observation.fit_count] < OBSERVATION_LIMITED_RATIO * observation.noise_std


def effective_samples(field: np.ndarray, points: np.ndarray) -> int:
    """How many independent values a ``field`` (T, N, A) of correlated residuals of N ``points`` (N, 3) [m] is worth.

    A × times × places: n values with correlations ρ are worth n² / Σ ρ², the participation ratio of their covariance; ρ
    is taken as a function of time lag, and of distance at the start. An estimate: the field is treated as stationary,
    and time and space as separable.
    """
    instants, count, axes = field.shape
    variance = float((field**2).mean())
    if variance == 0.0:
        return field.size
    lags = [float((field[k:] * field[: instants - k]).mean()) / variance for k in range(instants)]
    lag = np.abs(np.subtract.outer(np.arange(instants), np.arange(instants)))
    times = instants**2 / float((np.clip(lags, -1, 1)[lag] ** 2).sum())
    chosen = np.sort(np.random.default_rng(0).choice(count, min(MAX_POINTS, count), replace=False))
    some = field[:, chosen]
    product = np.einsum("kia,kja->ij", some, some) / (axes * instants * variance)
    distance = np.linalg.norm(points[chosen][:, None] - points[chosen][None], axis=2)
    upper = np.triu_indices(len(chosen), 1)
    if len(upper[0]) == 0:
        return max(1, round(axes * times))
    edges = np.linspace(0, distance.max() * 1.001, DISTANCE_BINS + 1)
    index = np.digitize(distance[upper], edges) - 1
    weight = np.bincount(index, minlength=DISTANCE_BINS)
    sums = np.bincount(index, product[upper], minlength=DISTANCE_BINS)
    rho = np.clip(sums / np.maximum(weight, 1), -1, 1)
    squares = float((weight * rho**2).sum() / weight.sum())
    places = 1 / (1 / count + (1 - 1 / count) * squares)
    return max(1, round(axes * times * places))
