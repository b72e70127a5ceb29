"""The lattice of strain features on which the networks of a neural law are evaluated."""

from __future__ import annotations

import functools

import torch

from masiv.kernels.lattice import LATTICE_COUNTS, LATTICE_LOWER, LATTICE_STEP

ROUNDING = 1e-5


@functools.lru_cache(maxsize=2)
def nodes(dtype: torch.dtype) -> torch.Tensor:
    """Features (K, 3) of the nodes, the last axis fastest."""
    axes = [
        low + LATTICE_STEP * torch.arange(count, dtype=dtype)
        for low, count in zip(LATTICE_LOWER, LATTICE_COUNTS, strict=True)
    ]
    return torch.cartesian_prod(*axes)


def interpolate(table: torch.Tensor, features: torch.Tensor) -> torch.Tensor:
    """Values (N, C) of ``table`` (K, C) at features (N, 3), trilinear, constant beyond the lattice."""
    counts = torch.tensor(LATTICE_COUNTS, dtype=features.dtype)
    scaled = (features - torch.tensor(LATTICE_LOWER, dtype=features.dtype)) / LATTICE_STEP
    scaled = torch.minimum(scaled.clamp_min(0), counts - 1)
    cell = torch.minimum(scaled.detach().floor(), counts - 2)
    inside = scaled - cell
    cell = cell.long()
    out = torch.zeros(len(features), table.shape[1], dtype=features.dtype)
    for corner in torch.cartesian_prod(*[torch.arange(2)] * 3):
        weight = torch.where(corner.bool(), inside, 1 - inside).prod(1, keepdim=True)
        i, j, k = (cell + corner).unbind(1)
        out = out + weight * table[(i * LATTICE_COUNTS[1] + j) * LATTICE_COUNTS[2] + k]
    return out


def lipschitz_envelope(values: torch.Tensor) -> torch.Tensor:
    """The largest table below ``values`` (K, C) that changes by no more than 1 for a unit of any feature.

    The lower envelope of cones with L1 distance, one sweep to and fro along each axis (Felzenszwalb & Huttenlocher
    2012). Where it cuts, the gradient goes to the node that a cone stands on.
    """
    grid = values.reshape(*LATTICE_COUNTS, -1)
    for axis, count in enumerate(LATTICE_COUNTS):
        shape = [1, 1, 1, 1]
        shape[axis] = count
        ramp = LATTICE_STEP * torch.arange(count, dtype=values.dtype).reshape(shape)
        for _ in range(2):
            grid = (torch.cummin(grid - ramp, dim=axis).values + ramp).flip(axis)
    bound = grid.reshape(values.shape)
    return torch.where(bound < values - ROUNDING, bound, values)  # what is not cut keeps its digits
