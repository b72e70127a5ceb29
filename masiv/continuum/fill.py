"""The solid continuum of one frame: the visual hull behind the rendered surface, filled with evenly spaced particles.

Follows the filling of GIC (Cai et al. 2024), as MASIV does (section "Continuum Trajectory Estimation"), with the visual
hull in place of opacity seeds: candidates inside every silhouette and behind the rendered surface, a mean filter and a
threshold.
"""

from __future__ import annotations

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
from masiv.hull.silhouette import sample_bilinear, silhouettes
from masiv.scene.camera import Camera
from masiv.scene.scene import Scene
from masiv.splat.dynamic import DynamicGaussians
from masiv.splat.rasteriser import render

_SMALLEST_PIECE = 0.1
"""Connected pieces smaller than this fraction of the largest one are noise of the masks."""


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
) -> FilledVolume:
    """Fill the object of ``frame`` with about ``config.particle_count`` particles, or with the given ``spacing`` [m].

    volume [m³]: of the object's hull at frame 0, if known; see ``remove_shadow_volume``. Without ``dynamic`` only the
    silhouettes carve. Raises MasivError if nothing is left of the object or it is thinner than ``spacing``.
    """
    field = density_field(scene, dynamic, frame, config, volume=volume)
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
) -> FilledVolume | None:
    """``fill_volume``, a little finer than ``start`` fills frame 0; None for a frame without a picture."""
    if frame not in scene.observed_frames:
        return None
    return fill_volume(scene, dynamic, frame, config, spacing=0.9 * start.spacing, volume=volume)


def density_field(
    scene: Scene,
    dynamic: DynamicGaussians | None,
    frame: int,
    config: TrajectoryConfig,
    *,
    volume: float | None = None,
) -> DensityField:
    """Carve ``frame`` by its silhouettes and, with ``dynamic``, by the depth of the rendered surface; smooth it.

    Of a point cloud, the solid that it encloses or fills.

    volume [m³]: of the object's hull at frame 0, if known; see ``remove_shadow_volume``.
    """
    if scene.load_cloud is not None:
        return cloud_volume(
            scene.cloud(frame), config.fill_resolution, scene.ground, f"the cloud of frame {frame} of {scene.path}"
        )
    hull = visual_hull(scene, frame, resolution=config.fill_resolution)
    if volume is not None:
        hull = remove_shadow_volume(scene, frame, hull, volume)
    spacing = hull.spacing
    margin = 2
    lower = hull.points.min(axis=0) - margin * spacing
    index = np.rint((hull.points - lower) / spacing).astype(int)
    density = np.zeros(index.max(axis=0) + 1 + margin, np.float32)
    outside = np.full(len(hull.points), -np.inf)
    views = silhouettes(scene, frame)
    for view in views:
        distance, _, visible = view.distances(hull.points)
        outside = np.maximum(outside, np.where(visible, distance, -np.inf))
    for depth in depth_views(scene, frame, views):
        outside = np.maximum(outside, np.maximum(depth.outside(hull.points), depth.behind(hull.points)))
    # A voxel at the edge of a silhouette, or at a measured surface, has the density of the part that is inside.
    filled = np.clip(0.5 - outside / spacing, 0.0, 1.0)
    if dynamic is not None:
        filled[in_front_of_surface(scene, dynamic, frame, hull.points, config.depth_tolerance * spacing)] = 0.0
    density[tuple(index.T)] = filled
    density = ndimage.uniform_filter(density, size=3, mode="constant")
    density[~_main_pieces(density > 0.5)] = 0.0
    if not (density > 0.5).any():
        raise MasivError(f"frame {frame} of {scene.path}: nothing is left of the object behind its rendered surface")
    return DensityField(density, lower, spacing)


def in_front_of_surface(
    scene: Scene, dynamic: DynamicGaussians, frame: int, points: np.ndarray, tolerance: float
) -> np.ndarray:
    """Which points (N, 3) [m] two views or more show to be empty: nearer than the surface by ``tolerance`` [m]."""
    votes = np.zeros(len(points), np.int32)
    for view in scene.views:
        camera = scene.cameras[view]
        depth = surface_depth(dynamic, camera, frame / scene.fps)
        # The smallest of 3 x 3 pixels: at an edge the depth of a pixel is a mean over object and background.
        depth = ndimage.minimum_filter(depth, size=3, mode="nearest")
        pixels, along = camera.project(points)
        shown = (along > 0) & (pixels >= 0).all(axis=1) & (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
        votes[shown] += along[shown] < sample_bilinear(depth, pixels[shown]) - tolerance
    return votes >= 2


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
