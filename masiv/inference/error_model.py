"""Errors of known sizes: Gaussian processes in time of the coefficients of a residual in modes of motion."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import cho_solve, cholesky, solve_triangular

from masiv.inference.error_covariance import BlockCovariance, ErrorBlock

LOG2PI = math.log(2 * math.pi)


@dataclass(frozen=True)
class ErrorModel:
    """What a model that lacks nothing leaves of ``blocks``, with sizes whose logarithms are ``logs`` (3 G + 2,).

    Methods take coefficients (T, K) of each block, or of its first instants. A block's power (``ErrorBlock.weight``)
    below 1 says that its K series are dependent: they count as K times that many.
    """

    blocks: tuple[ErrorBlock, ...]
    logs: np.ndarray

    @cached_property
    def covariances(self) -> list[np.ndarray]:
        """C (T, T) [m²] of each block."""
        return [BlockCovariance(b)(self.logs) for b in self.blocks]

    @cached_property
    def _factors(self) -> list[np.ndarray]:
        return [cholesky(c, lower=True) for c in self.covariances]

    def whiten(self, coefficients: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Coefficients (T, K, ...) of each block in standard deviations, independent from instant to instant."""
        return [
            solve_triangular(f, c.reshape(len(c), -1), lower=True).reshape(c.shape)
            for f, c in zip(self._factors, coefficients, strict=True)
        ]

    def logpdf(self, coefficients: Sequence[np.ndarray]) -> float:
        """Logarithm of the (composite) likelihood of coefficients (T, K)."""
        out = 0.0
        for b, f, white in zip(self.blocks, self._factors, self.whiten(coefficients), strict=True):
            each = len(f) * LOG2PI / 2 + np.log(f.diagonal()).sum()
            out -= b.weight * (white.shape[1] * each + 0.5 * float((white**2).sum()))
        return out

    def conditional(self, past: Sequence[np.ndarray]) -> list[tuple[np.ndarray, np.ndarray]]:
        """Mean (T - n, K) [m] and covariance (T - n, T - n) [m²] of the later instants of each block, given the first n
        (n, K) (Rasmussen & Williams 2006, eq. 2.19)."""
        out = []
        for c, seen in zip(self.covariances, past, strict=True):
            n = len(seen)
            gain = cho_solve((cholesky(c[:n, :n], lower=True), True), c[:n, n:]).T if n else np.zeros((len(c), 0))
            out.append((gain @ seen, c[n:, n:] - gain @ c[:n, n:]))
        return out

    def draw(self, rng: np.random.Generator) -> list[np.ndarray]:
        """Coefficients (T, K) of each block; as dependent on each other as its weight says."""
        out = []
        for b, f in zip(self.blocks, self._factors, strict=True):
            modes = b.residual.shape[1]
            count = max(1, round(modes * b.weight))
            series = f @ rng.normal(size=(len(f), count))
            directions = np.linalg.qr(rng.normal(size=(modes, count)))[0]
            out.append(series @ directions.T * math.sqrt(modes / count))
        return out
