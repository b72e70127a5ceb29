"""Pictures of Gaussians on a black, observed or drawn background. Needs ``masiv.runtime.start``."""

from __future__ import annotations

import numpy as np
import torch

from masiv.scene.camera import Camera
from masiv.scene.scene import Ground
from masiv.splat.gaussians import Gaussians
from masiv.splat.rasteriser import render

SKY_LOW, SKY_HIGH = np.array([225.0, 230, 235]), np.array([165.0, 185, 210])
TILE_LIGHT, TILE_DARK = np.array([205.0, 200, 190]), np.array([175.0, 170, 160])


def draw(gaussians: Gaussians, camera: Camera, background: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """The picture (H, W, 3) uint8 and its alpha (H, W) float32; over ``background`` (H, W, 3) uint8, or black."""
    colours, alpha = drawn(gaussians, camera)
    return over(colours, alpha, background), alpha


def drawn(gaussians: Gaussians, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Colours (H, W, 3) times alpha, of 255, and alpha (H, W), float32."""
    with torch.no_grad():
        rendered = render(
            camera,
            gaussians.means,
            gaussians.scales,
            gaussians.opacities,
            gaussians.colours,
            torch.zeros(3, dtype=gaussians.means.dtype),
        )
    return rendered.rgb.numpy() * 255.0, rendered.alpha.numpy()


def over(colours: np.ndarray, alpha: np.ndarray, background: np.ndarray | None = None) -> np.ndarray:
    """What was ``drawn`` over ``background`` (H, W, 3) uint8, or black: (H, W, 3) uint8 (Porter & Duff 1984)."""
    if background is not None:
        colours = colours + (1.0 - alpha)[..., None] * background
    return np.clip(np.round(colours), 0, 255).astype(np.uint8)


def backdrop(camera: Camera, up: np.ndarray, ground: Ground | None, tile: float) -> np.ndarray:
    """A plain sky and, with a ground, its chequered plane with squares of ``tile`` [m]: (H, W, 3) uint8."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    pixels = np.stack([columns, rows, np.ones_like(rows)], axis=-1)
    directions = pixels @ np.linalg.inv(camera.intrinsics).T @ camera.world_to_camera[:3, :3]
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    elevation = np.clip(directions @ up, 0, 1)[..., None]
    picture = SKY_LOW + (SKY_HIGH - SKY_LOW) * elevation
    if ground is None:
        return picture.astype(np.uint8)
    slope = directions @ ground.normal
    distance = (ground.height - camera.centre @ ground.normal) / np.where(np.abs(slope) < 1e-9, -1e-9, slope)
    points = camera.centre + distance[..., None] * directions
    first = np.cross(ground.normal, np.roll(ground.normal, 1) + np.array([0.0, 0.0, 1e-3]))
    first /= np.linalg.norm(first)
    second = np.cross(ground.normal, first)
    even = (np.floor(points @ first / tile) + np.floor(points @ second / tile)) % 2 == 0
    floor = np.where(even[..., None], TILE_LIGHT, TILE_DARK)
    haze = np.exp(-np.maximum(distance, 0) / (30 * tile))[..., None]
    floor = haze * floor + (1 - haze) * SKY_LOW
    return np.where((distance > 0)[..., None], floor, picture).astype(np.uint8)


def on_black(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The object of an observed picture on black, as ``draw`` gives it: (H, W, 3) uint8."""
    return np.round(image * mask[..., None]).astype(np.uint8)
