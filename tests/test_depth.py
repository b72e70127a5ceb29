"""Depth pictures: reading, what they say of a volume, and the loss of a reconstruction."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace

import cv2
import numpy as np
import pytest
import tiny_scenes as tiny
import torch
from depth_scene import CENTRE, NOISE, RADIUS, ball_depth, ball_with_depth
from hypothesis import given, settings
from hypothesis import strategies as st
from ring_scene import look_at, ring, spheres_scene

from masiv.continuum.config import TrajectoryConfig
from masiv.continuum.fill import fill_volume
from masiv.errors import InputError, MasivError
from masiv.hull.carve import visual_hull
from masiv.hull.depth import local_thickness
from masiv.observations.identity import identity
from masiv.observations.read import read_scene
from masiv.scene.depth import back_projected, read_depth
from masiv.scene.depth_masks import from_empty_depth
from masiv.scene.summary import as_text, summarise
from masiv.splat.config import ReconstructConfig
from masiv.splat.losses import depth_distance
from masiv.splat.observed_image import ObservedDepth, observed_image, observed_images

VOLUME = 4 / 3 * np.pi * RADIUS**3
DEPTH_FRAME = 700  # millimetres at pixel (0, 0) of a picture, one more a column


# ---- reading --------------------------------------------------------------------------------------------------------


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31), st.floats(0.3, 3.0))
def test_points_of_a_depth_picture_project_back_to_it(seed, far):
    """Depth -> world points -> pixel and depth is the identity, for any camera."""
    random = np.random.default_rng(seed)
    camera = look_at("any", random.normal(size=3) + np.array([0, 0, far]), random.normal(size=3), 24, 30.0)
    depth = np.where(random.random((24, 24)) < 0.3, 0, far + random.random((24, 24))).astype(np.float32)
    pixels, along = camera.project(back_projected(camera, depth))
    again = np.zeros_like(depth)
    column, row = np.floor(pixels).astype(int).T
    again[row, column] = along
    np.testing.assert_allclose(again, depth, rtol=1e-6)
    np.testing.assert_allclose(pixels % 1, 0.5, atol=1e-6)


def depth_steps() -> np.ndarray:
    """(H, W) uint16 [mm], another value in each column, and a hole."""
    steps = np.broadcast_to(DEPTH_FRAME + np.arange(tiny.WIDTH, dtype=np.uint16), (tiny.HEIGHT, tiny.WIDTH)).copy()
    steps[3, 5] = 0
    return steps


def add_depth(folder, unit=None):
    def change(listing):
        for row in listing["frames"]:
            row["depth_file_path"] = row["file_path"].replace("images", "depths")
            path = folder / row["depth_file_path"]
            path.parent.mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(path), depth_steps())
        if unit is not None:
            listing["depth_unit_scale_factor"] = unit

    tiny.edit_json(folder / "transforms.json", change)
    return folder


@pytest.mark.parametrize("unit", [None, 2e-3])
def test_nerfstudio_depth(tmp_path, unit):
    scene = read_scene(add_depth(tiny.nerfstudio(tmp_path), unit))
    depth = scene.frame(1, 2).depth
    assert depth is not None
    np.testing.assert_allclose(depth, depth_steps() * np.float32(unit or 1e-3))
    assert scene.depth_noise is not None
    summary = summarise(scene)
    json.dumps(summary)
    assert "known in 100.0%" in as_text({**summary, "picture": "x.png"})


def test_scene_yaml_declares_unit_and_noise(tmp_path):
    add_depth(tiny.nerfstudio(tmp_path))
    (tmp_path / "scene.yaml").write_text("depth_unit: 1.0e-4\ndepth_noise: {constant: 0.004, quadratic: 0}")
    scene = read_scene(tmp_path)
    depth = scene.frame(0, 0).depth
    assert depth is not None
    assert depth[0, 0] == pytest.approx(DEPTH_FRAME * 1e-4)
    assert scene.depth_noise is not None
    assert scene.depth_noise.std(np.array(2.0)) == pytest.approx(0.004)
    (tmp_path / "scene.yaml").write_text("depth_noise: {sigma: 0.004}")
    with pytest.raises(InputError, match="sigma"):
        read_scene(tmp_path)


def test_undistorted_depth_is_of_one_pixel_not_a_mean(tmp_path):
    """Every value that an undistorted depth picture has, the measured one had."""
    scene = read_scene(add_depth(tiny.nerfstudio(tmp_path, distortion=tiny.DISTORTION)))
    depth = scene.frame(0, 0).depth
    assert depth is not None
    found = np.rint(1e3 * depth).astype(int)
    assert np.abs(1e3 * depth - found).max() < 1e-3
    assert set(np.unique(found)) <= set(np.unique(depth_steps()))
    assert not (np.diff(found[40]) == 1).all()  # it was resampled


def test_a_depth_picture_of_another_size_is_refused(tmp_path):
    add_depth(tiny.nerfstudio(tmp_path))
    path = next((tmp_path / "depths").rglob("*.png"))
    assert cv2.imwrite(str(path), depth_steps()[:10])
    with pytest.raises(InputError, match="align the depth pictures"):
        read_scene(tmp_path)


@pytest.mark.parametrize("broken", ["colour", "eight bits", "nothing"])
def test_what_is_no_depth_picture_is_refused(tmp_path, broken):
    path = tmp_path / "depth.png"
    if broken != "nothing":
        shape, kind = ((4, 5, 3), np.uint16) if broken == "colour" else ((4, 5), np.uint8)
        assert cv2.imwrite(str(path), np.ones(shape, kind))
    with pytest.raises(InputError, match=r"depth\.png"):
        read_depth(path, 1e-3)


def pacnerf(folder, views=2, frames=2, empty=True):
    cameras = ring(count=views, size=64, focal=100.0)
    rows = []
    for view, camera in enumerate(cameras):
        wall = np.full((64, 64), 4.0)
        c2w = np.linalg.inv(camera.world_to_camera) @ np.diag([1.0, -1, -1, 1])
        for frame in range(-1 if empty else 0, frames):
            ball = ball_depth(camera) if frame >= 0 else np.zeros((64, 64), np.float32)
            depth = np.where(ball > 0, ball, wall)
            path = folder / "data" / f"r_{view}_{frame}.png"
            path.parent.mkdir(exist_ok=True, parents=True)
            assert cv2.imwrite(str(path.with_name(f"d_{view}_{frame}.png")), np.rint(1e3 * depth).astype(np.uint16))
            if frame >= 0:
                picture = np.full((64, 64, 3), 90, np.uint8)  # grey before grey: the colour shows nothing
                assert cv2.imwrite(str(path), picture)
                row = {"file_path": f"./data/{path.name}", "c2w": c2w[:3].tolist(), "time": frame / 24}
                rows.append({**row, "intrinsic": camera.intrinsics.tolist()})
    tiny.write_json(folder / "all_data.json", rows)
    return cameras


def test_pacnerf_depth_and_masks_of_an_empty_scene(tmp_path):
    cameras = pacnerf(tmp_path)
    scene = read_scene(tmp_path)
    assert "depth" in scene.mask_source
    for view in scene.views:
        picture = scene.frame(view, 1)
        truth = ball_depth(cameras[view]) > 0
        assert (picture.mask > 0.5)[truth].mean() > 0.97
        assert (picture.mask > 0.5)[~truth].mean() < 0.01
        assert picture.depth is not None
        np.testing.assert_allclose(picture.depth[truth], ball_depth(cameras[view])[truth], atol=5e-4)


def test_identity_covers_depth(tmp_path):
    pacnerf(tmp_path)
    before = identity(read_scene(tmp_path))
    path = tmp_path / "data/d_0_0.png"
    depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    depth[30, 30] += 1
    cv2.imwrite(str(path), depth)
    assert identity(read_scene(tmp_path)) != before


def test_holes_in_depth_do_not_make_holes_in_the_mask():
    empty, depth = np.full((40, 40), 2.0, np.float32), np.full((40, 40), 2.0, np.float32)
    depth[10:30, 10:30] = 1.5
    depth[15:20, 15:20] = 0  # not measured, on the object
    depth[0:5] = 0  # not measured, beside it
    mask = from_empty_depth(depth, empty, NOISE)
    expected = np.zeros((40, 40))
    expected[10:30, 10:30] = 1
    assert np.abs(mask - expected).sum() <= 8  # corners


# ---- the layout of PhysTwin -----------------------------------------------------------------------------------------


def phystwin(folder, *, hand=True, views=2, frames=3):
    poses = []
    for view in range(views):
        poses.append(tiny.pose(view) @ np.diag([1.0, -1, -1, 1]))  # OpenCV axes
        for frame in range(frames):
            alpha = tiny.cover(tiny.pixel(view, tiny.dot(frame)))
            tiny.draw(folder / f"color/{view}/{frame}.png", alpha, rgba=False)
            (folder / f"depth/{view}").mkdir(parents=True, exist_ok=True)
            np.save(folder / f"depth/{view}/{frame}.npy", depth_steps())
            mask = folder / f"mask/{view}/1/{frame}.png"
            mask.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(mask), np.round(255 * alpha).astype(np.uint8))
        names = {"0": "hand", "1": "sloth"} if hand else {"1": "sloth"}
        tiny.write_json(folder / f"mask/mask_info_{view}.json", names)
    k = np.array(tiny.K) - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]  # pixel centres at whole numbers
    metadata = {"intrinsics": [k.tolist()] * views, "fps": 30, "WH": [tiny.WIDTH, tiny.HEIGHT], "frame_num": frames}
    tiny.write_json(folder / "metadata.json", metadata)
    (folder / "calibrate.pkl").write_bytes(pickle.dumps(poses))
    return folder


def test_phystwin(tmp_path):
    scene = read_scene(phystwin(tmp_path))
    assert (scene.layout, scene.fps, scene.frame_count, len(scene.cameras)) == ("PhysTwin", 30, 3, 2)
    np.testing.assert_allclose(scene.up, [0, 0, -1])
    for view in scene.views:
        for frame in range(3):
            picture = scene.frame(view, frame)
            expected = scene.cameras[view].project(tiny.dot(frame)[None])[0][0]
            np.testing.assert_allclose(tiny.centroid(picture.mask), expected, atol=0.05)
            assert picture.depth is not None
            np.testing.assert_allclose(picture.depth, depth_steps() * np.float32(1e-3))
    assert any("a hand moves the object" in problem for problem in scene.problems)
    assert not any("hand" in p for p in read_scene(phystwin(tmp_path / "free", hand=False)).problems)


class _Evil:
    def __reduce__(self):
        return eval, ("1 + 1",)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: (f / "calibrate.pkl").write_bytes(pickle.dumps([_Evil()])), "builtins.eval"),
        (lambda f: (f / "calibrate.pkl").write_bytes(b"text"), "not a pickle file"),
        (lambda f: (f / "calibrate.pkl").write_bytes(pickle.dumps([np.eye(4)])), "each of the 2 cameras"),
        (lambda f: (f / "calibrate.pkl").write_bytes(pickle.dumps([2 * np.eye(4)] * 2)), "calibrate.pkl"),
        (lambda f: tiny.edit_json(f / "metadata.json", lambda m: m.pop("intrinsics")), "intrinsics"),
        (lambda f: tiny.edit_json(f / "metadata.json", lambda m: m.update(fps=0)), "fps is 0"),
        (lambda f: (f / "mask/1/1/2.png").unlink(), "no mask of frame 2"),
        (lambda f: tiny.edit_json(f / "mask/mask_info_0.json", lambda m: m.update({"2": "dog"})), "2 objects"),
        (lambda f: np.save(f / "depth/0/1.npy", depth_steps()[:, :7]), "align the depth pictures"),
        (lambda f: np.save(f / "depth/0/1.npy", np.array([{}]), allow_pickle=True), "not an array of numbers"),
    ],
)
def test_broken_phystwin_is_one_clear_error(tmp_path, change, message):
    change(phystwin(tmp_path))
    with pytest.raises(InputError, match=message):
        read_scene(tmp_path)


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_every_protocol_of_pickle_is_read(tmp_path, protocol):
    phystwin(tmp_path)
    poses = np.array(pickle.loads((tmp_path / "calibrate.pkl").read_bytes()))
    (tmp_path / "calibrate.pkl").write_bytes(pickle.dumps(poses, protocol))
    np.testing.assert_allclose(read_scene(tmp_path).cameras[1].centre, poses[1][:3, 3], atol=1e-9)


# ---- volumes --------------------------------------------------------------------------------------------------------


def hull_errors(scene, resolution=48):
    """Volume over that of the ball, and distance [m] of the centroid from its centre."""
    hull = visual_hull(scene, 0, resolution=resolution)
    return hull.volume / VOLUME, float(np.linalg.norm(hull.points.mean(axis=0) - CENTRE))


def opposite(size=96, focal=150.0):
    return tuple(look_at(str(k), np.array([x, 0.6, 0.3]), CENTRE, size, focal) for k, x in enumerate((2.0, -2.0)))


def test_two_cameras_with_depth_measure_a_ball_that_their_silhouettes_do_not():
    plain = spheres_scene(lambda frame: [(CENTRE, RADIUS)], cameras=opposite(), frame_count=2)
    volume, _ = hull_errors(plain)
    assert volume > 1.35  # two facing cameras: a double cone
    volume, centre = hull_errors(ball_with_depth(opposite(), noise=True))
    assert 0.95 < volume < 1.2
    assert centre < 0.03 * RADIUS


def test_one_camera_with_depth_guesses_the_hidden_side():
    one = opposite()[:1]
    with pytest.raises(MasivError, match="needs 2, or 1 with depth"):
        visual_hull(spheres_scene(lambda frame: [(CENTRE, RADIUS)], cameras=one), 0)
    for noise, holes in ((False, 0.0), (True, 0.2)):
        volume, centre = hull_errors(ball_with_depth(one, noise=noise, holes=holes))
        assert 0.9 < volume < 1.2
        assert centre < 0.1 * RADIUS


def test_filled_ball_of_one_camera():
    """The most likely surface, without the margin that keeps noise from cutting into it."""
    config = TrajectoryConfig(particle_count=2000, fill_resolution=40)
    for cameras, tolerance in ((opposite(), 0.04), (opposite()[:1], 0.08)):
        filled = fill_volume(ball_with_depth(cameras, noise=True), None, 0, config)
        assert filled.volume == pytest.approx(VOLUME, rel=tolerance)
        assert np.linalg.norm(filled.points.mean(axis=0) - CENTRE) < 0.06 * RADIUS


@pytest.mark.parametrize("radius", [6.0, 11.5, 20.0])
def test_thickness_of_a_disc_and_of_a_bar(radius):
    x, y = np.meshgrid(np.arange(100) + 0.5, np.arange(100) + 0.5)
    away = np.hypot(x - 50, y - 50)
    ball = local_thickness(away < radius)
    inner = away < 0.8 * radius
    np.testing.assert_allclose(ball[inner], 2 * np.sqrt(radius**2 - away[inner] ** 2), atol=1.5 + 0.1 * radius)
    bar = local_thickness((np.abs(y - 50) < radius) & (np.abs(x - 50) < 48))
    assert bar[50, 50] == pytest.approx(2 * radius, abs=2.5)
    assert bar[50 + int(0.8 * radius), 50] == pytest.approx(1.2 * radius, abs=2.5)


def test_unknown_depth_says_nothing():
    scene = spheres_scene(lambda frame: [(CENTRE, RADIUS)], frame_count=2)
    blind = ball_with_depth(scene.cameras, holes=1.0)
    np.testing.assert_array_equal(visual_hull(blind, 0).points, visual_hull(scene, 0).points)


# ---- the loss of a reconstruction -----------------------------------------------------------------------------------


def test_gradient_of_the_depth_loss(taichi):
    """Against finite differences, through projection and blending."""
    from masiv.splat.rasteriser import render

    random = np.random.default_rng(3)
    camera = look_at("front", np.array([0.0, 0.1, 1.5]), np.zeros(3), 24, 40.0)
    means = torch.tensor(random.uniform(-0.2, 0.2, (12, 3)))
    fixed = torch.full((12,), 0.08).double(), torch.full((12,), 0.8).double(), torch.full((12, 3), 0.5).double()
    target = torch.tensor(1.4 + 0.1 * random.random((24, 24)))
    observed = ObservedDepth(target, torch.full_like(target, 0.03), torch.ones_like(target))

    def loss(at):
        drawn = render(camera, at, *fixed, torch.zeros(3))
        return depth_distance(drawn.depth, drawn.alpha, observed)

    means.requires_grad_()
    loss(means).backward()
    gradient = means.grad
    assert gradient is not None
    assert float(gradient.abs().max()) > 1e-3
    step = 1e-6
    for index in ((0, 2), (3, 2), (7, 0), (11, 1)):
        change = torch.zeros_like(means)
        change[index] = step
        with torch.no_grad():
            slope = float(loss(means + change) - loss(means - change)) / (2 * step)
        assert float(gradient[index]) == pytest.approx(slope, rel=2e-3, abs=1e-6)


def test_depth_distance_is_a_square_inside_the_noise_and_a_distance_outside():
    one = torch.ones(1, 1)
    noise = 0.01
    for error, expected in ((0.005, 0.005**2 / 0.02), (0.1, 0.095), (-0.1, 0.095)):
        observed = ObservedDepth(2 * one, noise * one, one)
        assert float(depth_distance((2 + error) * one, one, observed)) == pytest.approx(expected, rel=1e-4)
    unknown = ObservedDepth(2 * one, noise * one, 0 * one)
    assert float(depth_distance(3 * one, one, unknown)) == 0


@pytest.mark.parametrize("off", [0.0, 0.06])
def test_depth_term_of_the_objective(taichi, off):
    """Gaussians on the seen half of the ball, ``off`` [m] along the optical axis: colour and mask hardly see that."""
    from masiv.splat.objective import PARAMETER_NAMES, Objective

    scene = ball_with_depth(opposite(size=64, focal=100.0)[:1])
    camera, image = scene.cameras[0], observed_image(scene, 0, 0, crop_side=64, crop_padding=2)
    assert image is not None
    axis = camera.world_to_camera[2, :3]
    points = back_projected(camera, ball_depth(camera)) + off * axis
    means = torch.tensor(points, dtype=torch.float32, requires_grad=True)
    count = len(points)
    rest = torch.full((count,), float(np.log(0.006))), torch.full((count,), 2.0), torch.full((count, 3), 1.3)
    gaussians = dict(zip(PARAMETER_NAMES, (means, *rest), strict=True))
    losses = {}
    for weight in (0.0, 0.3):
        config = ReconstructConfig(depth_weight=weight)
        objective = Objective(config, 0.006, RADIUS, 24.0, None, (), [[image]])
        network: torch.nn.Module | None = None  # frame 0 does not move
        losses[weight] = objective(gaussians, network, (), [(0, 0)], 1.0, np.random.default_rng(0))  # type: ignore[arg-type]
    term = float((losses[0.3] - losses[0.0]).detach()) * RADIUS / 0.3
    assert term == pytest.approx(
        max(0.0, off - 0.5 * NOISE.constant), abs=8e-3
    )  # pixels are 17 mm wide, and steep at the rim
    if off:
        (gradient,) = torch.autograd.grad(losses[0.3] - losses[0.0], [means])
        forces = gradient.double().numpy().sum(axis=0)
        assert forces @ axis > 0.9 * np.linalg.norm(forces)  # a step of descent goes towards the camera


def test_observed_depth_has_no_means_over_edges():
    scene = ball_with_depth(opposite())
    image = observed_image(scene, 0, 0, crop_side=20, crop_padding=2)
    assert image is not None
    assert image.depth is not None
    known = image.depth.known > 0
    assert 0.4 < float(known.float().mean()) < 0.8
    values = image.depth.values[known]
    away = np.linalg.norm(scene.cameras[0].centre - CENTRE)
    assert away - RADIUS - 0.02 < float(values.min())
    assert float(values.max()) < away
    assert image.depth.values.shape == image.mask.shape
    config = ReconstructConfig(crop_side=20, crop_padding=2)
    stored = observed_images(scene, config, range(2))[0][0].depth  # as the fit reads it
    assert stored is not None
    for one, other in ((stored.values, image.depth.values), (stored.noise, image.depth.noise)):
        torch.testing.assert_close(one, other)
    assert bool((stored.known == image.depth.known).all())
    plain = observed_image(replace(scene, depth_noise=None), 0, 0, crop_side=20, crop_padding=2)
    assert plain is not None
    assert plain.depth is None
