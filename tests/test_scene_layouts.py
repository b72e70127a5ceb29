"""Each layout is written from its description; a dot in space must be found where its projection by hand says."""

from __future__ import annotations

import json
import shutil
import struct

import numpy as np
import pytest
import tiny_scenes as tiny

from masiv.errors import InputError
from masiv.observations.read import LAYOUTS, read_scene
from masiv.scene.summary import as_text, summarise

WRITERS = {
    "springgaus_synthetic": tiny.springgaus_synthetic,
    "springgaus_real": tiny.springgaus_real,
    "blender": tiny.blender,
    "nerfstudio": tiny.nerfstudio,
}
INTRINSICS = {"springgaus_real": tiny.CENTRED, "blender": tiny.ANGLE_K}
FPS = {"springgaus_synthetic": 1 / 0.03, "springgaus_real": 120, "blender": 25, "nerfstudio": 25}


@pytest.fixture(params=WRITERS)
def layout(request):
    return request.param


def assert_dot_is_where_the_camera_projects_it(scene, tolerance=0.05):
    for view in scene.views:
        for frame in range(scene.frame_count):
            picture = scene.frame(view, frame)
            expected, depth = scene.cameras[view].project(tiny.dot(frame)[None])
            assert depth[0] > 0
            np.testing.assert_allclose(tiny.centroid(picture.mask), expected[0], atol=tolerance)
            row, column = (expected[0, ::-1] - 0.5).round().astype(int)
            np.testing.assert_allclose(picture.image[row, column], tiny.COLOUR, atol=40)  # RGB; JPEG blurs


def test_cameras_times_and_masks(tmp_path, layout):
    scene = read_scene(WRITERS[layout](tmp_path))
    assert (scene.layout, scene.frame_count, len(scene.cameras)) == (layout, tiny.FRAMES, tiny.VIEWS)
    assert scene.fps == pytest.approx(FPS[layout])
    for view, camera in enumerate(scene.cameras):
        assert (camera.width, camera.height) == (tiny.WIDTH, tiny.HEIGHT)
        np.testing.assert_allclose(camera.centre, tiny.pose(view)[:3, 3], atol=1e-9)
        for point in tiny.CENTRE + np.array([[0.1, 0.2, -0.1], [-0.2, 0.05, 0.1]]):
            by_hand = tiny.pixel(view, point, INTRINSICS.get(layout, tiny.K))
            np.testing.assert_allclose(camera.project(point[None])[0][0], by_hand, atol=1e-6)
    assert_dot_is_where_the_camera_projects_it(scene)
    assert scene.density == 1000


@pytest.mark.parametrize(
    ("name", "up", "ground"),
    [
        ("springgaus_synthetic", [0, 1, 0], ([0, 1, 0], 0.3)),
        ("springgaus_real", [0, 0, -1], ([0, 0, -1], 0.025)),
        ("blender", [0, 0, 1], None),
        ("nerfstudio", [0, 0, 1], None),
    ],
)
def test_conventions_of_the_layout_and_scene_yaml(tmp_path, name, up, ground):
    scene = read_scene(WRITERS[name](tmp_path))
    np.testing.assert_allclose(scene.up, up)
    np.testing.assert_allclose(scene.gravity, -9.8 * np.array(up))
    if ground is None:
        assert scene.ground is None
        assert any("nothing of a ground" in problem for problem in scene.problems)
    else:
        assert scene.ground is not None
        np.testing.assert_allclose(scene.ground.normal, ground[0])
        assert scene.ground.height == ground[1]
        assert not any("ground" in problem for problem in scene.problems)
    (tmp_path / "scene.yaml").write_text("fps: 50\nup_axis: x\ngravity: 1.6\nground: {normal: [1, 0, 0], height: 0.1}")
    scene = read_scene(tmp_path)
    assert scene.fps == 50
    np.testing.assert_allclose(scene.gravity, [-1.6, 0, 0])
    assert scene.ground is not None
    assert scene.ground.height == 0.1
    assert not any("ground" in problem or "which way is up" in problem for problem in scene.problems)


