"""The solid continuum of one frame: the visual hull behind the rendered surface, filled with evenly spaced particles.

Follows the filling of GIC (Cai et al. 2024), as MASIV does (section "Continuum Trajectory Estimation"), with the visual
hull in place of opacity seeds: candidates inside every silhouette and behind the rendered surface, a mean filter and a
threshold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage

from masiv.continuum.cloud_volume import cloud_volume
from masiv.continuum.config import TrajectoryConfig
from masiv.continuum.density_field import DensityField, even_points
from masiv.errors import MasivError
from masiv.hull.carve import visual_hull
from masiv.hull.depth import depth_views
from masiv.hull.shadow_volume import remove_shadow_volume
from masiv.hull.silhouette import Silhouette, sample_bilinear, silhouettes
from masiv.hull.symmetry import MirrorPlane, symmetric_hull
from masiv.hull.volume import VolumePrior
from masiv.scene.camera import Camera
from masiv.scene.scene import Scene
from masiv.splat.dynamic import DynamicGaussians
from masiv.splat.rasteriser import render

_SMALLEST_PIECE = 0.1
"""Connected pieces smaller than this fraction of the largest one are noise of the masks."""
_TOLERANCE_GROWTH = 1.25
"""Factor of one step in the search for a tolerance of depth that leaves a probable volume."""
_FINER = (1, 2, 4)
"""Voxels along the longest side that are tried, in ``fill_resolution``: a fluid spreads to a layer of a few voxels."""


@dataclass(frozen=True)
class FilledVolume:
    """Particles that fill the object at one frame.

    points (M, 3) float64 [m, world]; spacing [m]: each particle stands for spacing³; volume = M spacing³ [m³].
    """

    points: np.ndarray
    spacing: float
    volume: float


def fill_volume(
    scene: Scene,
    dynamic: DynamicGaussians | None,
    frame: int,
    config: TrajectoryConfig,
    *,
    spacing: float | None = None,
    volume: float | None = None,
    prior: VolumePrior | None = None,
) -> FilledVolume:
    """Fill the object of ``frame`` with about ``config.particle_count`` particles, or with the given ``spacing`` [m].

    volume [m³]: of the object's hull at frame 0, if known; see ``remove_shadow_volume``. prior: of the object's volume.
    Without ``dynamic`` only the silhouettes carve. Raises MasivError if nothing is left of the object or it is thinner
    than ``spacing``.
    """
    field = density_field(scene, dynamic, frame, config, volume=volume, prior=prior)
    if spacing is None:
        spacing = float((field.volume / config.particle_count) ** (1 / 3))
    points = even_points(field, spacing)
    if len(points) == 0:
        raise MasivError(
            f"frame {frame} of {scene.path}: the object is thinner than the particle spacing {1e3 * spacing:.1f} mm; "
            "raise trajectory.particle_count"
        )
    return FilledVolume(points, spacing, len(points) * spacing**3)


def hull_volume(scene: Scene, config: TrajectoryConfig) -> float | None:
    """Volume [m³] of the object's hull at frame 0; None for point clouds, which have no shadow volume."""
    return None if scene.load_cloud is not None else visual_hull(scene, 0, resolution=config.fill_resolution).volume


def fill_later_frame(
    scene: Scene,
    dynamic: DynamicGaussians,
    frame: int,
    config: TrajectoryConfig,
    start: FilledVolume,
    volume: float | None,
    prior: VolumePrior | None = None,
) -> FilledVolume | None:
    """``fill_volume``, a little finer than ``start`` fills frame 0; None for a frame without a picture."""
    if frame not in scene.observed_frames:
        return None
    return fill_volume(scene, dynamic, frame, config, spacing=0.9 * start.spacing, volume=volume, prior=prior)


def density_field(
    scene: Scene,
    dynamic: DynamicGaussians | None,
    frame: int,
    config: TrajectoryConfig,
    *,
    volume: float | None = None,
    prior: VolumePrior | None = None,
    mirror: MirrorPlane | None = None,
) -> DensityField:
    """Carve ``frame`` by its silhouettes and, with ``dynamic``, by the depth of the rendered surface; smooth it.

    Of a point cloud, the solid that it encloses or fills.

    volume [m³]: of the object's hull at frame 0, if known; see ``remove_shadow_volume``. prior: of the object's volume.
    mirror: plane of symmetry of the object at this frame, if it is known.
    The depth of a surface that was fitted to noisy pictures is biased. If so much is carved that the volume is
    improbable (``VolumePrior.lower``), the depth counts less: its tolerance grows until the volume is not. A layer of
    two voxels does not survive the filter: if it alone makes the volume improbable, voxels are finer.
    """
    if scene.load_cloud is not None:
        return cloud_volume(
            scene.cloud(frame), config.fill_resolution, scene.ground, f"the cloud of frame {frame} of {scene.path}"
        )
    probable = 0.0 if prior is None else prior.lower
    for resolution in (config.fill_resolution * k for k in _FINER):
        field, filtered, unfiltered = _carved(scene, dynamic, frame, config, resolution, volume, prior, mirror)
        if filtered > probable or unfiltered <= probable:  # enough is left, or it is not the filter that takes it
            break
    if field.volume == 0:
        raise MasivError(f"frame {frame} of {scene.path}: nothing is left of the object behind its rendered surface")
    return field


