"""Geometry losses: distances between a rollout and the observed motion.

They are the geometrical objectives of MASIV, table "Ablation study of geometrical objectives":

    trajectory   mean distance of each particle to its own path, at every instant (L_traj, eq. 9)
    continuum    Chamfer distance of the particles of each whole frame
    surface      the same with the particles that lie on the surface

Difference from MASIV: the point sets are those of the trajectories at a frame, not the filled volumes to which the
trajectories were fitted.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree

SURFACE_NEIGHBOURS = 16
SURFACE_OFFSET = 0.25
"""A particle is on the surface if the mean of its neighbours is farther away than this fraction of their mean
distance."""


def trajectory_errors(positions: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    """Mean distances (K,) [m] of particles (K, N, 3) [m] to their own targets (K, N, 3) [m] at each of K instants."""
    return (positions - targets).norm(dim=2).mean(dim=1)


def mean_distance(residual: np.ndarray) -> float:
    """Mean distance [m] of a residual (K, N, 3) [m]."""
    return float(np.linalg.norm(residual, axis=2).mean())


def chamfer_error(positions: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    """Chamfer distance () [m]: root mean square distance to the nearest point of the other set.

    The mean is over both directions and K instants. positions (K, N, 3) [m]; targets (K, M, 3) [m]. The assignment of
    nearest neighbours has no gradient.
    """
    squares = []
    for simulated, observed in zip(positions, targets, strict=True):
        simulated_points, observed_points = simulated.detach().numpy(), observed.numpy()
        nearest_observed = torch.from_numpy(cKDTree(observed_points).query(simulated_points)[1])
        nearest_simulated = torch.from_numpy(cKDTree(simulated_points).query(observed_points)[1])
        forward = (simulated - observed[nearest_observed]).square().sum(1).mean()
        backward = (simulated[nearest_simulated] - observed).square().sum(1).mean()
        squares.append(0.5 * (forward + backward))
    return (torch.stack(squares) + 1e-12).sqrt().mean()


def surface_points(points: np.ndarray) -> np.ndarray:
    """Mask (N,) bool of the ``points`` (N, 3) [m] on the surface of the body, which they must fill evenly.

    A point is on the surface if its neighbours lie on one side of it.
    """
    distance, index = cKDTree(points).query(points, k=min(SURFACE_NEIGHBOURS + 1, len(points)))
    offset = points[index[:, 1:]].mean(axis=1) - points
    return np.linalg.norm(offset, axis=1) > SURFACE_OFFSET * distance[:, 1:].mean(axis=1)
