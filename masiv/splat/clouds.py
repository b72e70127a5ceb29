"""Non-rigid registration of point clouds: the motion network of ``reconstruct``, fitted to clouds in place of pictures.

Coherent motion of a point set (Myronenko and Song 2010) with the network as the field and strain as its regularizer.
Matches are nearest neighbours, and a match counts mainly along the normal (Chen and Medioni 1991): along the surface
its distance is that of two samplings, which has nothing to do with the motion.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import cKDTree

from masiv.scene.cloud import Cloud
from masiv.scene.scene import Scene
from masiv.splat.config import ReconstructConfig
from masiv.splat.deformation import DeformationNetwork
from masiv.splat.image_formation import ImageFormation
from masiv.splat.initialize import InitialGaussians
from masiv.splat.losses import Pairs
from masiv.splat.objective import Objective, Part

TANGENTIAL = 0.01
"""Weight of a match along the surface, where the weight along the normal is 1. It keeps points on a cloud's edge."""
STIFFER = 50.0
"""Factor of the weight of strain while frames are added; it falls to 1 at the end, as in non-rigid ICP (Amberg et al.
2007). A soft field lets points slide over the surface in place of turning with it, a stiff one lets them slide at an
impact. Chosen with an ellipsoid that spins (tests/cloud_scene.py; 600 steps: 36 mm off after 5 frames with a factor of
10, 10 mm with 30, 6 mm with 50, 3 mm with 100) and one soft body that hits the ground (10 mm with 30, 13 mm with 100,
18 mm with 300): more bodies would be needed to derive it."""
SOFTENING = 0.1
"""Distance, in spacings, below which the loss of a match is a square: a smaller one is noise."""
_NEIGHBOURS = 16
_COLOUR = 0.5
_FLATNESS = 0.1
"""Variance across a surface over that along it. Above this the neighbours of a point fill a volume."""


def for_clouds(config: ReconstructConfig) -> ReconstructConfig:
    """``config`` without what needs pictures: hulls, corrections of cameras, and steps on frame 0 alone, where there is
    no motion."""
    return config.model_copy(update={"hull_weight": 0.0, "first_frame_fraction": 0.0, "refine_calibration": False})


