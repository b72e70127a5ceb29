"""Euclidean distance transform of a mask."""

from __future__ import annotations

import cv2
import numpy as np


def distance_to_zero(mask: np.ndarray) -> np.ndarray:
    """mask (H, W) uint8 -> (H, W) float32 [pixels]: from each pixel's centre to that of the nearest 0.

    Equal masks have bit-equal distances below 2,000 pixels.
    """
    distance = cv2.distanceTransform(mask, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # OpenCV rounds the root in a way that depends on the alignment of its buffers. Squared distances are integers.
    squared = np.square(distance, dtype=np.float64)
    np.rint(squared, out=squared)
    return np.sqrt(squared, out=squared).astype(np.float32)
