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


Pairs = tuple[torch.Tensor, ...]
"""As ``neighbour_pairs`` gives them, or their two ends alone."""


def neighbour_pairs(points: np.ndarray, count: int) -> Pairs:
    """Each point and its ``count`` nearest others, as pairs: both ends, two (P,) int64, and how many of the two have
    the other as a neighbour, (P,) float32. Most have each other, and a stretch is the same from both ends."""
    count = min(count, len(points) - 1)
    found = cKDTree(points).query(points, k=count + 1)[1][:, 1:]
    ends = np.sort(np.stack([np.repeat(np.arange(len(points)), count), found.ravel()], axis=1), axis=1)
    ends, times = np.unique(ends, axis=0, return_counts=True)
    first, second = (torch.from_numpy(np.ascontiguousarray(end, dtype=np.int64)) for end in ends.T)
    return first, second, torch.from_numpy(times.astype(np.float32))


def strain(
    rest: torch.Tensor,
    displacement: torch.Tensor,
    first: torch.Tensor,
    second: torch.Tensor,
    times: torch.Tensor | None = None,
    *,
    softening: float,
) -> torch.Tensor:
    """Mean squared relative change of length between neighbours, a scalar: 0 for a rigid motion.

    rest (N, 3), displacement (..., N, 3) [m]; first, second (P,) ends of the pairs, which count ``times`` (once where
    None); softening [m] is added to the rest length, so that two Gaussians that nearly coincide do not rule the sum.
    """
    before = rest[second] - rest[first]
    after = before + displacement[..., second, :] - displacement[..., first, :]
    length = _length(before)
    squares = ((_length(after) - length) / (length + softening)).square()
    return squares.mean() if times is None else (squares * (times / times.mean())).mean()


def _length(vectors: torch.Tensor) -> torch.Tensor:
    return (vectors.square().sum(-1) + 1e-12).sqrt()
