"""Distance between Gaussians and the visual hull of a frame: guidance over a long range while frames are added.

The gradient of an image acts on a Gaussian only if the two overlap. At an impact a point can move between two frames by
several times the thickness of its part.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree

from masiv.hull.carve import VisualHull

MAX_POINTS = 6_000_000
"""Of the search trees that one fit keeps: about 40 bytes each. Hulls themselves take 3 bytes a voxel."""


class TreeCache:
    """The search trees of the hulls that were used last, of at most ``max_points`` points together."""

    def __init__(self, max_points: int = MAX_POINTS) -> None:
        self.max_points = max_points
        self._trees: OrderedDict[int, cKDTree] = OrderedDict()

    @property
    def points(self) -> int:
        """Points of the trees that are kept."""
        return sum(tree.n for tree in self._trees.values())

    def tree(self, hull: HullLoss) -> cKDTree:
        """The tree of the voxels of ``hull``, made again if it was dropped."""
        key = id(hull)
        if key not in self._trees:
            self._trees[key] = cKDTree(hull.points())
            while len(self._trees) > 1 and self.points > self.max_points:
                self._trees.popitem(last=False)
        self._trees.move_to_end(key)
        return self._trees[key]

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled without its trees."""
        return TreeCache, (self.max_points,)


class HullLoss:
    """Distance between Gaussians and the hull of one frame, in both directions, so that no part of it stays empty.

    Voxels are kept as indices into the coordinates of their lattice. ``cache``: shared by the hulls of a fit.
    """

    def __init__(self, hull: VisualHull, cache: TreeCache | None = None) -> None:
        self.spacing = hull.spacing
        self.cache = cache or TreeCache()
        self._axes, indices = zip(*(np.unique(column, return_inverse=True) for column in hull.points.T), strict=True)
        small = np.min_scalar_type(max(len(axis) for axis in self._axes) - 1)
        self._indices = np.stack(indices, axis=1).astype(small)
        self._surface = np.flatnonzero(hull.surface).astype(np.int32)

    def points(self) -> np.ndarray:
        """Centres (M, 3) [m] of the voxels, those of the hull to the last bit."""
        return np.stack([axis[self._indices[:, k]] for k, axis in enumerate(self._axes)], axis=1)

    def draw(self, means: int, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Indices of ``count`` of the ``means`` Gaussians, and of ``count`` points of the hull's surface."""
        gaussians = rng.integers(means, size=min(count, means))
        return gaussians, rng.integers(len(self._surface), size=min(count, len(self._surface)))

    def __call__(self, means: torch.Tensor, gaussians: np.ndarray, surface: np.ndarray) -> torch.Tensor:
        """Mean distance [m] beyond two voxels, of ``gaussians`` to the hull and of ``surface`` points to the Gaussians.

        means (N, 3) [m]. Nearest neighbours are found without a gradient.
        """
        tree = self.cache.tree(self)
        on_surface = torch.tensor(tree.data[self._surface[surface]], dtype=torch.float32)
        chosen = means[torch.from_numpy(gaussians)]
        positions = means.detach().numpy()
        nearest = tree.query(positions[gaussians])[1]
        hull = torch.tensor(tree.data[nearest], dtype=torch.float32)
        # This tree is used once, and one that is not balanced is built in half the time.
        owner = cKDTree(positions, balanced_tree=False, compact_nodes=False).query(on_surface.numpy())[1]
        to_hull, to_gaussians = chosen - hull, means[torch.from_numpy(owner)] - on_surface
        return self._excess(to_hull).mean() + self._excess(to_gaussians).mean()

    def _excess(self, offset: torch.Tensor) -> torch.Tensor:
        length = (offset.square().sum(-1) + 1e-12).sqrt()
        return torch.relu(length - 2 * self.spacing)
