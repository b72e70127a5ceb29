"""Masks of the object from a cut-out or from a plain background. Those from the empty scene: ``background``.

Pictures are (H, W, 3) uint8 RGB; masks are (H, W) float32 in [0, 1], 1 on the object.
"""

from __future__ import annotations

import cv2
import numpy as np


def from_white(cutout: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Mask of a ``cutout``: a copy of ``image`` that is pure white outside of the object.

    A pixel that is white in ``image`` too can be part of the object. Such pixels are, if they form a closed hole
    smaller than 1 % of the object.
    """
    mask = ~_is_white(cutout)
    count, labels, stats, _ = cv2.connectedComponentsWithStats((~mask).astype(np.uint8), connectivity=4)
    area = max(int(mask.sum()), 1)
    for label in range(1, count):
        x, y, width, height, size = stats[label]
        touches_border = x == 0 or y == 0 or x + width == mask.shape[1] or y + height == mask.shape[0]
        if not touches_border and size <= 0.01 * area and _is_white(image)[labels == label].all():
            mask |= labels == label
    return mask.astype(np.float32)


def _is_white(image: np.ndarray) -> np.ndarray:
    """Which pixels (H, W) are pure white."""
    white = (255, 255, 255)
    return cv2.inRange(np.ascontiguousarray(image), white, white) > 0


def from_plain_background(image: np.ndarray) -> np.ndarray:
    """Mask from the difference to the median colour of the picture's border, for a plain background."""
    border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    colour = np.median(border, axis=0)
    difference = np.abs(image.astype(np.float32) - colour).max(axis=-1)
    noise = 1.4826 * np.median(np.abs(border - colour).max(axis=-1)) + 1.0
    return _clean(difference > max(4.0 * noise, 16.0)).astype(np.float32)


def _clean(mask: np.ndarray) -> np.ndarray:
    """Remove specks, close small holes, and keep only components of at least 2 % of the largest."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, kernel)
    opened = cv2.morphologyEx(closed, cv2.MORPH_OPEN, kernel)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(opened, connectivity=8)
    if count < 2:
        return np.zeros(mask.shape, bool)
    areas = stats[1:, cv2.CC_STAT_AREA]
    return np.isin(labels, 1 + np.flatnonzero(areas >= 0.02 * areas.max()))
