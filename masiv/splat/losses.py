"""Terms of the reconstruction loss: SSIM of small images, distance of depths, and strain between neighbours."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from scipy.spatial import cKDTree

from masiv.splat.observed_image import ObservedDepth

_WINDOW, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2


def ssim(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """Structural similarity (Wang et al. 2004) of images (H, W, C) in [0, 1], a scalar; window 11, sigma 1.5 pixels.

    The blur is two products with banded matrices, which is faster than a convolution for small images. At the border
    the window is cut and renormalized. ``other`` is blurred separately, since it usually has no gradient.
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


def depth_distance(depth: torch.Tensor, alpha: torch.Tensor, observed: ObservedDepth) -> torch.Tensor:
    """Distance [m] of rendered ``depth`` (H, W) [m] to the observed one, a scalar; 0 if they share no pixel.

    Huber's loss (Huber 1964) that turns from a square to a distance at one standard deviation σ of the measurement, so
    that noise has little weight and an outlier no more than its distance:

        |e| < σ: e² / 2σ,  else |e| - σ/2.

    The mean is weighted by 1/σ. Pixels that the Gaussians cover by half or less have no depth to compare.
    """
    weight = observed.known / observed.noise * (alpha.detach() > 0.5)
    error = (depth - observed.values).abs()
    huber = torch.where(error < observed.noise, error.square() / (2 * observed.noise), error - 0.5 * observed.noise)
    return (weight * huber).sum() / weight.sum().clamp(min=1e-6)


@lru_cache(maxsize=256)
def _blur(size: int, dtype: torch.dtype) -> torch.Tensor:
    """Gaussian blur of a line of ``size`` pixels as a (size, size) matrix whose rows sum to one."""
    offset = torch.arange(size)[:, None] - torch.arange(size)[None, :]
    weights = torch.exp(-(offset.double() ** 2) / (2 * _SIGMA**2)) * (offset.abs() <= _WINDOW // 2)
    return (weights / weights.sum(1, keepdim=True)).to(dtype)


Pairs = tuple[torch.Tensor, ...]
"""As ``neighbour_pairs`` returns them, or their two ends only."""


def neighbour_pairs(points: np.ndarray, count: int) -> Pairs:
    """Pairs of each of the ``points`` (N, 3) and its ``count`` nearest others, without duplicates.

    Returns both ends, (P,) int64 each, and the multiplicity (P,) float32: 2 if each is near the other, else 1.
    """
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

    rest (N, 3), displacement (..., N, 3) [m]; first, second (P,): ends of the pairs; times (P,): their multiplicity, 1
    if None. softening [m] is added to the rest length and limits the term of two Gaussians that nearly coincide.
    """
    before = rest[second] - rest[first]
    after = before + displacement[..., second, :] - displacement[..., first, :]
    length = _length(before)
    squares = ((_length(after) - length) / (length + softening)).square()
    return squares.mean() if times is None else (squares * (times / times.mean())).mean()


def _length(vectors: torch.Tensor) -> torch.Tensor:
    return (vectors.square().sum(-1) + 1e-12).sqrt()
