"""Below what size a residual says nothing: how well the motion is known, and how well it is simulated."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from masiv.refine.refit import Fitted, rms_mm, split
from masiv.refine.simulated import Simulated


def noise_floor_mm(positions: np.ndarray, last_frame: int) -> float:
    """Root mean square distance [mm] of observed positions (T, N, 3) [m] from the best rigid motion of each frame
    1…last_frame-1 of free flight.

    A body at rest within that is thrown stays rigid until it touches something, whatever drag or wind does to it: what
    is not rigid is the error of the observation. Rigid errors are not seen, so it is a lower bound. Where the body
    touches at once, frame 1 has to do.
    """
    start = positions[0] - positions[0].mean(0)
    squares = []
    for k in range(1, max(2, last_frame)):
        now = positions[k] - positions[k].mean(0)
        turn = Rotation.align_vectors(now, start)[0]
        squares.append(((now - turn.apply(start)) ** 2).sum(1).mean())
    return 1e3 * float(np.sqrt(np.mean(squares)))


@dataclass(frozen=True)
class Floor:
    """Root mean square distances [mm]. noise: of the observation. fit and held_out: what a finer grid would change in
    the simulated motion, over the fitted and the held-out instants."""

    noise: float
    fit: float
    held_out: float

    @property
    def total(self) -> float:
        """Size of a residual over the fitted instants in which nothing need be missing."""
        return math.hypot(self.noise, self.fit)


def floor_of(noise_mm: float, simulation: Simulated, fitted: Fitted) -> Floor:
    """The floor for ``fitted``: one more rollout, of all particles. Raises NonFiniteError."""
    changes = [simulation.finer_grid(fitted.model, fitted.values, k) for k in range(len(simulation.experiments))]
    if any(change is None for change in changes):
        return Floor(noise_mm, 0.0, 0.0)
    fit, rest = split([c for c in changes if c is not None], simulation.experiments)
    return Floor(noise_mm, rms_mm(fit), rms_mm(rest) if rest else 0.0)
