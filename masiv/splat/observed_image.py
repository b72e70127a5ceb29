"""Pictures as the fit sees them: the object's box, averaged down to a manageable size, background removed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from masiv.scene.camera import Camera
from masiv.scene.scene import Scene


@dataclass(frozen=True)
class ObservedImage:
    """One picture of the object. camera of the crop; colour (H, W, 3) in [0, 1], zero off the object (premultiplied by
    the mask); mask (H, W) in [0, 1]; valid (H, W), share of a pixel that no occluder hides. float32 tensors."""

    camera: Camera
    colour: torch.Tensor
    mask: torch.Tensor
    valid: torch.Tensor


def observed_image(scene: Scene, view: int, frame: int, *, crop_side: int, crop_padding: int) -> ObservedImage | None:
    """The object in ``view`` at ``frame``, or None where its mask is empty.

    The box of the mask gets a margin of ``crop_padding`` (averaged) pixels, ends at the image's border, and is averaged
    over blocks of f x f pixels, f the smallest integer that makes the box at most ``crop_side`` wide and high.
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
    colour = picture.image[window].astype(np.float32) / 255 * mask[..., None]
    share = _averaged(valid, factor)
    seen = np.maximum(share, 1e-6)
    return ObservedImage(
        _shrunk(camera.cropped(x0, y0, width * factor, height * factor), factor),
        torch.from_numpy(_averaged(colour, factor) / seen[..., None]),
        torch.from_numpy(_averaged(mask, factor) / seen),
        torch.from_numpy(share),
    )


def _span(indices: np.ndarray, padding: int, factor: int, limit: int) -> tuple[int, int]:
    """First pixel and number of blocks along one axis, inside of [0, limit)."""
    start = max(0, int(indices.min()) - padding * factor)
    stop = min(limit, int(indices.max()) + 1 + padding * factor)
    blocks = math.ceil((stop - start) / factor)
    if start + blocks * factor > limit:
        start = max(0, limit - blocks * factor)
        blocks = min(blocks, (limit - start) // factor)
    return start, blocks


def _averaged(image: np.ndarray, factor: int) -> np.ndarray:
    if factor == 1:
        return np.ascontiguousarray(image)
    height, width = image.shape[0] // factor, image.shape[1] // factor
    return image.reshape(height, factor, width, factor, *image.shape[2:]).mean(axis=(1, 3))


def _shrunk(camera: Camera, factor: int) -> Camera:
    """The camera of a picture averaged over factor x factor blocks (pixel centres at +0.5, so all of K scales)."""
    intrinsics = camera.intrinsics.copy()
    intrinsics[:2] /= factor
    return replace(camera, width=camera.width // factor, height=camera.height // factor, intrinsics=intrinsics)
