"""Masks from depth: the object is what stands before the empty scene."""

from __future__ import annotations

import cv2
import numpy as np

from masiv.scene.depth import DepthNoise

SIGMAS = 4.0
"""Standard deviations of the difference of two depths. One pixel in 30,000 exceeds that by chance, and specks are
removed."""
SMALLEST_PIECE = 0.02
"""Connected pieces with a smaller part of the largest one's area are noise."""


def from_empty_depth(depth: np.ndarray, empty: np.ndarray, noise: DepthNoise) -> np.ndarray:
    """Mask (H, W) float32: where ``depth`` is nearer than that of the ``empty`` scene, (H, W) [m] both, 0 if unknown.

    A shadow or a reflected colour has no depth, so it cannot be mistaken for the object. A pixel whose depth is unknown
    belongs to the object only if the object encloses it.
    """
    known = (depth > 0) & (empty > 0)
    margin = SIGMAS * np.hypot(noise.std(depth), noise.std(empty))
    nearer = (known & (depth < empty - margin)).astype(np.uint8)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
    nearer = cv2.morphologyEx(cv2.morphologyEx(nearer, cv2.MORPH_CLOSE, kernel), cv2.MORPH_OPEN, kernel)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(nearer, connectivity=8)
    if count < 2:
        return np.zeros(depth.shape, np.float32)
    areas = stats[1:, cv2.CC_STAT_AREA]
    mask = np.isin(labels, 1 + np.flatnonzero(areas >= SMALLEST_PIECE * areas.max()))
    return (mask | _enclosed(mask, known)).astype(np.float32)


def _enclosed(mask: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Pixels (H, W) bool without a depth, in holes of ``mask`` that contain no pixel with one."""
    _, labels = cv2.connectedComponents((~mask).astype(np.uint8), connectivity=4)
    border = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    seen_through = np.unique(labels[known & ~mask])
    return ~mask & ~np.isin(labels, np.union1d(border, seen_through)) & (labels > 0)
