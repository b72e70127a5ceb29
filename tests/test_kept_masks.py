"""Estimated masks that are kept in a folder: the same masks, estimated once, and again if anything is another."""

from __future__ import annotations

import os
import warnings
from dataclasses import replace

import numpy as np
import pytest
import tiny_scenes as tiny
from ring_scene import ring
from small import only_first_quick

from masiv.observations.kept_masks import with_kept_masks
from masiv.observations.read import read_scene
from masiv.pipeline.run import open_run
from masiv.pipeline.video import VideoRun
from masiv.scene.scene import Frame


@pytest.fixture
def folder(tmp_path):
    return tiny.nerfstudio(tmp_path / "scene", masks="background")


@pytest.fixture
def kept(tmp_path):
    return tmp_path / "masks"


def all_frames(scene):
    return {(view, k): scene.frame(view, k) for view in scene.views for k in range(scene.frame_count)}


def assert_same(one: dict[tuple[int, int], Frame], other: dict[tuple[int, int], Frame]) -> None:
    assert one.keys() == other.keys()
    for key, frame in one.items():
        for name in ("image", "mask", "valid"):
            expected, found = getattr(frame, name), getattr(other[key], name)
            assert expected.dtype == found.dtype
            np.testing.assert_array_equal(expected, found)


def mark(kept):
    """Set the first pixel of every mask that is kept to 0.25, which no estimate gives."""
    for path in kept.glob("*.npz"):
        with np.load(path) as file:
            arrays = {name: file[name].copy() for name in file}
        for name, array in arrays.items():
            if name != "key":
                array[0, 0] = 0.25
        np.savez(path, **arrays)


def is_marked(scene):
    return {float(picture.mask[0, 0]) for picture in all_frames(scene).values()} == {0.25}


def test_masks_are_the_same_and_estimated_once(folder, kept):
    expected = all_frames(read_scene(folder))
    assert max(f.mask.max() for f in expected.values()) > 0.9
    assert_same(all_frames(with_kept_masks(read_scene(folder), kept)), expected)
    assert_same(all_frames(with_kept_masks(read_scene(folder), kept)), expected)
    mark(kept)
    assert is_marked(with_kept_masks(read_scene(folder), kept))


def test_masks_that_agree_depend_on_cameras_and_views(folder, kept):
    """Masks that were made consistent with one view less are others."""

    def agree(scene, frame):
        pictures = {view: scene.frame(view, frame) for view in scene.views}
        share = np.float32(1 / len(pictures))
        return {v: Frame(p.image, p.mask * share, p.valid) for v, p in pictures.items()}

    def read():
        return replace(with_kept_masks(replace(read_scene(folder), correct_masks=agree), kept), frame_count=2)

    for _ in range(2):
        every, fewer = read(), read().restricted(holdout_cameras=(2,))
        moved = replace(read(), cameras=(*ring(2, tiny.WIDTH), read().cameras[2]))
        raw = read_scene(folder).load
        for scene, count in ((every, 3), (fewer, 2), (moved, 3)):
            np.testing.assert_array_equal(scene.frame(1, 1).mask, raw(1, 1).mask * np.float32(1 / count))
    assert len(list(kept.glob("agreed_*_0001.npz"))) == 3


def test_frames_that_are_not_asked_for_are_not_kept(folder, kept):
    scene = with_kept_masks(read_scene(folder), kept).restricted(fit_frames=2)
    all_frames(scene)
    assert {path.stem[-4:] for path in kept.glob("*.npz")} == {"0000", "0001"}


def change_a_picture(folder):
    path = folder / "images/cam1/frame_00002.png"
    os.utime(path, ns=(0, path.stat().st_mtime_ns + 10**9))


def change_the_empty_scene(folder):
    tiny.draw(folder / "images/cam1/frame_00000.png", None, rgba=False, background=91.0)


def change_scene_yaml(folder):
    (folder / "scene.yaml").write_text("crop_box: [[-1, -1, -1], [1, 1, 1]]")


def change_the_lens(folder):
    tiny.edit_json(folder / "transforms.json", lambda listing: listing.update(k1=0.01, camera_model="OPENCV"))


CHANGES = [change_scene_yaml, change_a_picture, change_the_empty_scene, change_the_lens]


@pytest.mark.parametrize("change", only_first_quick(CHANGES))
def test_another_picture_or_setting_has_masks_of_its_own(folder, kept, change):
    all_frames(with_kept_masks(read_scene(folder), kept))
    mark(kept)
    change(folder)
    with pytest.warns(UserWarning, match="is of other pictures, settings or code: they are estimated again"):
        found = all_frames(with_kept_masks(read_scene(folder), kept))
    assert_same(found, all_frames(read_scene(folder)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert_same(all_frames(with_kept_masks(read_scene(folder), kept)), found)


@pytest.mark.parametrize("damage", [lambda data: data[: len(data) // 2], lambda data: b"", lambda data: data[:-200]])
def test_a_damaged_file_is_made_again(folder, kept, damage):
    expected = all_frames(with_kept_masks(read_scene(folder), kept))
    for path in kept.glob("*_0001.npz"):
        path.write_bytes(damage(path.read_bytes()))
    with pytest.warns(UserWarning, match="is damaged: they are estimated again"):
        assert_same(all_frames(with_kept_masks(read_scene(folder), kept)), expected)
    mark(kept)
    assert is_marked(with_kept_masks(read_scene(folder), kept))


def test_a_run_keeps_its_masks_once_a_stage_asks_for_them(folder, tmp_path):
    run = open_run(folder, tmp_path / "run")
    assert isinstance(run, VideoRun)
    assert not (run.path / "masks").exists()
    expected = all_frames(run.scene)
    assert_same(expected, all_frames(read_scene(folder)))
    mark(run.path / "masks")
    again = open_run(folder, tmp_path / "run")
    assert isinstance(again, VideoRun)
    assert is_marked(again.scene)


def test_given_masks_are_not_kept(tmp_path, kept):
    scene = read_scene(tiny.nerfstudio(tmp_path / "scene", masks="alpha"))
    assert with_kept_masks(scene, kept) is scene
    assert not kept.exists()
