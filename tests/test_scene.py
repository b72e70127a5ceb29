"""Reading a PAC-NeRF scene that is written here, so that every pixel and pose is known."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from masiv.errors import InputError
from masiv.observations.read import read_scene

WIDTH, HEIGHT, FRAMES = 48, 40, 3
CENTRE = np.array([0.05, 0.6, -0.1])


def pose(view):
    """An OpenGL camera-to-world, 3×4, with t_x, t_y and t_z all different from zero, looking about at CENTRE."""
    eye = CENTRE + np.array([0.7 * np.cos(view), 0.5 + 0.1 * view, 1.6 + 0.7 * np.sin(view)])
    back = (eye - CENTRE + 0.05) / np.linalg.norm(eye - CENTRE + 0.05)
    right = np.cross([0, 1, 0], back)
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(back, right), back, eye])


INTRINSICS = np.array([[60.0, 0, 21.5], [0, 62.0, 23.0], [0, 0, 1]])


def project_by_hand(view, point):
    """OpenGL: x right, y up, −z forward; pixel rows grow downwards."""
    c2w = pose(view)
    x, y, z = c2w[:, :3].T @ (point - c2w[:, 3])
    return np.array([INTRINSICS[0, 2] + 60 * x / -z, INTRINSICS[1, 2] - 62 * y / -z]), -z


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "data").mkdir()
    rng = np.random.default_rng(0)
    rows = []
    for view in (0, 2):  # view ids need not be dense
        background = rng.integers(80, 120, (HEIGHT, WIDTH, 3), np.uint8)
        background = cv2.GaussianBlur(background, (0, 0), 3)
        for frame in range(-1, FRAMES):
            picture, cutout = background.copy(), np.full_like(background, 255)
            if frame >= 0:
                for target in (picture, cutout):
                    target[10:30, 12 + 2 * frame : 30 + 2 * frame] = (30, 60, 200)
                cv2.imwrite(str(tmp_path / f"data/m_{view}_{frame}.png"), cutout)
            cv2.imwrite(str(tmp_path / f"data/r_{view}_{frame}.png"), picture)
            rows.append(
                {
                    "file_path": f"./data/r_{view}_{frame}.png",
                    "c2w": pose(view).tolist(),
                    "intrinsic": INTRINSICS.tolist(),
                    "time": frame / 24,
                }
            )
    (tmp_path / "all_data.json").write_text(json.dumps(rows))
    return tmp_path


def change(folder, edit):
    rows = json.loads((folder / "all_data.json").read_text())
    edit(rows)
    (folder / "all_data.json").write_text(json.dumps(rows))


def test_reads_cameras_and_the_layouts_conventions(folder):
    scene = read_scene(folder)
    assert (scene.layout, scene.fps, scene.frame_count, len(scene.cameras)) == ("pacnerf", 24, FRAMES, 2)
    np.testing.assert_allclose(scene.gravity, [0, -9.8, 0])
    np.testing.assert_allclose(scene.up, [0, 1, 0])
    assert scene.ground is not None
    assert scene.ground.height == 0
    assert scene.density == 1000
    assert scene.problems == ()


@pytest.mark.parametrize("rows", [3, 4])
def test_camera_projects_as_opengl_says_with_shifted_principal_point(folder, rows):
    change(folder, lambda d: [r.update(c2w=(r["c2w"] + [[0, 0, 0, 1]])[:rows]) for r in d])
    scene = read_scene(folder)
    for index, view in enumerate((0, 2)):
        for offset in ([0.1, 0.2, -0.1], [-0.3, 0.05, 0.2]):
            point = CENTRE + offset
            pixel, depth = scene.cameras[index].project(point[None])
            expected, expected_depth = project_by_hand(view, point)
            np.testing.assert_allclose(pixel[0], expected, atol=1e-9)
            np.testing.assert_allclose(depth[0], expected_depth, atol=1e-12)
        np.testing.assert_allclose(scene.cameras[index].centre, pose(view)[:, 3], atol=1e-12)


def test_picture_and_mask_are_those_of_the_cutout(folder):
    frame = read_scene(folder).frame(1, 2)
    expected = np.zeros((HEIGHT, WIDTH))
    expected[10:30, 16:34] = 1
    np.testing.assert_array_equal(frame.mask, expected)
    np.testing.assert_array_equal(frame.image[12, 20], [200, 60, 30])  # RGB
    assert frame.valid.all()


def test_a_white_highlight_is_no_hole_but_a_real_hole_is(folder):
    for kind in "rm":
        path = str(folder / f"data/{kind}_0_0.png")
        picture = cv2.imread(path)
        picture[15, 18] = 255
        if kind == "m":
            picture[20, 22] = 255  # not white in r: background seen through the object
        cv2.imwrite(path, picture)
    mask = read_scene(folder).frame(0, 0).mask
    assert mask[15, 18] == 1
    assert mask[20, 22] == 0


def test_alpha_pictures_come_first(folder):
    rgba = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    rgba[5:9, 5:9, 3] = 128
    for view in (0, 2):
        for frame in range(FRAMES):
            cv2.imwrite(str(folder / f"data/a_{view}_{frame}.png"), rgba)
    scene = read_scene(folder)
    assert "a_V_F" in scene.mask_source
    assert scene.frame(0, 1).mask[6, 6] == pytest.approx(128 / 255)


@pytest.mark.parametrize("keep_background", [True, False])
def test_masks_without_cutouts(folder, keep_background):
    for path in folder.glob("data/m_*.png"):
        path.unlink()
    if not keep_background:
        for path in folder.glob("data/r_*_-1.png"):
            path.unlink()
    scene = read_scene(folder)
    assert scene.mask_source.startswith("difference" if keep_background else "plain")
    expected = np.zeros((HEIGHT, WIDTH), bool)
    expected[10:30, 14:32] = True
    mask = scene.frame(0, 1).mask > 0.5
    assert (mask & expected).sum() / (mask | expected).sum() > 0.9


def test_a_shadow_on_the_background_is_not_the_object(folder):
    for path in folder.glob("data/m_*.png"):
        path.unlink()
    path = str(folder / "data/r_0_0.png")
    picture = cv2.imread(path)
    picture[31:38, 5:40] = (picture[31:38, 5:40] * 0.6).astype(np.uint8)
    cv2.imwrite(path, picture)
    assert read_scene(folder).frame(0, 0).mask[32:37].mean() < 0.02


def test_occluder_pixels_are_not_valid(folder):
    occluder = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    occluder[:, :10, 3] = 51
    occluder[:, 10:20, 3] = 50
    cv2.imwrite(str(folder / "data/r_2_-2.png"), occluder)
    scene = read_scene(folder)
    assert not scene.frame(1, 0).valid[:, :10].any()
    assert scene.frame(1, 0).valid[:, 10:].all()
    assert scene.frame(0, 0).valid.all()


def test_scene_yaml_overrides(folder):
    (folder / "scene.yaml").write_text(
        "fps: 50\nup_axis: z\ngravity: 1.6\nground: {normal: [0, 0, 2], height: 0.1}\nfit_frames: 2"
    )
    scene = read_scene(folder)
    assert (scene.fps, scene.fit_frames) == (50, 2)
    np.testing.assert_allclose(scene.gravity, [0, 0, -1.6])
    assert scene.ground is not None
    np.testing.assert_allclose(scene.ground.normal, [0, 0, 1])
    (folder / "scene.yaml").write_text("ground: none")
    assert read_scene(folder).ground is None


def test_crop_box_limits_the_mask(folder):
    low, high = CENTRE - 0.05, CENTRE + 0.05
    (folder / "scene.yaml").write_text(f"crop_box: [{low.tolist()}, {high.tolist()}]")
    mask = read_scene(folder).frame(0, 0).mask
    pixel, _ = project_by_hand(0, CENTRE)
    rows, columns = np.nonzero(mask)
    assert 0 < len(rows) < 60
    assert abs(columns.mean() - pixel[0]) < 4


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("gravty: 9.8", "unknown key 'gravty': did you mean 'gravity'"),
        ("ground: {normal: [0, 1, 0], hieght: 1}", "hieght"),
        ("fps: -1", "'fps' is -1"),
        ("fps: .nan", "'fps'"),
        ("ground: {normal: [0, -1, 0]}", "points away"),
        ("up_axis: [0, 0, 0]", "up_axis is zero"),
        ("fit_frames: 9", "the scene has 3 frames"),
        ("- 1", "key: value"),
        ("a: [", "not valid YAML"),
    ],
)
def test_bad_scene_yaml_is_one_clear_sentence(folder, text, message):
    (folder / "scene.yaml").write_text(text)
    with pytest.raises(InputError) as error:
        read_scene(folder)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda d: d[1].pop("c2w"), "entry 1"),
        (lambda d: d[1]["c2w"][0].__setitem__(3, float("nan")), "finite numbers"),
        (lambda d: d[1].update(c2w=(2 * np.array(d[1]["c2w"])).tolist()), "not a rotation"),
        (lambda d: d[2]["c2w"][0].__setitem__(3, 9.0), "moves between"),
        (lambda d: d[2].update(time=0.09), "not frame 1 at 24 fps"),
        (lambda d: d.append(d[2]), "listed twice"),
        (lambda d: d[1].update(file_path="data/first.png"), "does not read as"),
        (lambda d: d[1].update(intrinsic=[[0, 0, 0]] * 3), "positive focal"),
        (lambda d: [d.remove(r) for r in list(d) if r["file_path"].endswith("_0.png")], "any view at frame 0"),
        (lambda d: d.clear(), "must be a list"),
    ],
)
def test_bad_listing(folder, edit, message):
    change(folder, edit)
    with pytest.raises(InputError, match=message):
        read_scene(folder)


def test_a_missing_picture_is_listed_and_invisible(folder):
    (folder / "data/r_2_1.png").unlink()
    scene = read_scene(folder)
    assert any("view 2 has no picture at frame 1" in p for p in scene.problems)
    assert not scene.frame(1, 1).valid.any()


@pytest.mark.parametrize("listed", [True, False])
def test_a_frame_that_no_camera_has_is_listed_and_not_observed(folder, listed):
    if not listed:
        change(folder, lambda d: [d.remove(r) for r in list(d) if r["file_path"].endswith("_1.png")])
    for view in (0, 2):
        (folder / f"data/r_{view}_1.png").unlink()
    scene = read_scene(folder)
    assert (scene.frame_count, scene.observed_frames) == (FRAMES, (0, 2))
    assert scene.problems == ("no camera has a picture at frame 1: the motion is interpolated there",)
    assert not scene.frame(0, 1).valid.any()


def test_a_frame_that_only_a_held_out_camera_has_is_not_observed(folder):
    (folder / "data/r_0_1.png").unlink()
    scene = read_scene(folder)
    assert scene.observed_frames == (0, 1, 2)
    assert scene.restricted(holdout_cameras=(1,)).observed_frames == (0, 2)


def test_pictures_of_different_size_and_broken_pictures(folder):
    cv2.imwrite(str(folder / "data/r_0_1.png"), np.zeros((10, 12, 3), np.uint8))
    with pytest.raises(InputError, match="differ in size"):
        read_scene(folder)
    (folder / "data/r_0_1.png").write_bytes((folder / "data/r_0_2.png").read_bytes()[:100])
    scene = read_scene(folder)
    with pytest.raises(InputError, match=r"r_0_1\.png cannot be read"):
        scene.frame(0, 1)


def test_unknown_layout_says_what_was_looked_for(tmp_path):
    with pytest.raises(InputError, match=r"all_data\.json"):
        read_scene(tmp_path)
    with pytest.raises(InputError, match="not a folder"):
        read_scene(tmp_path / "nothing")


def test_held_out_views_and_frames_cannot_be_seen(folder):
    scene = read_scene(folder).restricted(fit_frames=2, holdout_cameras=(1,))
    assert scene.views == (0,)
    scene.frame(0, 1)
    for view, frame in ((1, 0), (0, 2)):
        with pytest.raises(InputError, match="held out"):
            scene.frame(view, frame)


def test_poses_in_hand_are_rotations():
    assert np.linalg.det(pose(1)[:, :3]) == pytest.approx(1)
