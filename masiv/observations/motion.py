"""Motion that is known at frames alone."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.interpolate import CubicSpline


class Observed(Protocol):
    """Motion (T, N, 3) [m, world] of a body of ``volume`` [m^3] at ``times`` [s]: a trajectory, or tracks."""

    @property
    def positions(self) -> np.ndarray: ...

    @property
    def times(self) -> np.ndarray: ...

    @property
    def volume(self) -> float: ...

    def evaluate(self, times: np.ndarray) -> np.ndarray: ...


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


@dataclass(frozen=True)
class Cut:
    """The first ``frames`` frames of a motion."""

    motion: Observed
    frames: int

    @property
    def positions(self) -> np.ndarray:
        return self.motion.positions[: self.frames]

    @property
    def times(self) -> np.ndarray:
        return self.motion.times[: self.frames]

    @property
    def volume(self) -> float:
        return self.motion.volume

    def evaluate(self, times: np.ndarray) -> np.ndarray:
        """As the motion's own, within the frames kept."""
        return self.motion.evaluate(times)


def first_frames(motion: Observed, frames: int) -> Observed:
    """``motion`` without what came after its first ``frames`` frames."""
    return motion if len(motion.times) <= frames else Cut(motion, frames)
