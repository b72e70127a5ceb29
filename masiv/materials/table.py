"""The lattice of strain features on which the networks of a neural law are evaluated."""

from __future__ import annotations

import functools

import torch

# Features: signed volume, size of the shear, kind of the shear (``NeuralLaw.features``). F = I is a node. Strains are
# seen logarithmically, so the lattice reaches volume changes by e^4 and stretches by e^6.
STEP = 0.25
LOWER = (-6.0, 0.0, -1.0)
COUNTS = (49, 33, 9)


@functools.lru_cache(maxsize=2)
def nodes(dtype: torch.dtype) -> torch.Tensor:
    """Features (K, 3) of the nodes, the last axis fastest."""
    axes = [low + STEP * torch.arange(count, dtype=dtype) for low, count in zip(LOWER, COUNTS, strict=True)]
    return torch.cartesian_prod(*axes)


def interpolate(table: torch.Tensor, features: torch.Tensor) -> torch.Tensor:
    """Values (N, C) of ``table`` (K, C) at features (N, 3), trilinear, constant beyond the lattice."""
    counts = torch.tensor(COUNTS, dtype=features.dtype)
    scaled = (features - torch.tensor(LOWER, dtype=features.dtype)) / STEP
    scaled = torch.minimum(scaled.clamp_min(0), counts - 1)
    cell = torch.minimum(scaled.detach().floor(), counts - 2)
    inside = scaled - cell
    cell = cell.long()
    out = torch.zeros(len(features), table.shape[1], dtype=features.dtype)
    for corner in torch.cartesian_prod(*[torch.arange(2)] * 3):
        weight = torch.where(corner.bool(), inside, 1 - inside).prod(1, keepdim=True)
        i, j, k = (cell + corner).unbind(1)
        out = out + weight * table[(i * COUNTS[1] + j) * COUNTS[2] + k]
    return out
