"""Frames that were read are kept, up to a number of bytes."""

from __future__ import annotations

import dataclasses
import pickle
from pathlib import Path

import numpy as np
import pytest

from masiv.scene.camera import Camera
from masiv.scene.frame_cache import Frame, FrameCache
from masiv.scene.packed_mask import PackedMask
from masiv.scene.scene import Scene
from masiv.scene.summary import summarise

SIZE = 10
FRAME_BYTES = SIZE * SIZE * (3 + 4 + 1)


class Reader:
    """Makes frames and keeps which were asked for. ``level``: of all pixels."""

    def __init__(self, level=0):
        self.level = level
        self.read = []

    def __call__(self, view, frame):
        self.read.append((view, frame))
        shape = SIZE, SIZE
        return Frame(np.full((*shape, 3), self.level, np.uint8), np.zeros(shape, np.float32), np.ones(shape, bool))


def scene(load):
    up = np.array([0.0, 1.0, 0.0])
    cameras = tuple(Camera(str(k), SIZE, SIZE, np.eye(3), np.eye(4)) for k in range(3))
    return Scene(Path("scene"), "test", 24.0, 4, cameras, -9.8 * up, up, None, 1000.0, load, "test")


def test_the_memory_of_a_cache_is_bounded_and_the_oldest_frame_goes_first():
    reader = Reader()
    cache = FrameCache(reader, max_bytes=2 * FRAME_BYTES)
    for frame in (0, 1, 0, 2, 0, 1):
        cache(0, frame)
    # 1 is dropped when 2 comes, since 0 was used after it; 2 is dropped when 1 comes back.
    assert reader.read == [(0, 0), (0, 1), (0, 2), (0, 1)]


def test_a_frame_larger_than_the_cache_is_returned():
    reader = Reader()
    cache = FrameCache(reader, max_bytes=1)
    assert cache(0, 0) is cache(0, 0)
    cache(0, 1)
    cache(0, 0)
    assert reader.read == [(0, 0), (0, 1), (0, 0)]


def test_a_part_of_a_scene_shares_what_was_read():
    reader = Reader()
    whole = scene(reader)
    whole.frame(1, 0)
    whole.restricted(3, (0,)).frame(1, 0)
    assert reader.read == [(1, 0)]


def test_a_scene_with_another_reader_has_its_own_frames():
    first, second = scene(Reader(1)), None
    first.frame(0, 0)
    second = dataclasses.replace(first, load=Reader(2))
    assert second.frame(0, 0).image[0, 0, 0] == 2
    assert first.frame(0, 0).image[0, 0, 0] == 1


def test_a_scene_is_pickled_without_its_frames():
    read = scene(Reader(1))
    empty = len(pickle.dumps(read))
    for frame in range(4):
        read.frame(0, frame)
    sent = pickle.loads(pickle.dumps(read))
    assert len(pickle.dumps(read)) < empty + 100  # the reader has noted four keys
    assert sent.frame(0, 3).image[0, 0, 0] == 1
    assert sent.load.load.read == [*((0, k) for k in range(4)), (0, 3)]


def test_inspect_makes_the_masks_of_a_frame_agree_once_however_long_the_recording():
    made, reader = [], Reader()

    def agree(of, frame):
        made.append(frame)
        return {view: of.frame(view, frame) for view in of.views}

    long = dataclasses.replace(scene(FrameCache(reader, 3 * FRAME_BYTES)), frame_count=9, correct_masks=agree)
    long._corrected.max_bytes = 3 * FRAME_BYTES
    looked = []
    summarise(long, lambda view, frame, picture: looked.append((frame, view)))
    assert looked == [(frame, view) for frame in range(9) for view in range(3)]
    assert made == list(range(9))
    assert len(reader.read) == 27


def test_released_pictures_are_read_again():
    reader = Reader()
    whole = scene(reader)
    part = whole.restricted(2)
    part.frame(1, 0)
    whole.release_pictures()
    part.frame(1, 0)
    assert reader.read == [(1, 0), (1, 0)]


def noisy(view, frame):
    """A frame with a soft mask; every second one is partly hidden."""
    rng = np.random.default_rng((view, frame))
    mask = np.zeros((SIZE, SIZE), np.float32)
    mask[2:6, 3:9] = rng.random((4, 6), np.float32)
    valid = rng.random((SIZE, SIZE)) > 0.3 if frame % 2 else np.ones((SIZE, SIZE), bool)
    return Frame(np.zeros((SIZE, SIZE, 3), np.uint8), mask, valid)


def test_masks_of_frames_that_were_dropped_are_not_read_again():
    read = []

    def load(view, frame):
        read.append((view, frame))
        return noisy(view, frame)

    whole = scene(FrameCache(load, max_bytes=2 * FRAME_BYTES * 3))
    for _ in range(3):
        for frame in range(4):
            for view, mask, valid in whole.map_masks(frame, lambda *given: given):
                assert np.array_equal(mask, noisy(view, frame).mask)
                assert np.array_equal(valid, noisy(view, frame).valid)
                assert (mask.dtype, valid.dtype) == (np.float32, bool)
    assert len(read) < 24
    assert len(whole.map_masks(3, lambda *given: given)) == 3


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_a_mask_that_is_packed_is_the_same_again(level):
    mask, valid = np.full((7, 5), level, np.float32), np.zeros((7, 5), bool)
    packed = PackedMask.of(mask, valid)
    assert np.array_equal(packed.unpacked()[0], mask)
    assert np.array_equal(packed.unpacked()[1], valid)


def test_packed_masks_are_bounded():
    cache = FrameCache(noisy, max_bytes=FRAME_BYTES)
    for frame in range(100):
        cache.mask(0, frame)
    assert sum(packed.nbytes for packed in cache._packed.values()) < FRAME_BYTES
