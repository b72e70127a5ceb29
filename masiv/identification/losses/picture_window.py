"""The part of a picture around the object, and particles rendered into it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from masiv.models.filmed_body import FilmedBody
from masiv.scene.camera import Camera
from masiv.scene.scene import Scene
from masiv.splat.rasteriser import Rendering, render

MARGIN_PIXELS = 6
"""Width of the border around the bounding box of the mask."""
PARTICLE_OPACITY = 0.9


@dataclass(frozen=True)
class PictureWindow:
    """A picture cropped to its mask and a border.

    image (H, W, 3) in [0, 1]; mask (H, W) in [0, 1]; valid (H, W) bool, False for pixels that say nothing; camera: of
    the cropped picture.
    """

    camera: Camera
    image: torch.Tensor
    mask: torch.Tensor
    valid: torch.Tensor


def picture_window(scene: Scene, view: int, frame: int) -> PictureWindow:
    """The window of a picture of ``scene``; the whole picture if its mask is empty."""
    picture, camera = scene.frame(view, frame), scene.cameras[view]
    rows, columns = np.nonzero(picture.mask > 0.5)
    crop = slice(None), slice(None)
    if len(rows) > 0:
        y0, y1 = max(rows.min() - MARGIN_PIXELS, 0), min(rows.max() + MARGIN_PIXELS + 1, camera.height)
        x0, x1 = max(columns.min() - MARGIN_PIXELS, 0), min(columns.max() + MARGIN_PIXELS + 1, camera.width)
        crop = slice(y0, y1), slice(x0, x1)
        camera = camera.cropped(int(x0), int(y0), int(x1 - x0), int(y1 - y0))
    image = torch.as_tensor(picture.image[crop].astype(np.float32) / 255)
    return PictureWindow(camera, image, torch.as_tensor(picture.mask[crop]), torch.as_tensor(picture.valid[crop]))


def render_particles(
    window: PictureWindow, points: torch.Tensor, splat_sigma: float, channels: torch.Tensor
) -> Rendering:
    """Particles as Gaussians over a black background.

    points (N, 3) [m, world]; splat_sigma: standard deviation of the Gaussians [m]; channels (N, 3).
    """
    count = len(points)
    sigmas, opacities = torch.full((count,), splat_sigma), torch.full((count,), PARTICLE_OPACITY)
    return render(window.camera, points, sigmas, opacities, channels, torch.zeros(3))


def to_world(problem: FilmedBody, points: torch.Tensor) -> torch.Tensor:
    """Points (N, 3) [m, world] from points (N, 3) [m, simulation frame]."""
    rotation = torch.as_tensor(problem.axes.rotation, dtype=torch.float32)
    translation = torch.as_tensor(problem.axes.translation, dtype=torch.float32)
    return (points - translation) @ rotation


def particle_spacing(problem: FilmedBody) -> float:
    """Side [m] of the cube of volume that a particle stands for."""
    return (problem.volume / problem.count) ** (1 / 3)
