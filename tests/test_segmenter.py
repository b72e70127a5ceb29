"""Masks by SAM 2, with a tiny network of random weights: files, prompts, memory and messages, not quality."""

from __future__ import annotations

import importlib.util
import json
import pickle
import shutil

import numpy as np
import pytest
import tiny_scenes as tiny

from masiv.errors import InputError
from masiv.observations.read import read_scene
from masiv.scene.segmenter import Prompt, VideoSegmenter

installed = importlib.util.find_spec("transformers") is not None
needs_library = pytest.mark.skipif(not installed, reason="needs pip install 'masiv[segment]'")
BOX = [30, 20, 70, 60]


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    from tiny_segmenter import write_weights

    return write_weights(tmp_path_factory.mktemp("weights") / "tiny")


def scene_with(folder, weights, *, masks=None, boxes=None):
    """The scene of dots with these keys in scene.yaml, read."""
    if not (folder / "transforms.json").is_file():
        tiny.nerfstudio(folder, masks=masks)
    key = {"segmenter": "sam2", "weights": str(weights), **({"boxes": boxes} if boxes else {})}
    (folder / "scene.yaml").write_text(json.dumps({"masks": key}))
    return read_scene(folder)


def boxes(box=BOX):
    return {f"cam{view}": box for view in range(tiny.VIEWS)}


def all_masks(scene):
    return np.array([[scene.frame(v, k).mask for k in range(scene.frame_count)] for v in scene.views])


def test_prompt_of_a_mask_is_its_box_and_points_deep_inside():
    mask = np.zeros((20, 30), np.float32)
    mask[4:13, 6:21] = 1
    prompt = Prompt.of_mask(mask)
    assert prompt is not None
    assert prompt.box == (6, 4, 21, 13)
    columns, rows = np.floor(prompt.points).astype(int).T
    assert (mask[rows - 1, columns - 1] == 1).all()
    assert (mask[rows + 1, columns + 1] == 1).all()
    assert rows[0] == 8  # the middle row
    distances = np.linalg.norm(prompt.points[:, None] - prompt.points, axis=2)[np.triu_indices(len(prompt.points), 1)]
    assert distances.min() > 2.5
    assert Prompt.of_mask(np.zeros((5, 5), np.float32)) is None


@needs_library
def test_masks_are_probabilities_and_count_as_estimated(tmp_path, weights):
    scene = scene_with(tmp_path, weights, boxes=boxes())
    masks = all_masks(scene)
    assert masks.shape == (tiny.VIEWS, tiny.FRAMES, tiny.HEIGHT, tiny.WIDTH)
    assert masks.dtype == np.float32
    assert masks.min() >= 0
    assert masks.max() <= 1
    assert masks[:, 0].std() > 0.05
    np.testing.assert_array_equal(masks, np.round(masks * 255).astype(np.float32) / 255)
    assert scene.masks_estimated
    assert scene.mask_source == "SAM 2 (tiny)"


@needs_library
def test_masks_repeat_in_any_order_and_in_another_process(tmp_path, weights):
    scene = scene_with(tmp_path, weights, boxes=boxes())
    backwards = scene_with(tmp_path, weights, boxes=boxes())
    last = backwards.frame(1, tiny.FRAMES - 1).mask
    sent = pickle.loads(pickle.dumps(backwards))
    expected = all_masks(scene)
    np.testing.assert_array_equal(last, expected[1, -1])
    np.testing.assert_array_equal(all_masks(backwards), expected)
    np.testing.assert_array_equal(all_masks(sent), expected)


@needs_library
def test_a_box_changes_the_masks_of_all_frames(tmp_path, weights):
    one = all_masks(scene_with(tmp_path, weights, boxes=boxes()))
    other = all_masks(scene_with(tmp_path, weights, boxes={**boxes(), "cam1": [2, 2, 30, 40]}))
    np.testing.assert_array_equal(one[[0, 2]], other[[0, 2]])
    assert (np.abs(one[1] - other[1]).mean(axis=(1, 2)) > 0.01).all()


@needs_library
def test_the_empty_scene_gives_box_and_points(tmp_path, weights):
    found = scene_with(tmp_path, weights, masks="background").frame(0, 0)
    centre = tiny.pixel(0, tiny.dot(0))
    rows, columns = np.nonzero(tiny.cover(centre) > 0.5)
    box = [int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1]
    segmenter = VideoSegmenter(weights)
    expected = segmenter.track(Prompt.of_mask((tiny.cover(centre) > 0.5).astype(np.float32))).mask(found.image)
    np.testing.assert_allclose(found.mask, expected / 255, atol=1e-6)
    without_points = scene_with(tmp_path, weights, boxes={"cam0": box}).frame(0, 0)
    assert np.abs(without_points.mask - found.mask).max() > 0.01


