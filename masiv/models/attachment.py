"""Markers tied to the material: interpolation between particles in the rest state."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from masiv.errors import MasivError

if TYPE_CHECKING:
    import torch

REACH = 2.5
"""Radius of a marker's support in particle spacings; about 65 particles in a full ball."""
OUTSIDE = 1.5
"""Radius in distances from the body, for a marker on a stalk: it follows the piece of surface that carries it."""


@dataclass(frozen=True)
class Attachment:
    """Marker m is at the sum of weights[m] x over the particles index[m]: (M, K) int64 and float64, padded with 0.

    distance (M,) [m]: from the nearest particle at rest. gain (M,): the sum of |weights|, by which noise of the
    particles' positions could grow: 1 amid them, more for a marker on a stalk.
    """

    index: np.ndarray
    weights: np.ndarray
    distance: np.ndarray
    gain: np.ndarray

    def apply(self, positions: torch.Tensor) -> torch.Tensor:
        """Positions (..., N, 3) of the particles -> markers (..., M, 3), in the same frame; differentiable. Also takes
        and gives numpy arrays."""
        if isinstance(positions, np.ndarray):
            return np.einsum("mk,...mkc->...mc", self.weights, positions[..., self.index, :])
        import torch

        weights = torch.as_tensor(self.weights, dtype=positions.dtype)
        return (weights[..., None] * positions[..., torch.as_tensor(self.index), :]).sum(-2)


def attach(particles: np.ndarray, markers: np.ndarray, spacing: float) -> Attachment:
    """Tie markers (M, 3) to particles (N, 3) [m, any one frame] at rest, ``spacing`` [m] apart.

    Moving least squares with linear basis (Lancaster & Salkauskas 1981): any affine motion of the particles, so every
    rigid one, moves the marker with it exactly. The support is round the particle nearest to the marker. Raises
    MasivError where the particles there lie in a plane, so that they do not carry a marker outside of it.
    """
    particles, markers = np.asarray(particles, np.float64), np.asarray(markers, np.float64)
    tree = cKDTree(particles)
    distance, nearest = tree.query(markers)
    rows = []
    for m, marker in enumerate(markers):
        radius = max(REACH * spacing, OUTSIDE * float(distance[m]))
        near = np.array(sorted(tree.query_ball_point(particles[nearest[m]], radius)))
        rows.append((near, _weights(particles[near], particles[nearest[m]], marker, radius, m)))
    width = max(len(near) for near, _ in rows)
    index = np.zeros((len(markers), width), np.int64)
    weights = np.zeros((len(markers), width))
    for m, (near, row) in enumerate(rows):
        index[m, : len(near)], weights[m, : len(near)] = near, row
    return Attachment(index, weights, distance, np.abs(weights).sum(axis=1))


def _weights(points: np.ndarray, middle: np.ndarray, marker: np.ndarray, radius: float, m: int) -> np.ndarray:
    """Weights (K,) of the points (K, 3): 1 and x are reproduced at ``marker``."""
    share = 1 - (np.linalg.norm(points - middle, axis=1) / (1.0001 * radius)) ** 2
    share = share**2
    basis = np.concatenate([np.ones((len(points), 1)), (points - middle) / radius], axis=1)
    moment = basis.T @ (share[:, None] * basis)
    spread = np.linalg.eigvalsh(moment[1:, 1:])
    if len(points) < 4 or spread[0] < 1e-3 * spread[-1]:
        raise MasivError(
            f"the particles round marker {m} lie in a plane or on a line: fill the body with more, so that two layers "
            "or more carry it"
        )
    target = np.concatenate([[1.0], (marker - middle) / radius])
    return share * (basis @ np.linalg.solve(moment, target))