def _carved(
    scene: Scene,
    dynamic: DynamicGaussians | None,
    frame: int,
    config: TrajectoryConfig,
    resolution: int,
    volume: float | None,
    prior: VolumePrior | None,
    mirror: MirrorPlane | None,
) -> tuple[DensityField, float, float]:
    """``density_field`` with ``resolution`` voxels along the longest side; volume [m³] of the silhouettes alone, with
    the filter and without it."""
    views = silhouettes(scene, frame, resolution)
    hull = visual_hull(scene, frame, resolution=resolution, views=views)
    if volume is not None:
        hull = remove_shadow_volume(scene, frame, hull, volume, views)
    if mirror is not None:
        hull = symmetric_hull(hull, mirror)
    spacing = hull.spacing
    margin = 2
    lower = hull.points.min(axis=0) - margin * spacing
    index = np.rint((hull.points - lower) / spacing).astype(int)
    outside = _outside_of_masks(views, hull.points, 0.25 * spacing)
    for depth in depth_views(scene, frame, views):
        outside = np.maximum(outside, np.maximum(depth.outside(hull.points), depth.behind(hull.points)))
    # A voxel at the edge of a silhouette, or at a measured surface, has the density of the part that is inside.
    filled = np.clip(0.5 - outside / spacing, 0.0, 1.0)

    def smoothed(empty: np.ndarray | None) -> DensityField:
        density = np.zeros(index.max(axis=0) + 1 + margin, np.float32)
        density[tuple(index.T)] = filled if empty is None else np.where(empty, 0.0, filled)
        density = ndimage.uniform_filter(density, size=3, mode="constant")
        # What is outside keeps its density: the surface of the interpolated field is where it falls to one half.
        solid = density > 0.5
        density[solid & ~_main_pieces(solid)] = 0.0
        return DensityField(density, lower, spacing)

    whole = smoothed(None)
    volumes = whole.volume, float(filled.sum()) * spacing**3
    if dynamic is None:
        return whole, *volumes
    excess = depth_in_front(dynamic, [view.camera for view in views], frame / scene.fps, hull.points)
    tolerance = config.depth_tolerance * spacing
    field = smoothed(excess > tolerance)
    while prior is not None and field.volume < prior.lower and (excess > tolerance).any():
        tolerance *= _TOLERANCE_GROWTH
        field = smoothed(excess > tolerance)
    return field, *volumes


def _outside_of_masks(views: tuple[Silhouette, ...], points: np.ndarray, tolerance: float) -> np.ndarray:
    """Largest signed distance (N,) [m] of the ``points`` of a hull to the masks, but for one view that was outvoted."""
    first, second = np.full((2, len(points)), -np.inf)
    for view in views:
        distance, _, visible = view.distances(points)
        distance = np.where(visible, distance, -np.inf)
        second = np.maximum(second, np.minimum(first, distance))
        first = np.maximum(first, distance)
    return np.where(first > tolerance, second, first)


def depth_in_front(dynamic: DynamicGaussians, cameras: Sequence[Camera], time: float, points: np.ndarray) -> np.ndarray:
    """How far points (N, 3) [m] are in front of the surface that two cameras or more show at ``time`` [s], (N,) [m].

    The second largest of the differences in depth; minus infinity where fewer than two cameras show a point.
    """
    first, second = np.full((2, len(points)), -np.inf)
    for camera in cameras:
        depth = surface_depth(dynamic, camera, time)
        # The smallest of 3 x 3 pixels: at an edge the depth of a pixel is a mean over object and background.
        depth = ndimage.minimum_filter(depth, size=3, mode="nearest")
        pixels, along = camera.project(points)
        shown = (along > 0) & (pixels >= 0).all(axis=1) & (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
        here = np.full(len(points), -np.inf)
        here[shown] = sample_bilinear(depth, pixels[shown]) - along[shown]
        second = np.maximum(second, np.minimum(first, here))
        first = np.maximum(first, here)
    return second


def _main_pieces(solid: np.ndarray) -> np.ndarray:
    """The connected pieces of ``solid`` (I, J, K) bool that are not noise."""
    labels = np.empty(solid.shape, np.int32)
    ndimage.label(solid, output=labels)
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return (sizes >= _SMALLEST_PIECE * sizes.max())[labels] & solid


def surface_depth(dynamic: DynamicGaussians, camera: Camera, time: float) -> np.ndarray:
    """Depth (H, W) [m] of the Gaussians in ``camera`` at ``time`` [s]; 0, which carves nothing, if not opaque."""
    with torch.no_grad():
        g = dynamic.at(time)
        picture = render(camera, g.means, g.scales, g.opacities, g.colours, torch.zeros(3))
    return np.where(picture.alpha.numpy() > 0.7, picture.depth.numpy(), 0.0)
