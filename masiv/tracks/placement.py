"""Where a body is in the world at rest. Light: no torch, no taichi."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Placement:
    """x_world = rotation x_own + translation; rotation (3, 3), translation (3,) [m]. error [m]: RMS distance of the
    markers that it was found from, 0 where it was declared."""

    rotation: np.ndarray
    translation: np.ndarray
    error: float = 0.0

    def to_world(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) [m] in the body's own axes -> world."""
        return points @ self.rotation.T + self.translation

    def to_own(self, points: np.ndarray) -> np.ndarray:
        """World points (..., 3) [m] -> the body's own axes."""
        return (points - self.translation) @ self.rotation


def best_rigid(own: np.ndarray, world: np.ndarray) -> Placement:
    """The rigid motion that takes points ``own`` (M, 3) nearest to ``world`` (M, 3) in least squares (Kabsch 1976).

    Three points or more that are not on a line.
    """
    middles = own.mean(0), world.mean(0)
    u, _, vt = np.linalg.svd((world - middles[1]).T @ (own - middles[0]))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    translation = middles[1] - rotation @ middles[0]
    off = own @ rotation.T + translation - world
    return Placement(rotation, translation, float(np.sqrt((off**2).sum(1).mean())))
