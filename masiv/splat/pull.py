"""Long-range guidance while frames come in: hulls say where the object is, and motion goes on as it went.

A picture pulls on a Gaussian only where the two already overlap; at an impact a point can leave the expected place by
several times its part's thickness between two frames.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree

from masiv.hull.carve import VisualHull
from masiv.splat.deformation import DeformationNetwork

_CATCH_UP_STEPS = 60
_CATCH_UP_POINTS = 400


class HullPull:
    """How far Gaussians are from the hull of one frame: both ways, so that no part of the hull stays empty."""

    def __init__(self, hull: VisualHull) -> None:
        self.spacing = hull.spacing
        self.volume = cKDTree(hull.points)
        self.shell = torch.tensor(hull.points[hull.surface], dtype=torch.float32)

    def draw(self, means: int, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Indices of ``count`` of the ``means`` Gaussians and of as many points of the hull's surface."""
        inside = rng.integers(means, size=min(count, means))
        return inside, rng.integers(len(self.shell), size=min(count, len(self.shell)))

    def __call__(self, means: torch.Tensor, inside: np.ndarray, outside: np.ndarray) -> torch.Tensor:
        """Mean distance [m] beyond two voxels, over the Gaussians ``inside`` and the points ``outside``.

        means (N, 3) [m]. Nearest neighbours are found without a gradient.
        """
        here, shell = means[torch.from_numpy(inside)], self.shell[torch.from_numpy(outside)]
        positions = means.detach().numpy()
        nearest = self.volume.query(positions[inside])[1]
        hull = torch.tensor(self.volume.data[nearest], dtype=torch.float32)
        # A tree for one step: a plain one is built in half the time.
        owner = cKDTree(positions, balanced_tree=False, compact_nodes=False).query(shell.numpy())[1]
        return self._beyond(here - hull).mean() + self._beyond(means[torch.from_numpy(owner)] - shell).mean()

    def _beyond(self, offset: torch.Tensor) -> torch.Tensor:
        length = (offset.square().sum(-1) + 1e-12).sqrt()
        return torch.relu(length - 2 * self.spacing)


def continue_motion(
    network: DeformationNetwork, means: torch.Tensor, frame: int, rate: float, rng: np.random.Generator
) -> None:
    """Teach ``network`` to expect, at ``frame``, what the two frames before it lead to, and to keep the earlier ones.

    What is left after the base motion goes on at constant velocity. means (N, 3) [m] at frame 0.
    """
    if frame < 2:
        return
    times = torch.arange(frame + 1) / network.fps
    points = means[torch.from_numpy(rng.permutation(len(means))[:_CATCH_UP_POINTS])]
    with torch.no_grad():
        base = network.base_displacements(times)
        target = network.displacements(points, times)
        left = target - base[:, None]
        target[frame] = base[frame] + 2 * left[frame - 1] - left[frame - 2]
    weights = [p for name, p in network.named_parameters() if name != "base_motion"]
    optimiser = torch.optim.Adam(weights, lr=rate)
    extent = network.settings["half_extent"]
    for _ in range(_CATCH_UP_STEPS):
        chosen = np.append(rng.permutation(frame)[:3], frame)
        optimiser.zero_grad()
        loss = (network.displacements(points, times[chosen]) - target[chosen]).square().mean() / extent**2
        loss.backward()
        optimiser.step()
