"""The solid that a point cloud encloses, or fills.

The exterior is what can be reached from outside without coming nearer to a point than a radius r (alpha shapes,
Edelsbrunner and Mücke 1994, on a grid). The smallest r that closes the cloud is taken. Near the points the surface is
that of their tangent planes (Hoppe et al. 1992), oriented towards the exterior.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from masiv.continuum.density_field import DensityField
from masiv.errors import MasivError
from masiv.scene.cloud import Cloud
from masiv.scene.scene import Ground

_RADII = np.geomspace(1.0, 6.0, 12)
"""r that are tried, over the spacing of the points."""
_CLOSED = 0.9
"""r closes the cloud if it encloses this share of the largest volume that any r encloses."""
_LEAST_ENCLOSED = 0.25
"""Enclosed voxels over occupied cells of the surface. A closed sheet one voxel thick has about a half, the pockets of
an open one nearly none."""
_PLANES, _NORMAL_NEIGHBOURS = 8, 12
"""Tangent planes that are averaged at a voxel, and points that one is fitted to."""
_SHARE_ROUNDS = 6
_DEEP_SHARE = 0.5
"""Points far from the exterior, over their number if the points filled the solid evenly: 0 for a surface, 1 for a
volume."""


def cloud_volume(cloud: Cloud, resolution: int, ground: Ground | None, what: str) -> DensityField:
    """The solid of ``cloud`` on a grid with ``resolution`` voxels along its longest side.

    What lies on the ground may be open there, since nothing sees a bottom. Raises MasivError, naming ``what``, if the
    cloud encloses no volume.
    """
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    voxel = float((high - low).max()) / resolution
    points, normals = _thinned(cloud, 0.75 * voxel)
    tree = cKDTree(points)
    spacing = max(float(np.median(np.asarray(tree.query(points, k=2)[0])[:, 1])), 0.5 * voxel)
    margin = int(np.ceil(_RADII[-1] * spacing / voxel)) + 2
    lower = low - margin * voxel
    counts = np.ceil((high - low) / voxel).astype(int) + 1 + 2 * margin
    axes = [lower[k] + voxel * np.arange(counts[k]) for k in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    away = np.asarray(tree.query(grid.reshape(-1, 3))[0]).reshape(counts)
    below = np.zeros(counts, bool) if ground is None else grid @ ground.normal < ground.height
    index = np.rint((points - lower) / voxel).astype(int)
    filled = _filled_volume(away, below, index, voxel, spacing)
    density = _enclosed_volume(grid, away, below, points, normals, index, voxel, spacing) if filled is None else filled
    density = ndimage.uniform_filter(density, size=3, mode="constant")
    if not (density > 0.5).any():
        raise MasivError(
            f"{what} encloses no volume: a surface needs points all around (it may be open at the ground, which "
            "scene.yaml declares), closer to each other than the body is thick"
        )
    return DensityField(density.astype(np.float32), lower, voxel)


def _thinned(cloud: Cloud, cell: float) -> tuple[np.ndarray, np.ndarray | None]:
    """Mean points (N, 3), and normals, of the occupied cells: even spacing, and less noise where points are dense."""
    key = np.floor((cloud.points - cloud.points.min(axis=0)) / cell).astype(np.int64)
    _, index, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    index = index.ravel()

    def mean(rows: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(index, rows[:, k]) for k in range(3)], axis=1) / count[:, None]

    if cloud.normals is None:
        return mean(cloud.points), None
    normals = mean(cloud.normals)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    # Normals of two sides of a thin part cancel: they are then estimated as if none were given.
    return mean(cloud.points), None if length.min() < 0.1 else normals / length


def _exterior(away: np.ndarray, below: np.ndarray, radius: float) -> np.ndarray:
    """What can be reached from the border at a distance above ``radius`` [m] from all points and above the ground."""
    labels = np.empty(away.shape, np.int32)
    ndimage.label((away > radius) & ~below, output=labels)
    border = [labels[0], labels[-1], labels[:, 0], labels[:, -1], labels[:, :, 0], labels[:, :, -1]]
    outside = np.unique(np.concatenate([face.ravel() for face in border]))
    return np.isin(labels, outside[outside > 0])


def _filled_volume(
    away: np.ndarray, below: np.ndarray, index: np.ndarray, voxel: float, spacing: float
) -> np.ndarray | None:
    """Density of the solid that the points fill evenly; None if they lie on its surface."""
    radius = max(1.5 * spacing, voxel)
    exterior = _exterior(away, below, radius)
    depth = voxel * np.asarray(ndimage.distance_transform_edt(~exterior & ~below))
    solid = depth > radius  # of the points alone: their outermost layer is its boundary
    far = depth > 2 * radius + 2 * voxel
    if not far.any():
        return None
    deep = float(far[tuple(index.T)].mean()) / (float(far.sum()) / float(solid.sum()))
    if deep < _DEEP_SHARE:
        return None
    # A particle stands for the volume around it: the surface is half a spacing outside of the outermost ones.
    share = 0.0
    for _ in range(_SHARE_ROUNDS):
        share = (float((depth > radius - 0.5 * share).sum()) * voxel**3 / len(index)) ** (1 / 3)
    return _offset(depth, radius - 0.5 * share, voxel)


def _offset(depth: np.ndarray, level: float, voxel: float) -> np.ndarray:
    return np.clip(0.5 + (depth - level) / voxel, 0.0, 1.0)


def _enclosed_volume(
    grid: np.ndarray,
    away: np.ndarray,
    below: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray | None,
    index: np.ndarray,
    voxel: float,
    spacing: float,
) -> np.ndarray:
    """Density of the solid inside a surface. All zero if no radius closes it."""
    radii = np.maximum(_RADII * spacing, 0.9 * voxel)
    hulls = [(radius, _exterior(away, below, radius)) for radius in radii]
    enclosed = [_between(away, below, exterior, radius).sum() for radius, exterior in hulls]
    if max(enclosed) < _LEAST_ENCLOSED * len(points):
        return np.zeros(away.shape)
    radius, exterior = hulls[next(k for k, n in enumerate(enclosed) if n >= _CLOSED * max(enclosed))]
    nearest = np.empty((3, *away.shape), np.int32)
    ndimage.distance_transform_edt(~exterior, return_distances=False, return_indices=True, indices=nearest)
    outwards = grid[tuple(nearest[(slice(None), *index.T)])] - points
    if normals is None:
        normals = _normals(points, outwards)
    near = away <= radius + voxel
    density = np.where(exterior | below, 0.0, 1.0)
    distance, planes = cKDTree(points).query(grid[near], k=min(_PLANES, len(points)))
    weight = np.exp(-0.5 * (distance / (distance[:, :1] + 0.5 * spacing)) ** 2)
    heights = ((grid[near][:, None] - points[planes]) * normals[planes]).sum(-1)
    height = (weight * heights).sum(1) / weight.sum(1)
    density[near] = np.clip(0.5 - height / voxel, 0.0, 1.0)
    density[exterior & (away > radius)] = 0.0
    density[below] = 0.0
    return density


def _between(away: np.ndarray, below: np.ndarray, exterior: np.ndarray, radius: float) -> np.ndarray:
    """Voxels nearer to the enclosed part than to the exterior: the surface is half-way between them."""
    inner = ~exterior & ~below & (away > radius)
    if not inner.any():
        return inner
    to_inner, to_exterior = (ndimage.distance_transform_edt(~part) for part in (inner, exterior))
    return (np.asarray(to_inner) < np.asarray(to_exterior)) & ~below


def _normals(points: np.ndarray, outwards: np.ndarray) -> np.ndarray:
    """Normals (N, 3) across the plane of the nearest points, on the side of ``outwards`` (N, 3)."""
    near = points[cKDTree(points).query(points, k=min(_NORMAL_NEIGHBOURS, len(points)))[1]]
    arms = near - near.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", arms, arms))[1][:, :, 0]
    return normals * np.where((normals * outwards).sum(1, keepdims=True) < 0, -1.0, 1.0)