def test_summary_is_json_and_text(tmp_path, layout):
    summary = summarise(read_scene(WRITERS[layout](tmp_path)))
    json.dumps(summary)
    assert f"{layout} layout" in as_text({**summary, "picture": "x.png"})
    assert not any("mask" in problem for problem in summary["problems"])


def test_low_ground_of_some_spring_gaus_objects(tmp_path):
    scene = read_scene(tiny.springgaus_synthetic(tmp_path / "rope"))
    assert scene.ground is not None
    assert scene.ground.height == 0.2


def test_spring_gaus_pictures_may_lack(tmp_path):
    tiny.springgaus_synthetic(tmp_path)
    (tmp_path / "cam_1/002.png").unlink()
    (tmp_path / "cam_1/003.png").unlink()
    (tmp_path / "frame.json").unlink()
    scene = read_scene(tmp_path)
    assert scene.frame_count == tiny.FRAMES
    assert scene.fps == pytest.approx(1 / 0.03)
    assert any("cam_1 has no picture at frame 2–3" in problem for problem in scene.problems)
    assert any("frame.json is missing" in problem for problem in scene.problems)
    assert not scene.frame(1, 3).valid.any()
    assert "2 of 4 frames" in as_text({**summarise(scene), "picture": ""})


def test_spring_gaus_sequences_are_scenes(tmp_path):
    tiny.springgaus_real(tmp_path)
    folder = tmp_path / "dynamic/sequences/dog"
    assert read_scene(folder).frame_count == tiny.FRAMES
    shutil.copy(folder / "0.json", folder / "1.json")
    tiny.edit_json(folder / "1.json", lambda d: d.update(C0787=[100, 101, 102]))  # by number, one frame fewer
    with pytest.raises(InputError, match=r"2 sequences: give one of them as SCENE, for example .*0\.json"):
        read_scene(tmp_path)
    scene = read_scene(folder / "1.json")
    assert any("C0787 has no picture at frame 3" in problem for problem in scene.problems)
    np.testing.assert_array_equal(scene.frame(1, 2).image, read_scene(folder / "0.json").frame(1, 2).image)


def test_distortion_is_taken_out(tmp_path):
    scene = read_scene(tiny.nerfstudio(tmp_path, distortion=tiny.DISTORTION))
    assert_dot_is_where_the_camera_projects_it(scene, tolerance=0.15)
    shift = scene.cameras[0].project(tiny.dot(0)[None])[0][0] - tiny.pixel(0, tiny.dot(0), tiny.K, tiny.DISTORTION)
    assert np.abs(shift).max() > 1  # the test would see a lens that is ignored
    assert scene.frame(0, 0).valid.mean() > 0.99


@pytest.mark.parametrize("masks", ["alpha", "background"])
def test_masks_of_nerfstudio_pictures(tmp_path, masks):
    scene = read_scene(tiny.nerfstudio(tmp_path, masks=masks, distortion=tiny.DISTORTION))
    assert (scene.mask_source.startswith("alpha"), scene.frame_count) == (masks == "alpha", tiny.FRAMES)
    assert_dot_is_where_the_camera_projects_it(scene, tolerance=0.15 if masks == "alpha" else 0.5)
    background = scene.background(0)
    assert (background is None) == (masks == "alpha")
    rim = scene.frame(0, 0)
    inside = rim.mask > 0.3
    np.testing.assert_allclose(
        rim.image[inside].astype(float).mean(axis=0), tiny.COLOUR, atol=3 if masks == "alpha" else 40
    )


def test_plain_background_where_nothing_else_is_known(tmp_path):
    tiny.nerfstudio(tmp_path)
    tiny.edit_json(tmp_path / "transforms.json", lambda d: [f.pop("mask_path") for f in d["frames"]])
    scene = read_scene(tmp_path)
    assert scene.mask_source == "plain background"
    assert_dot_is_where_the_camera_projects_it(scene, tolerance=0.5)