@dataclass(frozen=True)
class CloudLoss:
    """Distance between moved points and the cloud of one frame, in both directions.

    points (N, 3) float32 [m] with normals (N, 3), zero where the neighbours fill a volume; spacing [m].
    """

    tree: cKDTree
    points: torch.Tensor
    normals: torch.Tensor
    spacing: float

    @classmethod
    def of(cls, points: np.ndarray, normals: np.ndarray | None) -> CloudLoss:
        """Of ``points`` (N, 3) [m]; ``normals`` (N, 3), of any sign, are estimated if None."""
        tree = cKDTree(points)
        if normals is None:
            normals = estimated_normals(points, tree)
        rows, across = torch.tensor(points, dtype=torch.float32), torch.tensor(normals, dtype=torch.float32)
        return cls(tree, rows, across, point_spacing(tree))

    def __call__(self, moved: torch.Tensor) -> torch.Tensor:
        """Mean distance [m] of ``moved`` (M, 3) [m] to the cloud plus that of the cloud to ``moved``, a scalar.

        Nearest neighbours are found without a gradient.
        """
        positions = moved.detach().double().numpy()
        nearest = torch.from_numpy(self.tree.query(positions)[1])
        owner = cKDTree(positions, balanced_tree=False, compact_nodes=False).query(self.tree.data)[1]
        there = self._length(moved - self.points[nearest], self.normals[nearest])
        back = self._length(moved[torch.from_numpy(owner)] - self.points, self.normals)
        return there.mean() + back.mean()

    def _length(self, offset: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
        volumetric = (normals == 0).all(dim=-1)
        square = offset.square().sum(-1)
        weighted = (offset * normals).sum(-1).square() + torch.where(volumetric, 1.0, TANGENTIAL) * square
        soft = SOFTENING * self.spacing
        return (weighted + soft**2).sqrt() - soft


@dataclass(frozen=True)
class CloudObjective(Objective):
    """``Objective`` with ``clouds`` by frame in place of images. It has no gradient for the Gaussians: the points of
    frame 0 are measured, only their motion is fitted."""

    clouds: Sequence[CloudLoss] | Mapping[int, CloudLoss] = ()

    def parts(
        self, count: int, chosen: list[tuple[int, int]], hull_factor: float, rng: np.random.Generator
    ) -> tuple[Part, ...]:
        """See ``Objective.parts``. hull_factor: from stiff (1) to as configured (0), see ``STIFFER``."""
        nothing = np.zeros(0, np.int64)
        parts = super().parts(count, chosen, hull_factor, rng)
        return tuple(replace(part, hull=(nothing, nothing, hull_factor)) for part in parts)

    def part(
        self,
        gaussians: dict[str, torch.Tensor],
        network: DeformationNetwork,
        pairs: Pairs,
        part: Part,
        formation: ImageFormation | None = None,
    ) -> torch.Tensor:
        """See ``Objective.part``. There is no camera to correct."""
        means = gaussians["means"].detach()
        moments = self._moments(part, None)
        if not moments.moving:
            return 0.0 * network.base_motion.sum()
        displacements, _ = network.changes(means, moments.times)
        stiffness = 1.0 if part.hull is None else 1.0 + (STIFFER - 1.0) * part.hull[2]
        loss = stiffness * self._regularization(means, displacements, moments, pairs, replace(part, hull=None))
        for (frame, *_), k in zip(part.images, moments.of_image, strict=True):
            if frame > 0:
                distance = self.clouds[frame](means + displacements[k])
                loss = loss + self.config.cloud_weight * distance / (self.half_extent * part.image_count)
        return loss


def cloud_objective(
    scene: Scene, config: ReconstructConfig, frames: Iterable[int], count: int, scale: float, half_extent: float
) -> CloudObjective:
    """The objective of ``frames``, of whose clouds at most ``count`` points are compared."""
    frames = list(frames)
    clouds = {frame: _loss(scene.cloud(frame), count) for frame in frames}
    nothing: dict[int, list] = {frame: [None] for frame in frames}  # one "image" a frame, for the choice of frames
    return CloudObjective(for_clouds(config), scale, half_extent, scene.fps, scene.ground, {}, nothing, clouds=clouds)


def initial_from_clouds(scene: Scene, count: int) -> InitialGaussians:
    """Gaussians at most ``count`` points of the cloud of frame 0, spread evenly; see ``initial_gaussians``."""
    first = scene.cloud(0)
    chosen = even_subset(first.points, count)
    means = first.points[chosen]
    low, high = means.min(axis=0), means.max(axis=0)
    spacing = point_spacing(cKDTree(means))
    centroids = np.stack([centroid(scene.cloud(frame).points) for frame in range(scene.frame_count)])
    return InitialGaussians(
        means=means,
        scale=0.6 * spacing,
        colours=np.full((len(means), 3), _COLOUR) if first.colours is None else first.colours[chosen],
        centre=(low + high) / 2,
        half_extent=float((high - low).max() / 2 + spacing),
        base_motion=centroids - centroids[0],
        hulls=(),
        frames=(),
    )


def centroid(points: np.ndarray) -> np.ndarray:
    """Centroid (3,) of ``points`` (N, 3) whatever their density: of the occupied cells of a grid of 16."""
    low = points.min(axis=0)
    cell = max(float(np.ptp(points, axis=0).max()) / 16, 1e-9)
    _, index, count = np.unique(((points - low) / cell).astype(int), axis=0, return_inverse=True, return_counts=True)
    weight = 1.0 / count[index.ravel()]
    return (points * weight[:, None]).sum(axis=0) / weight.sum()


def even_subset(points: np.ndarray, count: int) -> np.ndarray:
    """Indices, ascending, of at most ``count`` of ``points`` (N, 3): one in each cell of the finest such grid."""
    if len(points) <= count:
        return np.arange(len(points))
    low, size = points.min(axis=0), float(np.ptp(points, axis=0).max())
    coarse, fine = size / count, size
    for _ in range(24):
        cell = np.sqrt(coarse * fine)
        first = np.unique(((points - low) / cell).astype(np.int64), axis=0, return_index=True)[1]
        coarse, fine = (cell, fine) if len(first) > count else (coarse, cell)
    first = np.unique(((points - low) / fine).astype(np.int64), axis=0, return_index=True)[1]
    return np.sort(first)


def point_spacing(tree: cKDTree) -> float:
    """Median distance [m] of a point to its nearest other one."""
    distance = np.asarray(tree.query(tree.data, k=2)[0])[:, 1]
    return max(float(np.median(distance)), 1e-9)


def estimated_normals(points: np.ndarray, tree: cKDTree) -> np.ndarray:
    """Unit normals (N, 3), of any sign: across the plane of the nearest points (Hoppe et al. 1992).

    Zero where these are not flat, as in a cloud that fills a volume.
    """
    near = points[tree.query(points, k=min(_NEIGHBOURS, len(points)))[1]]
    arms = near - near.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", arms, arms))
    flat = values[:, 0] < _FLATNESS * values[:, 1]
    return np.where(flat[:, None], vectors[:, :, 0], 0.0)


def _loss(cloud: Cloud, count: int) -> CloudLoss:
    # Normals come from all points, since they are estimated better from near ones.
    normals = cloud.normals if cloud.normals is not None else estimated_normals(cloud.points, cKDTree(cloud.points))
    chosen = even_subset(cloud.points, count)
    return CloudLoss.of(cloud.points[chosen], normals[chosen])
