r"""Errors of an observation in one group of modes: jitter, smooth errors, and what another grid would change.

Each coefficient of group :math:`g` is a Gaussian process in time, independent of the others, with covariance

.. math::  C_g(t, t') = j_g^2 \delta_{tt'} + s_g^2 u(t) u(t') k(|t - t'| / \ell_g) + \gamma^2 d_g(t) d_g(t') k(|t - t'| / \ell_d)

with the Matern function :math:`k` of order 5/2 (Rasmussen & Williams 2006, eq. 4.17).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

SQRT5 = 5**0.5


@dataclass(frozen=True)
class ErrorBlock:
    """Residuals of one group of modes of one observation, and what the sizes of their errors are in units of.

    residual (T, K) [m]; jacobian (T, K, P) by the fitted scales of P parameters; lags (T, T) [s]. group: index of the
    mode group. jitter [m]: expected jitter of a coefficient; smooth (T,) [m]: expected size of smooth errors of a
    coefficient; grid (T,) [m]: what another grid would change in it, zero if there is none. grid_length [s].
    """

    residual: np.ndarray
    jacobian: np.ndarray
    lags: np.ndarray
    group: int
    jitter: float
    smooth: np.ndarray
    grid: np.ndarray
    grid_length: float


@dataclass(frozen=True)
class ErrorSizes:
    """Hyperparameters. jitter, smooth (G,): factors of each group on what a block expects; length (G,) [s]: correlation
    time of smooth errors; grid: factor on what another grid changes."""

    jitter: np.ndarray
    smooth: np.ndarray
    length: np.ndarray
    grid: float

    @classmethod
    def of_logarithms(cls, logs: np.ndarray) -> ErrorSizes:
        """From ``logs`` (3 G + 1,)."""
        values = np.exp(logs)
        groups = len(values) // 3
        return cls(values[:groups], values[groups : 2 * groups], values[2 * groups : 3 * groups], float(values[-1]))


def matern52(distance: torch.Tensor) -> torch.Tensor:
    """Correlation at a ``distance`` in correlation lengths."""
    scaled = SQRT5 * distance
    return (1 + scaled + scaled**2 / 3) * torch.exp(-scaled)


def covariance(
    lags: torch.Tensor, jitter: torch.Tensor, smooth: torch.Tensor, length: torch.Tensor, grid: torch.Tensor,
    grid_length: float,
) -> torch.Tensor:  # fmt: skip
    """C (T, T) [m²]. lags (T, T) [s]; jitter [m]; smooth, grid (T,) [m]; length, grid_length [s]."""
    out = smooth[:, None] * smooth * matern52(lags / length)
    out = out + grid[:, None] * grid * matern52(lags / grid_length)
    return out + jitter**2 * torch.eye(len(lags), dtype=lags.dtype)
