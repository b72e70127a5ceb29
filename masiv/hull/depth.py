"""What measured depth says of a volume: free in front of the surface, unknown behind it.

The signed distances here are along the optical axis of a view, positive on the side that is empty.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from masiv.hull.distance import distance_to_zero
from masiv.hull.silhouette import Silhouette
from masiv.scene.depth import back_projected
from masiv.scene.scene import Scene

MARGIN_SIGMAS = 3.0
"""A voxel is free if it is nearer than the surface by more than so many standard deviations of the depth. Three: with
Gaussian noise one pixel in 740 is wrong, and the nearest of nine pixels is taken."""
_LEVELS = 24
"""Radii that ``local_thickness`` distinguishes."""


@dataclass(frozen=True)
class DepthView:
    """Measured depth of one view of one frame.

    depth (H, W) [m]: of the object's surface, 0 where it is unknown or another thing. nearest (H, W) [m]: of all that
    is seen, the nearest of 3 × 3 pixels, since a pixel at an edge is between object and background. margin (H, W) [m]:
    see ``MARGIN_SIGMAS``. back (H, W) [m]: guessed depth of the hidden side, 0 where there is no guess; None if other
    views bound it.
    """

    silhouette: Silhouette
    depth: np.ndarray
    nearest: np.ndarray
    margin: np.ndarray
    back: np.ndarray | None = None

    def in_front(self, points: np.ndarray) -> np.ndarray:
        """How far (N,) [m] world points (N, 3) [m] are in front of the surface; −inf if that is unknown.

        Less than ``MARGIN_SIGMAS`` standard deviations in front counts as on the surface.
        """
        row, column, along, shown = self._pixels(points)
        surface = self.nearest[row, column]
        return np.where(shown & (surface > 0), surface - self.margin[row, column] - along, -np.inf)

    def outside(self, points: np.ndarray) -> np.ndarray:
        """As ``in_front`` without its margin, for the most likely place of the surface."""
        row, column, along, shown = self._pixels(points)
        surface = self.depth[row, column]
        return np.where(shown & (surface > 0), surface - along, -np.inf)

    def behind(self, points: np.ndarray) -> np.ndarray:
        """How far (N,) [m] world points (N, 3) [m] are behind the guessed hidden side; −inf if there is no guess."""
        if self.back is None:
            return np.full(len(points), -np.inf)
        row, column, along, shown = self._pixels(points)
        back = self.back[row, column]
        return np.where(shown & (back > 0), along - back, -np.inf)

    def _pixels(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        pixels, along = self.silhouette.project(points)
        height, width = self.depth.shape
        pixels = np.where((along > 1e-6)[:, None], pixels, -1.0)
        shown = (pixels >= 0).all(axis=1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
        column = np.clip(pixels[:, 0], 0, width - 1).astype(np.int32)
        row = np.clip(pixels[:, 1], 0, height - 1).astype(np.int32)
        return row, column, along, shown


def depth_views(scene: Scene, frame: int, views: tuple[Silhouette, ...]) -> tuple[DepthView, ...]:
    """The measured depth of ``frame`` in ``views``, those of the frame; empty if the recording has no depth.

    If one view alone shows the object, its depth gets a guess of the hidden side, ``local_thickness``.
    """
    if scene.depth_noise is None:
        return ()
    alone = sum(bool((view.distance < 0).any()) for view in views) == 1
    found = []
    for view in views:
        depth = scene.frame(view.view, frame).depth
        if depth is None or not (depth > 0).any():
            continue
        on_object = (view.distance < 0) & view.valid
        smooth = _smoothed(depth, on_object)
        back = None
        if alone and (smooth[on_object] > 0).any():
            smooth = _without_holes(smooth, on_object)
            back = _guessed_back(view, on_object, smooth)
        nearest = ndimage.minimum_filter(np.where(smooth > 0, smooth, np.inf), size=3, mode="nearest")
        nearest = np.where(np.isfinite(nearest) & (smooth > 0), nearest, 0.0)
        margin = MARGIN_SIGMAS * scene.depth_noise.std(smooth)
        surface = np.where(on_object, smooth, 0.0)
        found.append(DepthView(view, surface, nearest, margin, back))
    return tuple(found)


def seen_points(depths: tuple[DepthView, ...]) -> np.ndarray:
    """World points (N, 3) [m] of the object's surface that the depth of a frame shows, and of its guessed back."""
    fronts = [back_projected(view.silhouette.camera, view.depth) for view in depths]
    backs = [back_projected(view.silhouette.camera, view.back) for view in depths if view.back is not None]
    return np.concatenate([*fronts, *backs])


def local_thickness(mask: np.ndarray) -> np.ndarray:
    """Thickness (H, W) [pixels] of the body whose silhouette is ``mask`` (H, W) bool if it is as deep as it is wide.

    r is the radius of the largest disc inside the mask that contains a pixel (local thickness, Hildebrand and
    Rüegsegger 1997), d its distance to the edge: 2 sqrt(r² − (r − d)²). Exact for a ball and for a bar with a round
    section.
    """
    padded = cv2.copyMakeBorder(mask.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    edge = distance_to_zero(padded)
    radius = np.zeros_like(edge)
    for level in np.linspace(edge.max(), 0.5, _LEVELS):
        centres = (edge >= level).astype(np.uint8)
        near = distance_to_zero(1 - centres) <= level
        radius = np.where((radius == 0) & near & (padded > 0), level, radius)
    radius = np.maximum(radius, edge)
    return 2 * np.sqrt(np.maximum(radius**2 - (radius - edge) ** 2, 0.0))[1:-1, 1:-1]


def _smoothed(depth: np.ndarray, on_object: np.ndarray) -> np.ndarray:
    """The median of the 3 × 3 pixels on the object of each pixel of it with a known depth; the rest is unchanged."""
    padded = np.pad(np.where(on_object & (depth > 0), depth, np.nan), 1, constant_values=np.nan)
    around = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    rows, columns = np.nonzero(on_object & (depth > 0))
    smooth = depth.copy()
    smooth[rows, columns] = np.nanmedian(around[rows, columns].reshape(-1, 9), axis=1)
    return smooth


def _without_holes(depth: np.ndarray, on_object: np.ndarray) -> np.ndarray:
    """``depth`` with that of the nearest known pixel of the object where the object's is unknown."""
    known = on_object & (depth > 0)
    nearest = np.empty((2, *depth.shape), np.int32)
    ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True, indices=nearest)
    return np.where(on_object & ~known, depth[tuple(nearest)], depth)


def _guessed_back(view: Silhouette, on_object: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Depth (H, W) [m] of the hidden side: the seen surface plus the thickness of a body as deep as it is wide.

    A thickness of t pixels is measured half-way between front and back: T = t (z + T / 2) / f.
    """
    pixels = local_thickness(on_object)
    thickness = pixels * depth / np.maximum(view.camera.intrinsics[0, 0] - 0.5 * pixels, 1.0)
    return np.where(on_object & (depth > 0), depth + thickness, 0.0)
