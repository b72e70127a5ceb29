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


class BlockCovariance:
    """C (T, T) [m²] of ``block`` as a function of the logarithms of the sizes (3 G + 2,)."""

    def __init__(self, block: ErrorBlock) -> None:
        self.block = block
        self.scaled_lags = SQRT5 * block.lags
        self.smooth = np.outer(block.smooth, block.smooth)
        nugget = NUGGET * np.eye(len(block.lags))
        self.smooth_nugget = self.smooth * nugget
        self.grid = np.outer(block.grid, block.grid) * (matern52(block.lags / block.grid_length) + nugget)
        self.grid_jitter = np.zeros(len(block.lags)) if block.grid_jitter is None else block.grid_jitter**2

    def at(self, logs: np.ndarray) -> CovarianceAt:
        """C, and what its gradient needs, at ``logs``."""
        return CovarianceAt(self, logs)

    def __call__(self, logs: np.ndarray) -> np.ndarray:
        return self.at(logs).matrix


class CovarianceAt:
    """C (T, T) [m²] of a block at ``logs`` (3 G + 2,), as ``matrix``."""

    def __init__(self, known: BlockCovariance, logs: np.ndarray) -> None:
        groups, g = len(logs) // 3, known.block.group
        self._places = [g, groups + g, 2 * groups + g, -2, -1]
        jitter, smooth, length, grid, grid_jitter = np.exp(logs[self._places])
        self._scaled = known.scaled_lags / length
        self._size, self._decay = smooth**2 * known.smooth, np.exp(-self._scaled)
        self._smooth = self._size * (1 + self._scaled * (1 + self._scaled / 3)) * self._decay
        self._smooth += smooth**2 * known.smooth_nugget
        self._jitter, self._grid = float(known.block.jitter * jitter) ** 2, grid**2 * known.grid
        self._grid_jitter = grid_jitter**2 * known.grid_jitter
        self.matrix = self._smooth + self._grid
        self.matrix.flat[:: len(self.matrix) + 1] += self._jitter + self._grid_jitter

    def add_gradient(self, out: np.ndarray, by_covariance: np.ndarray) -> None:
        """Add the gradient of a function by the logarithms to ``out`` (3 G + 2,), from that by C (T, T)."""
        diagonal, scaled = by_covariance.diagonal(), self._scaled
        by_length = self._size * scaled**2 * ((1 + scaled) / 3) * self._decay
        out[self._places] += [
            2 * self._jitter * diagonal.sum(),
            2 * (by_covariance * self._smooth).sum(),
            (by_covariance * by_length).sum(),
            2 * (by_covariance * self._grid).sum(),
            2 * (diagonal @ self._grid_jitter),
        ]
