"""Images as the fit uses them: cropped to the object, averaged down, without their background."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import overload

import cv2
import numpy as np
import torch

from masiv.array_file import ArrayFile
from masiv.errors import MasivError
from masiv.scene.camera import Camera
from masiv.scene.scene import Frame, Scene
from masiv.splat.config import ReconstructConfig

_NEAR_PIXELS = 3
"""An estimated outline is off by less than this [averaged pixels]."""


@dataclass(frozen=True)
class ObservedDepth:
    """Depth of the object along the optical axis; float32 tensors.

    values (H, W) [m], and their standard deviation ``noise`` (H, W) [m]; known (H, W): 1 where the whole pixel is on
    the object and measured, else 0.
    """

    values: torch.Tensor
    noise: torch.Tensor
    known: torch.Tensor


@dataclass(frozen=True)
class ObservedBackground:
    """What is behind the object; float32 tensors.

    picture (H, W, 3): the image with its background. empty (H, W, 3): the scene without the object. near (H, W): 1 on
    the object and next to it, where nothing else is expected to differ from the empty scene.
    """

    picture: torch.Tensor
    empty: torch.Tensor
    near: torch.Tensor


@dataclass(frozen=True)
class ObservedImage:
    """One image of the object; float32 tensors.

    view: index of the camera among those that are fitted. camera: of the crop. colour (H, W, 3) in [0, 1], multiplied
    by the mask. mask (H, W) in [0, 1]. valid (H, W): the fraction of a pixel that no occluder hides. depth:
    measured depth of the object, if the recording has any. background: if the mask was estimated from it.
    """

    view: int
    camera: Camera
    colour: torch.Tensor
    mask: torch.Tensor
    valid: torch.Tensor
    depth: ObservedDepth | None = None
    background: ObservedBackground | None = None

    @property
    def tensors(self) -> list[list[torch.Tensor]]:
        """colour, mask and valid; those of depth; those of the background: empty lists if there is none."""
        d, b = self.depth, self.background
        return [
            [self.colour, self.mask, self.valid],
            [] if d is None else [d.values, d.noise, d.known],
            [] if b is None else [b.picture, b.empty, b.near],
        ]


class StoredImages(Sequence[ObservedImage]):
    """The images of one frame. Their pixels are in a file, and are read when an image is asked for."""

    def __init__(self, file: ArrayFile, images: Iterable[ObservedImage]) -> None:
        self._file = file
        self._images = [
            (image.view, image.camera, [[file.append(t.numpy()) for t in group] for group in image.tensors])
            for image in images
        ]

    def __len__(self) -> int:
        return len(self._images)

    @overload
    def __getitem__(self, index: int) -> ObservedImage: ...
    @overload
    def __getitem__(self, index: slice) -> list[ObservedImage]: ...
    def __getitem__(self, index: int | slice) -> ObservedImage | list[ObservedImage]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        view, camera, stored = self._images[index]
        pixels, depth, behind = ([torch.from_numpy(self._file.read(array)) for array in group] for group in stored)
        return ObservedImage(
            view,
            camera,
            *pixels,
            depth=ObservedDepth(*depth) if depth else None,
            background=ObservedBackground(*behind) if behind else None,
        )


def observed_images(scene: Scene, config: ReconstructConfig, frames: Iterable[int]) -> list[StoredImages]:
    """The images of each of ``frames`` that show the object; none for a frame without pictures. They are in one file.

    Raises MasivError if there are pictures of a frame, but none shows the object.
    """
    found, observed, file = [], set(scene.observed_frames), ArrayFile()
    for frame in frames:
        of_frame = scene.map_views(frame, partial(_of_view, scene, config, frame))
        found.append(StoredImages(file, (image for image in of_frame if image is not None)))
        if not found[-1] and frame in observed:
            raise MasivError(f"frame {frame} of {scene.path}: no view shows the object; check its masks")
    return found


def _of_view(scene: Scene, config: ReconstructConfig, frame: int, view: int, _picture: Frame) -> ObservedImage | None:
    return observed_image(scene, view, frame, crop_side=config.crop_side, crop_padding=config.crop_padding)


def observed_image(scene: Scene, view: int, frame: int, *, crop_side: int, crop_padding: int) -> ObservedImage | None:
    """The object in ``view`` at ``frame``, or None if its mask is empty.

    The crop is the bounding box of the mask plus ``crop_padding`` (averaged) pixels, inside of the image. It is
    averaged over blocks of f x f pixels; f is the smallest integer for which the box has at most ``crop_side`` pixels
    a side.
    """
    picture, camera = scene.frame(view, frame), scene.cameras[view]
    rows, columns = np.nonzero(picture.mask > 0.5)
    if len(rows) == 0:
        return None
    longest = max(int(np.ptp(rows)), int(np.ptp(columns))) + 1
    factor = math.ceil(longest / crop_side)
    x0, width = _span(columns, crop_padding, factor, camera.width)
    y0, height = _span(rows, crop_padding, factor, camera.height)
    window = (slice(y0, y0 + height * factor), slice(x0, x0 + width * factor))
    valid = picture.valid[window].astype(np.float32)
    mask = picture.mask[window] * valid
    whole, empty = picture.image[window].astype(np.float32) / 255, _empty_scene(scene, view)
    # A pixel at the outline of an estimated mask is I = a F + (1 - a) B: its part of the object is a F.
    colour = whole * mask[..., None]
    behind = None
    if empty is not None:
        colour = np.clip(whole - (1 - mask[..., None]) * empty[window], 0, mask[..., None])
        reach = np.ones((2 * _NEAR_PIXELS * factor + 1,) * 2, np.uint8)
        near = cv2.dilate((picture.mask[window] > 0.1).astype(np.uint8), reach).astype(np.float32) * valid
        behind = ObservedBackground(
            *(torch.from_numpy(_average(pixels, factor)) for pixels in (whole, empty[window], near))
        )
    visible = _average(valid, factor)
    divisor = np.maximum(visible, 1e-6)
    return ObservedImage(
        scene.views.index(view),
        camera.cropped(x0, y0, width * factor, height * factor).reduced(factor),
        torch.from_numpy(_average(colour, factor) / divisor[..., None]),
        torch.from_numpy(_average(mask, factor) / divisor),
        torch.from_numpy(visible),
        None if picture.depth is None else _observed_depth(scene, picture.depth[window], mask, factor),
        behind,
    )


def _empty_scene(scene: Scene, view: int) -> np.ndarray | None:
    """The background (H, W, 3) in [0, 1] from which masks of ``view`` were estimated."""
    empty = scene.background(view) if scene.masks_estimated else None
    return None if empty is None else empty.astype(np.float32) / 255


def _observed_depth(scene: Scene, depth: np.ndarray, mask: np.ndarray, factor: int) -> ObservedDepth | None:
    """Depth (H, W) [m] of the crop, averaged down; None if no pixel is on the object and measured as a whole."""
    known = _average(((depth > 0) & (mask > 0.99)).astype(np.float32), factor) > 1 - 1e-6
    if scene.depth_noise is None or not known.any():
        return None
    values = np.where(known, _average(depth, factor), np.float32(0))
    noise = scene.depth_noise.std(values)
    # Not divided by the factor: errors of neighbouring pixels of a depth camera are correlated.
    arrays = values, noise.astype(np.float32), known.astype(np.float32)
    return ObservedDepth(*(torch.from_numpy(np.ascontiguousarray(array)) for array in arrays))


def _span(indices: np.ndarray, padding: int, factor: int, limit: int) -> tuple[int, int]:
    """First pixel and number of blocks along one axis, inside [0, limit)."""
    start = max(0, int(indices.min()) - padding * factor)
    stop = min(limit, int(indices.max()) + 1 + padding * factor)
    blocks = math.ceil((stop - start) / factor)
    if start + blocks * factor > limit:
        start = max(0, limit - blocks * factor)
        blocks = min(blocks, (limit - start) // factor)
    return start, blocks


def _average(image: np.ndarray, factor: int) -> np.ndarray:
    if factor == 1:
        return np.ascontiguousarray(image)
    height, width = image.shape[0] // factor, image.shape[1] // factor
    return image.reshape(height, factor, width, factor, *image.shape[2:]).mean(axis=(1, 3))
