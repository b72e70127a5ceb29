"""Arrays in a file: the same to the last bit, and not in memory."""

from __future__ import annotations

import dataclasses
import tracemalloc

import numpy as np
import pytest
import torch
from ring_scene import ring, spheres_scene

from masiv.array_file import ArrayFile
from masiv.continuum.losses import load_views
from masiv.scene.frame_cache import FrameCache
from masiv.splat.config import ReconstructConfig
from masiv.splat.observed_image import ObservedDepth, ObservedImage, StoredImages, observed_image, observed_images

FRAMES = 30


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.uint8, bool])
def test_what_was_written_is_read(dtype):
    rng = np.random.default_rng(0)
    arrays = [(5 * rng.normal(size=shape)).astype(dtype) for shape in ((3, 4, 2), (0, 5), (7,), ())]
    arrays.append(np.asfortranarray(arrays[0]))
    file = ArrayFile()
    stored = [file.append(array) for array in arrays]
    for array, where in reversed(list(zip(arrays, stored, strict=True))):
        found = file.read(where)
        assert found.dtype == array.dtype
        np.testing.assert_array_equal(found, array)
    found = file.read(stored[0])
    found[:] = 0  # a copy
    np.testing.assert_array_equal(file.read(stored[0]), arrays[0])


def scene():
    """The cache of pictures is tiny, so that only what the stages hold is seen."""
    made = spheres_scene(
        lambda frame: [(np.array([0.005 * frame, 0.5, 0.0]), 0.3)], frame_count=FRAMES, cameras=ring(4, 160, 250.0)
    )
    return dataclasses.replace(made, load=FrameCache(made.load.load, 1))  # type: ignore[attr-defined]


def held(make):
    """What ``make`` returns, and the memory [bytes] that numpy holds for it."""
    tracemalloc.start()
    try:
        made = make()
        return made, tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()


def test_images_of_all_frames_are_not_in_memory_and_have_the_same_bits():
    given, config = scene(), ReconstructConfig(crop_side=64)
    found, memory = held(lambda: observed_images(given, config, range(FRAMES)))
    pixels = sum(image.mask.numel() for of_frame in found for image in of_frame)
    assert pixels > 4 * FRAMES * 40**2
    assert memory < 0.2 * 20 * pixels  # 20 bytes a pixel if they were in memory
    for frame, index in ((7, 2), (FRAMES - 1, 3)):
        image, expected = found[frame][index], observed_image(given, index, frame, crop_side=64, crop_padding=8)
        assert expected is not None
        assert image.view == expected.view
        np.testing.assert_array_equal(image.camera.intrinsics, expected.camera.intrinsics)
        for name in ("colour", "mask", "valid"):
            np.testing.assert_array_equal(getattr(image, name), getattr(expected, name))


def test_a_depth_is_stored_with_its_image():
    one, two = torch.rand(3, 2), torch.rand(3, 2)
    depth = ObservedDepth(one, two, one + two)
    plain = ObservedImage(1, ring(1)[0], torch.rand(3, 2, 3), two, one)
    stored = StoredImages(ArrayFile(), [plain, dataclasses.replace(plain, depth=depth)])
    assert stored[0].depth is None
    found = stored[1].depth
    assert found is not None
    for name in ("values", "noise", "known"):
        assert torch.equal(getattr(found, name), getattr(depth, name))


def test_masks_of_all_frames_are_not_in_memory_and_have_the_same_bits():
    given = scene()
    found, memory = held(lambda: load_views(given))
    assert memory < 0.1 * 4 * 160**2 * 4 * FRAMES
    later = load_views(given, FRAMES - 2)
    assert len(later) == 2
    for one, other in zip(found[FRAMES - 1], later[1], strict=True):
        assert (one.distance < -1).any()
        np.testing.assert_array_equal(one.distance, other.distance)
        np.testing.assert_array_equal(one.pose, other.pose)
