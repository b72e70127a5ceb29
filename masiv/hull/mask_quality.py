"""How well the masks of a recording agree: each is compared with the hull that all of them carve."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from masiv.errors import MasivError
from masiv.hull.carve import VisualHull, visual_hull
from masiv.hull.silhouette import Silhouette, silhouettes
from masiv.metrics import mask_iou
from masiv.scene.scene import Scene
from masiv.subsample import evenly_spread

_FRAMES, _RESOLUTION = 6, 64
_OUTLIER, _LEAST_LOSS = 4.0, 0.05
"""A view disagrees if it is this many robust standard deviations below the median of the views, and by this much: with
exact masks all views lose about the same, the width of a voxel along the outline."""


@dataclass(frozen=True)
class MaskQuality:
    """By view: ``agreement`` (V,) in [0, 1], intersection over union of masks and the silhouettes of the hulls, mean of
    some frames, NaN if unknown. ``doubt`` (V,): expected share of the mask's area that is wrong by its own account."""

    views: tuple[int, ...]
    agreement: np.ndarray
    doubt: np.ndarray

    def problems(self) -> list[str]:
        """A sentence for each view whose masks disagree with the others'."""
        known = self.agreement[np.isfinite(self.agreement)]
        if len(known) < 3:
            return []
        middle = float(np.median(known))
        limit = middle - max(_LEAST_LOSS, _OUTLIER * 1.4826 * float(np.median(np.abs(known - middle))))
        return [
            f"view {view}: its masks agree with the hull of all views to {value:.0%} only (intersection over union), "
            f"others to {middle:.0%}: look at them in the picture"
            for view, value in zip(self.views, self.agreement, strict=True)
            if value < limit
        ]


def mask_quality(scene: Scene) -> MaskQuality:
    """The quality of the masks of ``scene``; views and frames that are held out or without a picture do not count."""
    if not scene.views:  # a recording of point clouds
        return MaskQuality((), np.empty(0), np.empty(0))
    chosen = evenly_spread(scene.observed_frames, _FRAMES)
    scores: dict[int, list[float]] = {view: [] for view in scene.views}
    doubts: dict[int, list[float]] = {view: [] for view in scene.views}
    for frame in chosen:
        for view in scene.views:
            picture = scene.frame(view, frame)
            area = float((picture.mask > 0.5).sum())
            if area > 0:
                doubts[view].append(float(np.minimum(picture.mask, 1 - picture.mask).sum()) / area)
        try:
            hull = visual_hull(scene, frame, resolution=_RESOLUTION)
        except MasivError:  # inspect tells of empty masks; without a hull nothing can be compared
            continue
        for view in silhouettes(scene, frame):
            if view.valid.any():
                drawn = hull_silhouette(hull, view)
                scores[view.view].append(mask_iou(drawn * view.valid, (view.distance < 0) * view.valid))
    mean = [[np.mean(of[view]) if of[view] else np.nan for view in scene.views] for of in (scores, doubts)]
    return MaskQuality(scene.views, np.array(mean[0]), np.array(mean[1]))


def hull_silhouette(hull: VisualHull, view: Silhouette) -> np.ndarray:
    """The silhouette (H, W) float32 of ``hull`` in ``view``, each voxel drawn as the ball inside of it. Those on its
    surface are drawn: they cover the others."""
    pixels, depth = view.project(hull.points[hull.surface])
    radii = 0.5 * hull.spacing * view.camera.intrinsics[0, 0] / np.maximum(depth, 1e-6)
    drawn = np.zeros(view.distance.shape, np.uint8)
    fixed = np.rint((pixels - 0.5) * 16).astype(int)
    for (x, y), radius in zip(fixed[depth > 0].tolist(), np.rint(16 * radii[depth > 0]).astype(int), strict=True):
        cv2.circle(drawn, (x, y), int(radius), 1, cv2.FILLED, shift=4)
    return drawn.astype(np.float32)
