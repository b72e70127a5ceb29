"""How far a rollout is from what was observed: the geometrical objectives that MASIV compares (Table "Ablation study of
geometrical objectives").

trajectory: each particle against its own path, at every instant. continuum: the bodies of each whole frame as sets of
points, whose identity is thrown away. surface: the same of the particles that lie on the surface.
differs from MASIV: the sets are those of the trajectories at a frame, not the filled volumes they were fitted to.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree

NEIGHBOURS = 16
ONE_SIDED = 0.25
"""A particle is on the surface where the mean of its neighbours is this share of their distance away from it."""


def trajectory_error(positions: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    """Mean distance [m] of particles (K, N, 3) to their own targets, K instants."""
    return (positions - targets).norm(dim=2).mean()


def chamfer_error(positions: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    """Root of the mean squared distance [m] to the nearest point of the other set, both directions, mean over K
    instants; positions (K, N, 3), targets (K, M, 3). Nearest neighbours are found without a gradient."""
    squares = []
    for here, there in zip(positions, targets, strict=True):
        found, known = here.detach().numpy(), there.numpy()
        nearest = torch.from_numpy(cKDTree(known).query(found)[1])
        owner = torch.from_numpy(cKDTree(found).query(known)[1])
        forth = (here - there[nearest]).square().sum(1).mean()
        back = (here[owner] - there).square().sum(1).mean()
        squares.append(0.5 * (forth + back))
    return (torch.stack(squares) + 1e-12).sqrt().mean()


def surface_points(points: np.ndarray) -> np.ndarray:
    """Which of the points (N, 3) that fill a body evenly have neighbours on one side only, (N,) bool."""
    distance, index = cKDTree(points).query(points, k=min(NEIGHBOURS + 1, len(points)))
    offset = points[index[:, 1:]].mean(axis=1) - points
    return np.linalg.norm(offset, axis=1) > ONE_SIDED * distance[:, 1:].mean(axis=1)


def mean_distance(field: np.ndarray) -> float:
    """Mean distance [m] of a residual field (K, N, 3)."""
    return float(np.linalg.norm(field, axis=2).mean())
