"""A block of particles whose motion is known in closed form: x(t) = A(t) X + c(t), A = I + t G."""

from __future__ import annotations

import numpy as np

from masiv.simulation.rollout import Rollout

SIDE, SPACING = 10, 0.05
VOLUME = (SIDE * SPACING) ** 3
TIMES = np.arange(4) / 8.0
GRADIENT = np.array([[0.8, 0.3, 0.0], [0.0, -0.4, 0.0], [0.0, 0.0, 0.2]])
DRIFT, FALL = np.array([0.4, 0.2, -0.1]), np.array([0.0, -1.0, 0.5])


def lattice() -> np.ndarray:
    """(1000, 3) [m], from the middle of the first cell on."""
    axis = (np.arange(SIDE) + 0.5) * SPACING
    return np.stack(np.meshgrid(axis, axis + 0.3, axis, indexing="ij"), axis=-1).reshape(-1, 3)


def gradient(time: float) -> np.ndarray:
    """F(t), (3, 3)."""
    return np.eye(3) + time * GRADIENT


def positions(time: float) -> np.ndarray:
    return lattice() @ gradient(time).T + DRIFT * time + FALL * time**2


def velocity(time: float) -> np.ndarray:
    """Exact, and exact for differences of second order, since positions are quadratic in time."""
    return lattice() @ GRADIENT.T + DRIFT + 2 * FALL * time


def rollout() -> Rollout:
    return Rollout(np.stack([positions(t) for t in TIMES]).astype(np.float32), TIMES)
