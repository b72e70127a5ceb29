"""Motion that is known at frames alone."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline


@dataclass(frozen=True)
class SampledMotion:
    """positions (T, N, 3) [m, world] at times (T,) [s], a cubic spline between them; volume [m^3] of the body."""

    positions: np.ndarray
    times: np.ndarray
    volume: float

    @cached_property
    def _spline(self) -> CubicSpline:
        return CubicSpline(self.times, np.asarray(self.positions, dtype=np.float64))

    def evaluate(self, times: np.ndarray) -> np.ndarray:
        """Positions (K, N, 3) float32 [m] at ``times`` (K,) [s] within the observed span."""
        return self._spline(times).astype(np.float32)