def test_masks_of_zero_and_one_count(tmp_path):
    import cv2

    tiny.nerfstudio(tmp_path)
    for path in tmp_path.glob("masks/*/*.png"):
        cv2.imwrite(str(path), (cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) > 127).astype(np.uint8))
    assert read_scene(tmp_path).frame(1, 1).mask.max() == 1


def test_smaller_pictures_scale_the_intrinsics(tmp_path):
    tiny.nerfstudio(tmp_path)
    double = {
        key: 2 * value for key, value in {"fl_x": 120, "fl_y": 124, "cx": 43.5, "cy": 46, "w": 96, "h": 80}.items()
    }
    tiny.edit_json(tmp_path / "transforms.json", lambda d: d.update(double))
    np.testing.assert_allclose(read_scene(tmp_path).cameras[0].intrinsics, tiny.K)


def test_intrinsics_may_be_each_pictures_own(tmp_path):
    def own(d):
        focal = d.pop("fl_x")
        for k, frame in enumerate(d["frames"]):
            frame["fl_x"] = focal + 5 * (k % tiny.VIEWS)

    tiny.nerfstudio(tmp_path)
    tiny.edit_json(tmp_path / "transforms.json", own)
    assert [c.intrinsics[0, 0] for c in read_scene(tmp_path).cameras] == [120, 125, 130]


def test_blender_splits_and_normalised_times(tmp_path):
    scene = read_scene(tiny.blender(tmp_path, fps=tiny.FRAMES - 1))  # times 0 … 1
    assert any("--holdout-camera 2" in problem for problem in scene.problems)
    assert any("0 to 1" in problem for problem in scene.problems)
    (tmp_path / "scene.yaml").write_text("fps: 24")
    scene = read_scene(tmp_path)
    assert (scene.fps, scene.frame_count) == (24, tiny.FRAMES)
    assert not any("0 to 1" in problem for problem in scene.problems)
    tiny.edit_json(tmp_path / "transforms_test.json", lambda d: d["frames"][1].update(time=0.5))
    assert any("1 pictures of transforms_test.json" in problem for problem in read_scene(tmp_path).problems)


def test_a_moving_camera_is_said(tmp_path):
    tiny.nerfstudio(tmp_path)
    tiny.edit_json(
        tmp_path / "transforms.json", lambda d: d.update(frames=[d["frames"][tiny.VIEWS * k + k] for k in range(3)])
    )
    assert any("one camera that moves" in problem for problem in read_scene(tmp_path).problems)


def test_crop_box_limits_the_mask(tmp_path):
    tiny.nerfstudio(tmp_path)
    (tmp_path / "scene.yaml").write_text("crop_box: [[5, 5, -9], [6, 6, -8]]")
    assert read_scene(tmp_path).frame(0, 0).mask.max() == 0


BAD_TRANSFORMS = [
    (lambda d: d["frames"][4].update(time=0.055), r"transforms\.json, frame 4 has time 0\.055"),
    (lambda d: [f.update(time=f["time"] + 0.04) for f in d["frames"][6:]], r"no view has a picture at frame 2"),
    (lambda d: [f.update(time=0) for f in d["frames"]], "same time"),
    (lambda d: d["frames"][2].pop("time"), r"transforms\.json, frame 2 .* has no 'time'"),
    (lambda d: d.update(camera_model="OPENCV_FISHEYE"), r"transforms\.json, frame 0: camera_model is 'OPENCV_FISHEYE'"),
    (lambda d: d.update(is_fisheye=True), "camera_model is 'fisheye'"),
    (lambda d: d.update(camera_model="OPENCV", k4=0.1), "has no k4"),
    (lambda d: d.update(camera_model="OPENCV", k1=-3.0), "is not invertible in the picture"),
    (lambda d: d.update(fl_x=-5), "must be positive"),
    (lambda d: d.pop("fl_x"), "neither 'fl_x' nor 'camera_angle_x'"),
    (lambda d: d.update(w=400), "another shape"),
    (
        lambda d: d["frames"][0].update(file_path="images/none.png"),
        r"images/none\.png, which .*frame 0 names, is missing",
    ),
    (
        lambda d: d["frames"][0].update(mask_path="masks/none.png"),
        r"masks/none\.png, which .*frame 0 names, is missing",
    ),
    (lambda d: d["frames"][1]["transform_matrix"][0].__setitem__(3, float("nan")), "finite numbers"),
    (lambda d: d["frames"][1]["transform_matrix"][0].__setitem__(0, 3.0), "frame 1: .*not a rotation"),
    (lambda d: d["frames"].append({**d["frames"][0], "file_path": d["frames"][1]["file_path"]}), "two pictures of one"),
    (lambda d: [f.update(time=f["time"] - 0.06) for f in d["frames"]], "second picture of its view before time 0"),
    (lambda d: d.update(frames=[]), r"transforms\.json: 'frames' must be a list"),
]


