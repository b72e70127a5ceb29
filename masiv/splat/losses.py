"""What a reconstruction is judged by: SSIM of small pictures, and how much neighbours stretch."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from scipy.spatial import cKDTree

_WINDOW, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2


def ssim(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """Structural similarity (Wang et al. 2004) of pictures (H, W, C) in [0, 1], a scalar; window 11, sigma 1.5.

    Pictures here are small, so the blur is two products with banded matrices, cheaper than a convolution. The window is
    cut and renormalised at the border. What depends on ``other`` alone is blurred apart: it mostly has no gradient.
    """
    height, width, _ = one.shape
    rows, columns = _blur(height, one.dtype), _blur(width, one.dtype)
    one, other = (picture.permute(2, 0, 1).contiguous() for picture in (one, other))
    mean1, square1, product = (rows @ torch.cat([one, one * one, one * other]) @ columns.T).chunk(3)
    mean2, square2 = (rows @ torch.cat([other, other * other]) @ columns.T).chunk(2)
    both, means = mean1 * mean2, mean1 * mean1 + mean2 * mean2
    luminance = (2 * both + _C1) / (means + _C1)
    structure = (2 * (product - both) + _C2) / (square1 + square2 - means + _C2)
    return (luminance * structure).mean()


@lru_cache(maxsize=256)
def _blur(size: int, dtype: torch.dtype) -> torch.Tensor:
    """Gaussian blur of a line of ``size`` pixels as a (size, size) matrix whose rows sum to one."""
    offset = torch.arange(size)[:, None] - torch.arange(size)[None, :]
    weights = torch.exp(-(offset.double() ** 2) / (2 * _SIGMA**2)) * (offset.abs() <= _WINDOW // 2)
    return (weights / weights.sum(1, keepdim=True)).to(dtype)


def neighbour_pairs(points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Each point's ``count`` nearest others: indices of both ends, two (P,) int64. points (N, 3)."""
    count = min(count, len(points) - 1)
    found = cKDTree(points).query(points, k=count + 1)[1][:, 1:]
    return np.repeat(np.arange(len(points)), count), found.ravel().astype(np.int64)


def strain(
    rest: torch.Tensor, displacement: torch.Tensor, first: torch.Tensor, second: torch.Tensor, softening: float
) -> torch.Tensor:
    """Mean squared relative change of length between neighbours, a scalar: 0 for a rigid motion.

    rest (N, 3), displacement (..., N, 3) [m]; first, second (P,) ends of the pairs; softening [m] is added to the rest
    length, so that two Gaussians that nearly coincide do not rule the sum.
    """
    before = rest[second] - rest[first]
    after = before + displacement[..., second, :] - displacement[..., first, :]
    length = _length(before)
    return ((_length(after) - length) / (length + softening)).square().mean()


def _length(vectors: torch.Tensor) -> torch.Tensor:
    return (vectors.square().sum(-1) + 1e-12).sqrt()
