r"""Errors of an observation in one group of modes: jitter, smooth errors, and what another grid would change.

Each coefficient of group :math:`g` is a Gaussian process in time, independent of the others, with covariance

.. math::

    C_g(t, t') = j_g^2 \delta_{tt'} + s_g^2 u(t) u(t') k(|t - t'| / \ell_g)
    + \gamma^2 d_g(t) d_g(t') k(|t - t'| / \ell_d) + \rho^2 r_g(t)^2 \delta_{tt'}

with the Matern function :math:`k` of order 5/2 (Rasmussen & Williams 2006, eq. 4.17).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SQRT5 = 5**0.5
NUGGET = 1e-8
"""Variance of smooth errors that is independent from instant to instant, over their variance: Cholesky factors
exist."""


@dataclass(frozen=True)
class ErrorBlock:
    """Residuals of one group of modes of one observation, and what the sizes of their errors are in units of.

    residual (T, K) [m]; jacobian (T, K, P) by the fitted scales of P parameters; lags (T, T) [s]. group: index of the
    mode group. jitter [m]: expected jitter of a coefficient; smooth (T,) [m]: expected size of smooth errors of a
    coefficient; grid (T,) [m]: what another grid would change in it, zero if there is none. grid_length [s];
    grid_jitter (T,) [m]: the part of that which is independent from instant to instant, zero if not given. weight:
    power of the block's likelihood, below 1 if its modes are not independent of each other. motion: size of the motion
    over that of smooth errors, which errors cannot exceed. grids (S, T, K) [m]: by how much each of S grids differs
    from their mean; not given if there are none.
    """

    residual: np.ndarray
    jacobian: np.ndarray
    lags: np.ndarray
    group: int
    jitter: float
    smooth: np.ndarray
    grid: np.ndarray
    grid_length: float
    weight: float = 1.0
    motion: float = 1e3
    grids: np.ndarray | None = None
    grid_jitter: np.ndarray | None = None


@dataclass(frozen=True)
class ErrorSizes:
    """Hyperparameters. jitter, smooth (G,): factors of each group on what a block expects; length (G,) [s]: correlation
    time of smooth errors; grid, grid_jitter: factors on what another grid changes, smoothly and from instant to
    instant."""

    jitter: np.ndarray
    smooth: np.ndarray
    length: np.ndarray
    grid: float
    grid_jitter: float

    @classmethod
    def of_logarithms(cls, logs: np.ndarray) -> ErrorSizes:
        """From ``logs`` (3 G + 2,)."""
        values = np.exp(logs)
        groups = len(values) // 3
        of_groups = values[:groups], values[groups : 2 * groups], values[2 * groups : 3 * groups]
        return cls(*of_groups, float(values[-2]), float(values[-1]))


def matern52(distance: np.ndarray) -> np.ndarray:
    """Correlation at a ``distance`` in correlation lengths."""
    scaled = SQRT5 * distance
    return (1 + scaled + scaled**2 / 3) * np.exp(-scaled)


def matern52_by_log_length(distance: np.ndarray) -> np.ndarray:
    """Derivative of ``matern52`` by the logarithm of the correlation length."""
    scaled = SQRT5 * distance
    return scaled**2 / 3 * (1 + scaled) * np.exp(-scaled)


class BlockCovariance:
    """C (T, T) [m²] of ``block`` as a function of the logarithms of the sizes (3 G + 2,)."""

    def __init__(self, block: ErrorBlock) -> None:
        self.block = block
        self._smooth = np.outer(block.smooth, block.smooth)
        self._nugget = NUGGET * np.eye(len(block.lags))
        self._grid = np.outer(block.grid, block.grid) * (matern52(block.lags / block.grid_length) + self._nugget)
        jitter = np.zeros(len(block.lags)) if block.grid_jitter is None else block.grid_jitter
        self._grid_jitter = np.diag(jitter**2)

    def _parts(self, logs: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        values, groups, g = np.exp(logs), len(logs) // 3, self.block.group
        smooth = values[groups + g] ** 2 * self._smooth
        jitter = float(self.block.jitter * values[g]) ** 2
        return jitter, smooth, values[-2] ** 2 * self._grid, values[-1] ** 2 * self._grid_jitter

    def _distance(self, logs: np.ndarray) -> np.ndarray:
        return self.block.lags / np.exp(logs[2 * (len(logs) // 3) + self.block.group])

    def __call__(self, logs: np.ndarray) -> np.ndarray:
        jitter, smooth, grid, grid_jitter = self._parts(logs)
        return (
            jitter * np.eye(len(grid)) + smooth * (matern52(self._distance(logs)) + self._nugget) + grid + grid_jitter
        )

    def gradient(self, logs: np.ndarray, by_covariance: np.ndarray) -> np.ndarray:
        """Gradient (3 G + 2,) of a function by the logarithms, from that by C (T, T)."""
        jitter, smooth, grid, grid_jitter = self._parts(logs)
        distance = self._distance(logs)
        groups, g = len(logs) // 3, self.block.group
        out = np.zeros(len(logs))
        out[g] = 2 * jitter * np.trace(by_covariance)
        out[groups + g] = 2 * float((by_covariance * smooth * (matern52(distance) + self._nugget)).sum())
        out[2 * groups + g] = float((by_covariance * smooth * matern52_by_log_length(distance)).sum())
        out[-2] = 2 * float((by_covariance * grid).sum())
        out[-1] = 2 * float((by_covariance * grid_jitter).sum())
        return out
