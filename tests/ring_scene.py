"""Scenes with a known answer: spheres seen by a ring of cameras, masks computed ray by ray."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from masiv.scene.camera import Camera
from masiv.scene.scene import Frame, Ground, Scene


def look_at(name: str, centre: np.ndarray, target: np.ndarray, size: int, focal: float) -> Camera:
    """A camera at ``centre`` that looks at ``target``, y up in the world."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
    intrinsics = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])
    return Camera(name, size, size, intrinsics, pose)


def ring(count: int = 8, size: int = 96, focal: float = 150.0, distance: float = 2.5) -> tuple[Camera, ...]:
    angles = 2 * np.pi * np.arange(count) / count
    heights = np.where(np.arange(count) % 2 == 0, 0.6, 1.4)
    target = np.array([0.0, 0.4, 0.0])
    return tuple(
        look_at(str(k), np.array([distance * np.cos(a), h, distance * np.sin(a)]), target, size, focal)
        for k, (a, h) in enumerate(zip(angles, heights, strict=True))
    )


def pixel_rays(camera: Camera) -> np.ndarray:
    """Unit directions (H, W, 3) in the world of the rays through the pixel centres."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1)
    rays = pixels @ np.linalg.inv(camera.intrinsics).T @ camera.world_to_camera[:3, :3]
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def spheres_scene(
    spheres_at: Callable[[int], list[tuple[np.ndarray, float]]],
    *,
    frame_count: int = 4,
    cameras: tuple[Camera, ...] | None = None,
    spoil: Callable[[int, int, np.ndarray], tuple[np.ndarray, np.ndarray]] | None = None,
) -> Scene:
    """``spheres_at(frame)`` lists (centre, radius); ``spoil(view, frame, mask) -> (mask, valid)`` may damage a view."""
    cameras = cameras or ring()

    def load(view: int, frame: int) -> Frame:
        camera = cameras[view]
        rays = pixel_rays(camera)
        mask = np.zeros((camera.height, camera.width), bool)
        for centre, radius in spheres_at(frame):
            offset = centre - camera.centre
            along = rays @ offset
            mask |= (offset @ offset - along**2) < radius**2
        image = np.where(mask[..., None], 200, 60).astype(np.uint8) * np.ones(3, np.uint8)
        mask, valid = mask.astype(np.float32), np.ones(mask.shape, bool)
        if spoil is not None:
            mask, valid = spoil(view, frame, mask)
        return Frame(image, mask, valid)

    up = np.array([0.0, 1.0, 0.0])
    return Scene(
        Path("spheres"), "test", 24.0, frame_count, cameras, -9.8 * up, up, Ground(up, 0.0), 1000.0, load, "analytic"
    )
