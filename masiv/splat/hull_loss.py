"""Distance between Gaussians and the visual hull of a frame: guidance over a long range while frames are added.

The gradient of an image acts on a Gaussian only if the two overlap. At an impact a point can move between two frames by
several times the thickness of its part.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree

from masiv.hull.carve import VisualHull


class HullLoss:
    """Distance between Gaussians and the hull of one frame, in both directions, so that no part of it stays empty."""

    def __init__(self, hull: VisualHull) -> None:
        self.spacing = hull.spacing
        self.volume = cKDTree(hull.points)
        self.surface = torch.tensor(hull.points[hull.surface], dtype=torch.float32)

    def draw(self, means: int, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Indices of ``count`` of the ``means`` Gaussians, and of ``count`` points of the hull's surface."""
        gaussians = rng.integers(means, size=min(count, means))
        return gaussians, rng.integers(len(self.surface), size=min(count, len(self.surface)))

    def __call__(self, means: torch.Tensor, gaussians: np.ndarray, surface: np.ndarray) -> torch.Tensor:
        """Mean distance [m] beyond two voxels, of ``gaussians`` to the hull and of ``surface`` points to the Gaussians.

        means (N, 3) [m]. Nearest neighbours are found without a gradient.
        """
        chosen, on_surface = means[torch.from_numpy(gaussians)], self.surface[torch.from_numpy(surface)]
        positions = means.detach().numpy()
        nearest = self.volume.query(positions[gaussians])[1]
        hull = torch.tensor(self.volume.data[nearest], dtype=torch.float32)
        # This tree is used once, and one that is not balanced is built in half the time.
        owner = cKDTree(positions, balanced_tree=False, compact_nodes=False).query(on_surface.numpy())[1]
        to_hull, to_gaussians = chosen - hull, means[torch.from_numpy(owner)] - on_surface
        return self._excess(to_hull).mean() + self._excess(to_gaussians).mean()

    def _excess(self, offset: torch.Tensor) -> torch.Tensor:
        length = (offset.square().sum(-1) + 1e-12).sqrt()
        return torch.relu(length - 2 * self.spacing)
