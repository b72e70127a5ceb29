"""The part of a picture around the object, and particles rendered into it."""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass

import cv2
import numpy as np
import torch

from masiv.models.filmed_body import FilmedBody
from masiv.scene.camera import Camera
from masiv.splat.rasteriser import Rendering, render

MARGIN_PIXELS = 6
"""Width of the border around the bounding box of the mask."""
PARTICLE_OPACITY = 0.9
PIXELS_A_PARTICLE = 4
"""Pixels along the spacing of the particles that silhouettes and colors of particles are compared with, at most: the
standard deviation of a particle's Gaussian is a tenth of the spacing or more. Chosen, as ``PIXELS_A_VOXEL``."""
MAX_BYTES = 1 << 26
"""Of the windows that are kept for one recording [bytes]."""


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

    @property
    def nbytes(self) -> int:
        """Memory of the tensors [bytes]."""
        return self.image.nbytes + self.mask.nbytes + self.valid.nbytes


class PictureWindows:
    """``picture_window(problem, view, frame)``, with the windows used last, at most ``MAX_BYTES``.

    A window has as many pixels as the particles resolve, so it is small where a picture is large: a search compares
    each of its rollouts with the same pictures. The windows are pickled with the object.
    """

    def __init__(self, problem: FilmedBody) -> None:
        self.problem = problem
        self._windows: OrderedDict[tuple[int, int], PictureWindow] = OrderedDict()
        self._bytes = 0

    def __call__(self, view: int, frame: int) -> PictureWindow:
        """The window, made again if it was dropped."""
        key = view, frame
        if key in self._windows:
            self._windows.move_to_end(key)
            return self._windows[key]
        found = picture_window(self.problem, view, frame)
        self._windows[key] = found
        self._bytes += found.nbytes
        while self._bytes > MAX_BYTES and len(self._windows) > 1:
            self._bytes -= self._windows.popitem(last=False)[1].nbytes
        return found


def picture_window(problem: FilmedBody, view: int, frame: int) -> PictureWindow:
    """The window of a picture of the scene of ``problem``; the whole picture if its mask is empty.

    A picture with many more pixels than the particles resolve (``PIXELS_A_PARTICLE``) is averaged down.
    """
    picture, camera = problem.scene.frame(view, frame), problem.scene.cameras[view]
    rows, columns = np.nonzero(picture.mask > 0.5)
    crop = slice(None), slice(None)
    factor = _reduction(problem, camera)
    if len(rows) > 0:
        margin = MARGIN_PIXELS * factor
        y0, y1 = max(rows.min() - margin, 0), min(rows.max() + margin + 1, camera.height)
        x0, x1 = max(columns.min() - margin, 0), min(columns.max() + margin + 1, camera.width)
        crop = slice(y0, y1), slice(x0, x1)
        camera = camera.cropped(int(x0), int(y0), int(x1 - x0), int(y1 - y0))
    image, mask, valid = picture.image[crop], picture.mask[crop], picture.valid[crop]
    factor = min(factor, *mask.shape)
    if factor > 1:
        camera = camera.reduced(factor)
        size = camera.width, camera.height
        whole = slice(0, size[1] * factor), slice(0, size[0] * factor)
        image, mask, valid = (
            cv2.resize(part[whole].astype(np.float32), size, interpolation=cv2.INTER_AREA)
            for part in (image, mask, valid)
        )
        valid = valid > 1 - 1e-4
    pixels = torch.as_tensor(image.astype(np.float32) / 255)
    # Copies of what is cropped: a view of it would keep the whole picture in memory.
    return PictureWindow(camera, pixels, torch.as_tensor(mask).contiguous(), torch.as_tensor(valid).contiguous())


def _reduction(problem: FilmedBody, camera: Camera) -> int:
    """Side of the blocks of pixels that are averaged: a particle of the body at rest is ``PIXELS_A_PARTICLE`` of them
    wide, or fewer if the picture has no more."""
    centre = to_world(problem, problem.particles.mean(0, keepdim=True)).double().numpy()
    depth = float(camera.project(centre)[1][0])
    focal = math.sqrt(camera.intrinsics[0, 0] * camera.intrinsics[1, 1])
    return max(1, int(focal * particle_spacing(problem) / (max(depth, 1e-9) * PIXELS_A_PARTICLE)))


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
