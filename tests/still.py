"""A reconstruction that does not move."""

from __future__ import annotations

import numpy as np
import torch

from masiv.splat.deformation import DeformationNetwork
from masiv.splat.dynamic import DynamicGaussians
from masiv.splat.gaussians import Gaussians


def still(means: np.ndarray, scale: float) -> DynamicGaussians:
    """Opaque Gaussians that do not move."""
    means = torch.as_tensor(means, dtype=torch.float32)
    network = DeformationNetwork(
        centre=means.mean(0), half_extent=0.3, frame_count=4, fps=24.0, base_motion=torch.zeros(4, 3), width=8
    )
    count = len(means)
    gaussians = Gaussians(means, torch.full((count,), scale), torch.full((count,), 0.95), torch.ones(count, 3))
    return DynamicGaussians(gaussians, network.requires_grad_(False))
