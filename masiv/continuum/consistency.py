"""Carving across time: what belongs to the object stays in its masks and above the ground in every frame."""

from __future__ import annotations

import numpy as np
import torch

from masiv.continuum.config import TrajectoryConfig
from masiv.hull.silhouette import silhouettes
from masiv.scene.scene import Scene
from masiv.splat.deformation import DeformationNetwork


def consistent_particles(
    scene: Scene, network: DeformationNetwork, points: np.ndarray, config: TrajectoryConfig
) -> np.ndarray:
    """Which frame-0 points (M, 3) [m] their motion keeps inside of the object, (M,) bool.

    A picture (view and frame) counts against a point that it shows more than ``config.carve_tolerance`` pixels outside
    of the mask, and a frame that carries it as far below the ground counts as all its views. ``config.carve_misses``
    such pictures remove it. The tolerance is there because the motion is a first estimate.
    """
    misses = np.zeros(len(points), np.int32)
    start = torch.as_tensor(points, dtype=torch.float32)
    for frame in range(scene.frame_count):
        with torch.no_grad():
            moved = points + network.displacements(start, torch.tensor([frame / scene.fps]))[0].double().numpy()
        views = silhouettes(scene, frame)
        pixel = np.inf
        for view in views:
            distance, _, judged = view.outside(moved)
            width = np.median(view.camera.project(moved)[1]) / view.camera.intrinsics[0, 0]
            misses += judged & (distance > config.carve_tolerance * width)
            pixel = min(pixel, width)
        if scene.ground is not None:
            below = scene.ground.height - moved @ scene.ground.normal
            misses += len(views) * (below > config.carve_tolerance * pixel)
    return misses < config.carve_misses
