"""A ball before cameras that measure depth too: where a ray meets a sphere, computed ray by ray."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from ring_scene import pixel_rays, spheres_scene

from masiv.scene.camera import Camera
from masiv.scene.depth import DepthNoise
from masiv.scene.scene import Frame, Scene

CENTRE, RADIUS = np.array([0.15, 0.5, -0.1]), 0.25
NOISE = DepthNoise(constant=2e-3, quadratic=0.0)


def ball_depth(camera: Camera, centre: np.ndarray = CENTRE, radius: float = RADIUS) -> np.ndarray:
    """Depth (H, W) float32 [m] of a ball along the optical axis, 0 beside it."""
    rays = pixel_rays(camera)
    offset = centre - camera.centre
    along = rays @ offset
    inside = radius**2 - (offset @ offset - along**2)
    distance = along - np.sqrt(np.maximum(inside, 0))
    forward = rays @ camera.world_to_camera[2, :3]
    return np.where(inside > 0, distance * forward, 0).astype(np.float32)


def ball_with_depth(cameras: tuple[Camera, ...], *, noise: bool = False, holes: float = 0.0, frames: int = 2) -> Scene:
    """The scene; ``noise``: of ``NOISE`` and steps of a millimetre; ``holes``: share of pixels without a depth."""
    scene = spheres_scene(lambda frame: [(CENTRE, RADIUS)], cameras=cameras, frame_count=frames)

    def load(view: int, frame: int) -> Frame:
        picture, random = scene.load(view, frame), np.random.default_rng((view, frame))
        depth = ball_depth(cameras[view])
        if noise:
            measured = np.round(1e3 * (depth + NOISE.constant * random.normal(size=depth.shape))) / 1e3
            depth = np.where(depth > 0, measured, 0).astype(np.float32)
        depth = np.where(random.random(depth.shape) < holes, 0, depth).astype(np.float32)
        return replace(picture, depth=depth)

    return replace(scene, load=load, depth_noise=NOISE)