@needs_library
def test_pictures_after_the_one_that_is_asked_for_stay_unread(tmp_path, weights):
    scene = scene_with(tmp_path, weights, boxes=boxes())
    (tmp_path / f"images/cam0/frame_{tiny.FRAMES:05d}.png").write_bytes(b"held out")
    assert scene.frame(0, tiny.FRAMES - 2).mask.max() > 0
    with pytest.raises(InputError, match="cannot be read"):
        scene.frame(0, tiny.FRAMES - 1)


@needs_library
def test_what_a_track_forgets_changes_no_mask(weights):
    """A session of the library that keeps everything, over more pictures than its memory reaches back."""
    import torch
    from transformers import Sam2VideoInferenceSession

    images = np.random.default_rng(0).integers(0, 255, (22, 64, 64, 3), np.uint8)
    segmenter = VideoSegmenter(weights)
    track = segmenter.track(Prompt((10, 12, 40, 50), np.array([[20.0, 30.0]])))
    session = Sam2VideoInferenceSession(dtype=torch.float32)
    index = session.obj_id_to_idx(0)
    corners = torch.tensor([[[[9.5, 11.5], [39.5, 49.5], [19.5, 29.5]]]])
    labels = torch.tensor([[[2, 3, 1]]], dtype=torch.int32)
    session.add_point_inputs(index, 0, {"point_coords": corners, "point_labels": labels})
    session.obj_with_new_inputs = [0]
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    for image in images:
        pixels = ((torch.from_numpy(image).float() / 255 - mean) / std).permute(2, 0, 1)[None]
        with torch.inference_mode():
            logits = segmenter.model(session, frame=pixels).pred_masks
        full = torch.nn.functional.interpolate(logits, (64, 64), mode="bilinear")[0, 0]
        np.testing.assert_allclose(track.mask(image) / 255, torch.sigmoid(full).numpy(), atol=0.501 / 255)


def drop_a_weight(folder):
    from safetensors.torch import load_file, save_file

    weights = load_file(folder / "model.safetensors")
    weights.pop("mask_decoder.iou_token.weight")
    save_file(weights, folder / "model.safetensors", {"format": "pt"})


def cut_short(folder):
    (folder / "model.safetensors").write_bytes((folder / "model.safetensors").read_bytes()[:1000])


def of_another_type(folder):
    (folder / "config.json").write_text('{"model_type": "bert"}')


@needs_library
@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (shutil.rmtree, "no config.json: give the folder of a SAM 2 model"),
        (of_another_type, "model of type 'bert'"),
        (lambda folder: (folder / "config.json").write_text("{"), "cannot be read"),
        (drop_a_weight, "lacks 1 of the network's weights .mask_decoder.iou_token.weight"),
        (cut_short, "cannot be loaded"),
    ],
)
def test_weights_that_cannot_be_used(tmp_path, weights, damage, message):
    copy = tmp_path / "weights"
    shutil.copytree(weights, copy)
    damage(copy)
    with pytest.raises(InputError, match=message):
        scene_with(tmp_path, "weights", boxes=boxes()).frame(0, 0)


@needs_library
@pytest.mark.parametrize(
    ("masks", "given", "message"),
    [
        (None, {}, r"boxes lacks cam0, cam1, cam2, of which there is no picture without the object"),
        (None, {"cam0": BOX}, "boxes lacks cam1, cam2"),
        (None, {**boxes(), "cam7": BOX}, "names camera 'cam7', the cameras are cam0, cam1, cam2"),
        (None, boxes([70, 20, 30, 60]), "x0 < x1"),
        (None, boxes([30, 20, 970, 60]), "in the picture of 96×80 pixels"),
        ("mask_path", {}, "nothing to do, the masks are given .mask pictures"),
    ],
)
def test_prompts_that_cannot_be_used(tmp_path, weights, masks, given, message):
    with pytest.raises(InputError, match=message):
        scene_with(tmp_path, weights, masks=masks, boxes=given)


@pytest.mark.skipif(installed, reason="the library is installed")
def test_without_the_library_the_message_names_the_extra(tmp_path):
    with pytest.raises(InputError, match=r"pip install 'masiv\[segment\]'"):
        scene_with(tmp_path, tmp_path, boxes=boxes())


def test_an_unknown_segmenter_is_an_error(tmp_path):
    tiny.nerfstudio(tmp_path, masks=None)
    (tmp_path / "scene.yaml").write_text("masks: {segmenter: sam1, weights: w}")
    with pytest.raises(InputError, match=r"masks\.segmenter"):
        read_scene(tmp_path)
