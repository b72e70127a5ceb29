"""Carving over time: a point of the object stays inside the masks and above the ground in every frame."""

from __future__ import annotations

import numpy as np
import torch

from masiv.continuum.config import TrajectoryConfig
from masiv.hull.silhouette import silhouettes
from masiv.scene.scene import Scene
from masiv.splat.deformation import DeformationNetwork


def images_against(
    scene: Scene, network: DeformationNetwork, points: np.ndarray, config: TrajectoryConfig
) -> np.ndarray:
    """How many images count against each of the frame-0 ``points`` (M, 3) [m] as they move, (M,) int.

    An image (view and frame) counts against a point that it shows more than ``config.carve_tolerance`` pixels outside
    of its mask. A frame at which a point is as far below the ground counts as all its views. The tolerance allows for
    errors of the motion, a first estimate.
    """
    against = np.zeros(len(points), np.int32)
    start = torch.as_tensor(points, dtype=torch.float32)
    for frame in range(scene.frame_count):
        with torch.no_grad():
            moved = points + network.displacements(start, torch.tensor([frame / scene.fps]))[0].double().numpy()
        views = silhouettes(scene, frame, config.fill_resolution)
        pixel = np.inf
        for view in views:
            distance, _, visible = view.distances(moved)
            width = np.median(view.camera.project(moved)[1]) / view.camera.intrinsics[0, 0]
            against += visible & (distance > config.carve_tolerance * width)
            pixel = min(pixel, width)
        if scene.ground is not None:
            below = scene.ground.height - moved @ scene.ground.normal
            against += len(views) * (below > config.carve_tolerance * pixel)
    return against
