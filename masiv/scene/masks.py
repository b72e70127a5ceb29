"""Where the object is in a picture: from a cut-out, from the empty background, or from a plain background.

Pictures are (H, W, 3) uint8 RGB; masks are (H, W) float32 in [0, 1], 1 on the object.
"""

from __future__ import annotations

import cv2
import numpy as np


def from_white(cutout: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Mask of an object painted on pure white.

    A pure white pixel of the object cannot be told from the paint where ``image`` is white too; such pixels become the
    object's when they form a hole that is small (below 1 % of the object) and closed.
    """
    mask = ~(cutout == 255).all(axis=-1)
    doubtful = ~mask & (image == 255).all(axis=-1)
    count, labels, stats, _ = cv2.connectedComponentsWithStats((~mask).astype(np.uint8), connectivity=4)
    area = max(int(mask.sum()), 1)
    for label in range(1, count):
        x, y, width, height, size = stats[label]
        touches_border = x == 0 or y == 0 or x + width == mask.shape[1] or y + height == mask.shape[0]
        hole = labels == label
        if not touches_border and size <= 0.01 * area and doubtful[hole].all():
            mask |= hole
    return mask.astype(np.float32)


def from_background(image: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Mask by difference from the empty background, refined along colour edges.

    A soft shadow darkens all channels alike: pixels that are a dimmed copy of the background, with little change of
    texture, count as background. GrabCut (Rother et al. 2004) then settles the uncertain rim.
    """
    light, empty = _blurred(image), _blurred(background)
    gain = (light * empty).sum(-1) / np.maximum((empty * empty).sum(-1), 1.0)
    dimmed = np.abs(light - gain[..., None] * empty).max(axis=-1)
    difference = np.abs(light - empty).max(axis=-1)
    noise = 1.4826 * np.median(difference) + 1.0
    shadow = (gain > 0.35) & (gain < 1.05) & (dimmed < max(3.0 * noise, 8.0))
    return _refined(image, difference, noise, shadow)


def from_plain_background(image: np.ndarray) -> np.ndarray:
    """Mask by difference from the median colour of the picture's border; for an object before a plain background."""
    border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    colour = np.median(border, axis=0)
    difference = np.abs(image.astype(np.float32) - colour).max(axis=-1)
    noise = 1.4826 * np.median(np.abs(border - colour).max(axis=-1)) + 1.0
    return _cleaned(difference > max(4.0 * noise, 16.0)).astype(np.float32)


def _blurred(image: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), 0.8).astype(np.float32)


def _refined(image: np.ndarray, difference: np.ndarray, noise: float, shadow: np.ndarray) -> np.ndarray:
    seed = _cleaned((difference > max(6.0 * noise, 20.0)) & ~shadow)
    if seed.sum() < 16:
        return seed.astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    around = cv2.dilate(seed.astype(np.uint8), kernel, iterations=3).astype(bool)
    sure = cv2.erode(seed.astype(np.uint8), kernel, iterations=2).astype(bool)
    changed = difference > 3.0 * noise
    trimap = np.full(seed.shape, cv2.GC_BGD, np.uint8)
    trimap[around & changed] = cv2.GC_PR_BGD
    trimap[seed] = cv2.GC_PR_FGD
    trimap[sure] = cv2.GC_FGD
    cv2.setRNGSeed(0)  # GrabCut's colour clusters start from OpenCV's random numbers
    bgr = np.ascontiguousarray(image[..., ::-1])
    try:
        cv2.grabCut(bgr, trimap, (0, 0, 0, 0), np.zeros((1, 65)), np.zeros((1, 65)), 2, cv2.GC_INIT_WITH_MASK)
    except cv2.error:
        return seed.astype(np.float32)  # one class is empty: nothing to refine
    return _cleaned((trimap == cv2.GC_FGD) | (trimap == cv2.GC_PR_FGD)).astype(np.float32)


def _cleaned(mask: np.ndarray) -> np.ndarray:
    """Without specks, with small holes closed, and only components of at least 2 % of the largest."""
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, kernel)
    opened = cv2.morphologyEx(closed, cv2.MORPH_OPEN, kernel)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(opened, connectivity=8)
    if count < 2:
        return np.zeros(mask.shape, bool)
    areas = stats[1:, cv2.CC_STAT_AREA]
    return np.isin(labels, 1 + np.flatnonzero(areas >= 0.02 * areas.max()))
