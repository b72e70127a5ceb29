"""The distance transform of masks: exact, and equal bit by bit for equal masks wherever they lie in memory."""

import cv2
import numpy as np
import pytest
from scipy import ndimage

from masiv.hull.distance import distance_to_zero


def _blobs(height, width, seed):
    noise = np.random.default_rng(seed).normal(size=(height, width))
    return (cv2.GaussianBlur(noise, (0, 0), 6) > 0.05).astype(np.uint8)


@pytest.mark.parametrize(("height", "width"), [(146, 78), (61, 64), (176, 141)])
def test_distance_is_exact_and_bit_equal_at_any_alignment(height, width):
    mask = _blobs(height, width, seed=height)
    rng = np.random.default_rng(0)
    held, results = [], set()
    for _ in range(60):
        # Allocations of random sizes change the alignment of OpenCV's buffers.
        held.append(np.empty(rng.integers(1, 5000)))
        results.add(distance_to_zero(mask).tobytes())
    assert len(results) == 1
    np.testing.assert_array_equal(distance_to_zero(mask), ndimage.distance_transform_edt(mask).astype(np.float32))


def test_a_mask_without_zero_is_far_everywhere():
    assert distance_to_zero(np.ones((5, 7), np.uint8)).min() > np.hypot(5, 7)
