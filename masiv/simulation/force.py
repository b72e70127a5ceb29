"""External forces on a simulated body."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from masiv.errors import InputError


@dataclass(frozen=True)
class ForcePulse:
    """A force (3,) [N, world] on the whole body, spread evenly over its mass, from ``start`` to ``stop`` [s]. Raises
    InputError for values that are not finite and for times that are not ascending."""

    force: np.ndarray
    start: float = 0.0
    stop: float = math.inf

    def __post_init__(self) -> None:
        if np.shape(self.force) != (3,) or not np.isfinite(self.force).all():
            raise InputError("--force takes three finite numbers X,Y,Z [N]")
        if not (math.isfinite(self.start) and self.start >= 0):
            raise InputError(f"--force-from {self.start:g}: give a time [s] of 0 or later")
        if not self.stop > self.start:
            raise InputError(f"--force-until {self.stop:g} must be later than --force-from {self.start:g}")

    def pieces(self, begin: float, end: float) -> list[tuple[float, bool]]:
        """The interval from ``begin`` to ``end`` [s], cut where the force starts or stops: (duration [s], acts?)."""
        shortest = 1e-6 * (end - begin)  # anything shorter is a rounding error
        inside = [t for t in (self.start, self.stop) if begin + shortest < t < end - shortest]
        cuts = [begin, *inside, end]
        return [(b - a, self.start < 0.5 * (a + b) < self.stop) for a, b in itertools.pairwise(cuts)]
