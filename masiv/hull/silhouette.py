"""Masks as signed distance fields: the distance of a world point to the silhouettes of one frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from masiv.hull.distance import distance_to_zero
from masiv.scene.camera import Camera
from masiv.scene.scene import Scene

PIXELS_A_VOXEL = 4
"""Of a mask along the side of a hull's voxel, at least, if it is averaged down: a hull's tolerance, a quarter of a
voxel, is a pixel."""


@dataclass(frozen=True)
class Silhouette:
    """One view of one frame.

    distance (H, W) float32 [pixels] to the mask's edge, negative on it. confidence (H, W) float32 in [0, 1] of the
    mask: 0 where object and background are equally probable. valid (H, W) bool. velocity (3,) [m/s] of the object if it
    is known and pixels show other times than the frame's: by a rolling shutter, or a clock with a time_offset [s].
    """

    view: int
    camera: Camera
    distance: np.ndarray
    confidence: np.ndarray
    valid: np.ndarray
    velocity: np.ndarray | None = None
    time_offset: float = 0.0

    def with_mask(self, mask: np.ndarray) -> Silhouette:
        """This view with another ``mask`` (H, W) in [0, 1]."""
        return replace(self, distance=signed_distance(mask), confidence=_confidence(mask))

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As ``Camera.project``, of points that are at ``points`` at the frame's time and move with ``velocity``."""
        pixels, depth = self.camera.project(points)
        if self.velocity is not None:
            # The row depends on the time and the time on the row: a fixed-point iteration.
            for _ in range(2):
                read = self.time_offset + self.camera.shutter.row_times(pixels[:, 1])
                pixels, depth = self.camera.project(points + read[:, None] * self.velocity)
        return pixels, depth

    def distances(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Signed distances of world points (N, 3) [m] to this silhouette, (N,) [m], measured at each point's depth.

        Negative on the object, 0 for a point that is not visible. Also returns ``inside_image`` (N,) bool and
        ``visible`` (N,) bool: inside the image and not behind an occluder.
        """
        pixels, depth = self.project(points)
        height, width = self.distance.shape
        in_front = depth > 1e-6
        pixels = np.where(in_front[:, None], pixels, -1.0)
        inside_image = in_front & (pixels >= 0).all(axis=1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
        column = np.clip(pixels[:, 0], 0, width - 1).astype(np.int32)
        row = np.clip(pixels[:, 1], 0, height - 1).astype(np.int32)
        visible = inside_image & self.valid[row, column]
        pixel_distance = sample_bilinear(self.distance, pixels)
        metres_per_pixel = np.where(in_front, depth, 0.0) / self.camera.intrinsics[0, 0]
        return np.where(visible, pixel_distance * metres_per_pixel, 0.0), inside_image, visible


def silhouettes(scene: Scene, frame: int, resolution: int | None = None) -> tuple[Silhouette, ...]:
    """The silhouettes of ``frame`` in every view that is not held out.

    resolution: of a hull [voxels]. Masks with many more pixels than it needs are averaged down (``PIXELS_A_VOXEL``);
    not if there is depth, which is compared pixel by pixel. None: every pixel is kept.
    """
    side = None if resolution is None or scene.depth_noise is not None else PIXELS_A_VOXEL * resolution

    def of(view: int, mask: np.ndarray, valid: np.ndarray) -> Silhouette:
        return silhouette(view, *_reduced(scene.cameras[view], mask, valid, side))

    found = scene.map_masks(frame, of)
    if scene.velocities is None:
        return tuple(found)
    velocity = scene.velocities[frame]
    return tuple(
        replace(s, velocity=velocity, time_offset=scene.time_offset(s.view)) if scene.shows_other_times(s.view) else s
        for s in found
    )


def silhouette(view: int, camera: Camera, mask: np.ndarray, valid: np.ndarray) -> Silhouette:
    """The silhouette of ``mask`` (H, W) in [0, 1]."""
    return Silhouette(view, camera, signed_distance(mask), _confidence(mask), valid)


def _reduced(
    camera: Camera, mask: np.ndarray, valid: np.ndarray, side: int | None
) -> tuple[Camera, np.ndarray, np.ndarray]:
    """``mask`` and ``valid`` (H, W), averaged over the largest blocks with which the box around the object keeps a
    length of ``side`` pixels; with their camera."""
    longest = 0 if side is None else max(cv2.boundingRect((mask > 0.5).astype(np.uint8))[2:])
    factor = 1 if side is None else min(longest // side, *mask.shape)
    if factor < 2:
        return camera, mask, valid
    smaller = camera.reduced(factor)
    size = smaller.width, smaller.height
    whole = slice(0, size[1] * factor), slice(0, size[0] * factor)
    averaged = cv2.resize(mask[whole].astype(np.float32), size, interpolation=cv2.INTER_AREA)
    share = cv2.resize(valid[whole].astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return smaller, averaged, share > 1 - 1e-4


def _confidence(mask: np.ndarray) -> np.ndarray:
    """Of each pixel, (H, W) float32. An outline is certain if it is next to pixels that are, though it is half full."""
    return cv2.dilate(np.abs(2 * mask - 1).astype(np.float32), np.ones((3, 3), np.uint8))


def signed_distance(mask: np.ndarray) -> np.ndarray:
    """mask (H, W) -> (H, W) float32 [pixels]: from pixel centres to the edge of {mask > 0.5}, negative on it.

    For an empty mask the distance is the diagonal of the image everywhere.
    """
    on = (mask > 0.5).astype(np.uint8)
    diagonal = float(np.hypot(*mask.shape))
    if not on.any():
        return np.full(mask.shape, diagonal, np.float32)
    distance = distance_to_zero(1 - on) - np.float32(0.5)
    # The object may continue beyond the border, so the border is not an edge of the mask. The box around the object and
    # one pixel more on each side has the edges of all pixels on it.
    padded = cv2.copyMakeBorder(on, 1, 1, 1, 1, cv2.BORDER_REPLICATE)
    column, row, width, height = cv2.boundingRect(on)
    inwards = distance_to_zero(padded[row : row + height + 2, column : column + width + 2])[1:-1, 1:-1]
    box = slice(row, row + height), slice(column, column + width)
    np.copyto(distance[box], np.float32(0.5) - np.minimum(inwards, np.float32(diagonal)), where=on[box] > 0)
    return distance


def sample_bilinear(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """image (H, W), pixels (N, 2) as (x, y) with centres at +0.5 -> (N,) float64, clamped at the border."""
    height, width = image.shape
    x = np.clip(pixels[:, 0] - 0.5, 0, width - 1)
    y = np.clip(pixels[:, 1] - 0.5, 0, height - 1)
    column, row = np.minimum(x.astype(np.int32), width - 2), np.minimum(y.astype(np.int32), height - 2)
    u, v = x - column, y - row
    top = image[row, column] * (1 - u) + image[row, column + 1] * u
    bottom = image[row + 1, column] * (1 - u) + image[row + 1, column + 1] * u
    return top * (1 - v) + bottom * v