@pytest.mark.parametrize(("edit", "message"), BAD_TRANSFORMS)
def test_bad_transforms_name_the_file_and_the_entry(tmp_path, edit, message):
    tiny.nerfstudio(tmp_path)
    tiny.edit_json(tmp_path / "transforms.json", edit)
    with pytest.raises(InputError, match=message) as error:
        read_scene(tmp_path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "edit", "message"),
    [
        ("camera.json", lambda d: d[1].pop("K"), r"camera\.json, entry 1 has no 'K'"),
        ("camera.json", lambda d: d[1].update(camera="cam_9"), r"cam_9 has none of the pictures"),
        ("camera.json", lambda d: d[1].update(camera="cam_0"), "listed twice"),
        ("camera.json", lambda d: d[1].update(c2w=np.diag([2.0, 2, 2, 1]).tolist()), "entry 1: .*not a rotation"),
        ("frame.json", lambda d: d.__setitem__(2, {"002": 0.075}), r"frame\.json, entry [23] has time"),
        ("frame.json", lambda d: d.__setitem__(2, {"002": 0.0}), "does not increase"),
        ("frame.json", lambda d: d.__setitem__(2, {"002": "soon"}), r"frame\.json, entry 2: '002' is 'soon'"),
    ],
)
def test_bad_spring_gaus_listings(tmp_path, name, edit, message):
    tiny.springgaus_synthetic(tmp_path)
    tiny.edit_json(tmp_path / name, edit)
    with pytest.raises(InputError, match=message):
        read_scene(tmp_path)


def test_bad_real_captures(tmp_path):
    tiny.springgaus_real(tmp_path)
    binary = tmp_path / "static/colmap/dog/cameras.bin"
    for content, message in (
        (struct.pack("<QiiQQ4d", 1, 1, 5, 96, 80, 1, 1, 1, 1), "OPENCV_FISHEYE is not read"),
        (binary.read_bytes()[:40], r"cameras\.bin is cut short"),
        (struct.pack("<Q", 0), "lists no camera"),
    ):
        binary.write_bytes(content)
        with pytest.raises(InputError, match=message):
            read_scene(tmp_path)
    binary.unlink()
    with pytest.raises(InputError, match=r"cameras\.bin is missing"):
        read_scene(tmp_path)
    (tmp_path / "dynamic/videos_images/C0787/00101.jpg").unlink()
    tiny.edit_json(tmp_path / "dynamic/cameras_calib.json", lambda d: d["C0733"].pop("tvecs"))
    binary.write_bytes(struct.pack("<QiiQQ3d", 1, 1, 0, 240, 200, 250, 119, 101))
    with pytest.raises(InputError, match=r"cameras_calib\.json, 'C0733' has no 'tvecs'"):
        read_scene(tmp_path)
    tiny.edit_json(tmp_path / "dynamic/sequences/dog/0.json", lambda d: d.pop("C0733"))
    with pytest.raises(InputError, match=r"00101\.jpg, which .*0\.json, 'C0787'\[1\] names, is missing"):
        read_scene(tmp_path)


def test_unknown_layout_lists_the_known_ones(tmp_path):
    with pytest.raises(InputError) as error:
        read_scene(tmp_path)
    for layout in LAYOUTS:
        assert f"{layout.files} ({layout.name})" in str(error.value)
