"""From where a simulation is drawn: pixels, sizes and frames that follow from the numbers given."""

import math

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from PIL import Image
from small_run import FPS, write_run

from masiv.errors import InputError
from masiv.pipeline import SimulateRequest, reopen_run
from masiv.report.draw import draw
from masiv.report.viewpoints import (
    FIELD_OF_VIEW,
    FreeView,
    OrbitView,
    SceneView,
    looking_at,
    parse_size,
    parse_view,
    resized,
    viewpoints,
)
from masiv.scene.camera import Camera
from masiv.splat.gaussians import Gaussians

UP = np.array([0.0, 1.0, 0.0])
CAMERA = Camera("left", 64, 48, np.array([[80.0, 0, 30], [0, 82, 20], [0, 0, 1]]), np.eye(4))


def test_a_particle_is_drawn_where_trigonometry_says(taichi):
    """A camera at (0, 0, 4) that looks at the origin sees a point 0.6 m to the right and 0.3 m up at tan = 0.15 and
    0.075; half the picture's height is tan 20°."""
    width, height = 200, 160
    camera = looking_at(np.array([0.0, 0, 4]), np.zeros(3), UP, (width, height))
    point = Gaussians(
        torch.tensor([[0.6, 0.3, 0.0]]), torch.tensor([0.03]), torch.tensor([0.9]), torch.tensor([[1.0, 1, 1]])
    )
    picture, alpha = draw(point, camera)
    assert picture.shape == (height, width, 3)
    rows, columns = np.indices(alpha.shape) + 0.5
    focal = height / 2 / math.tan(math.radians(20))
    found = (columns * alpha).sum() / alpha.sum(), (rows * alpha).sum() / alpha.sum()
    np.testing.assert_allclose(found, (width / 2 + 0.15 * focal, height / 2 - 0.075 * focal), atol=0.2)


@pytest.mark.parametrize("size", [(128, 96), (200, 96), (128, 150)])
def test_another_size_shows_all_of_the_picture(size):
    camera = resized(CAMERA, *size)
    assert (camera.width, camera.height) == size
    factor = min(size[0] / 64, size[1] / 48)
    corners = np.array([[(u - 30) / 80, (v - 20) / 82, 1.0] for u, v in ((0, 0), (64, 48), (32, 24))])
    low, high, middle = camera.project(corners)[0]
    np.testing.assert_allclose(middle, np.array(size) / 2)
    np.testing.assert_allclose(high - low, factor * np.array([64, 48]))


def test_an_orbit_goes_round_the_motion_and_sees_all_of_it():
    random = np.random.default_rng(2)
    motion = random.uniform(-1, 1, (8, 50, 3)) * [1.0, 0.3, 0.5] + [3, 1, -2]
    up = np.array([0.0, 0.0, 1.0])
    (found,) = viewpoints([OrbitView(turns=0.5, elevation=30)], [], motion, up)
    low, high = motion.min((0, 1)), motion.max((0, 1))
    centres = np.array([camera.centre for camera in found.cameras]) - (low + high) / 2
    distance = np.linalg.norm(centres, axis=1)
    np.testing.assert_allclose(distance, distance[0])
    np.testing.assert_allclose(centres[:, 2], distance[0] * 0.5)
    angles = np.unwrap(np.arctan2(centres[:, 1], centres[:, 0]))
    np.testing.assert_allclose(np.diff(angles), math.pi / 8)
    for camera, points in zip(found.cameras, motion, strict=True):
        pixels, depth = camera.project(points)
        assert (depth > 0).all()
        assert (pixels > 0).all()
        assert (pixels < [camera.width, camera.height]).all()
        top = camera.project(((low + high) / 2 + 0.1 * up)[None])[0][0]
        np.testing.assert_allclose(top[0], camera.width / 2)
        assert top[1] < camera.height / 2


def test_a_camera_may_look_straight_down():
    camera = looking_at(np.array([0.0, 2, 0]), np.zeros(3), UP, (100, 100))
    pixels, depth = camera.project(np.array([[0.0, 0, 0], [0.1, 0, 0]]))
    np.testing.assert_allclose(pixels[0], 50)
    np.testing.assert_allclose(depth, 2)
    assert np.linalg.norm(pixels[1] - pixels[0]) == pytest.approx(0.05 * 50 / math.tan(FIELD_OF_VIEW / 2))


def test_views_are_read():
    free = parse_view("free:1,2,3,0,0.5,0")
    assert isinstance(free, FreeView)
    np.testing.assert_array_equal([free.position, free.target], [[1, 2, 3], [0, 0.5, 0]])
    assert parse_view("orbit") == OrbitView()
    assert parse_view("orbit:turns=2,distance=1.5") == OrbitView(turns=2, distance=1.5)
    assert parse_view("left") == SceneView("left")
    assert parse_size("640x480") == (640, 480)
    names = [v.name for v in viewpoints([free, free, SceneView("left")], [CAMERA], np.zeros((2, 4, 3)), UP)]
    assert names == ["free", "free2", "0"]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: parse_view("free:1,2,3"), "six numbers"),
        (lambda: parse_view("free:1,2,3,nan,0,0"), "give an index"),
        (lambda: parse_view("free:1,2,3,1,2,3"), "stands where it should look"),
        (lambda: parse_view("free:1e9,2,3,1,2,3"), "length"),
        (lambda: parse_view("orbit:speed=2"), "an orbit has turns"),
        (lambda: parse_view("orbit:elevation=90"), "elevation"),
        (lambda: parse_view("orbit:distance=0"), "above 0 m"),
        (lambda: parse_size("640"), "--size 640"),
        (lambda: parse_size("10x10"), "16 to 8192"),
        (lambda: parse_size("99999999x480"), "16 to 8192"),
        (lambda: viewpoints([SceneView("7")], [CAMERA], np.zeros((2, 4, 3)), UP), "cameras 0 to 0 \\(left\\)"),
        (lambda: viewpoints([SceneView("0")], [], np.zeros((2, 4, 3)), UP), "no cameras"),
    ],
)
def test_what_cannot_be_drawn_is_refused(call, message):
    with pytest.raises(InputError, match=message):
        call()


def test_a_simulation_is_drawn_without_the_scene(taichi, tmp_path):
    """Five frames at 24 a second, slowed down four times; two viewpoints side by side. The scene does not exist."""
    write_run(tmp_path / "run")
    run, out = reopen_run(tmp_path / "run"), tmp_path / "out"
    assert not run.scene_path.exists()
    request = SimulateRequest(5, camera=("free:0.1,0.6,3,0.1,0.6,0", "orbit", "view 0"), size="80x64", slow=4.0)
    run.simulate(request, out)
    names = sorted(path.name for path in (out / "views").iterdir())
    assert names == [f"{name}_{frame:03d}.png" for name in ("0", "free", "orbit") for frame in range(5)]
    assert {Image.open(path).size for path in (out / "views").iterdir()} == {(80, 64)}
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(out / "video.mp4"))
    assert frames == 5
    assert seconds == pytest.approx(5 * 4 / FPS, abs=0.02)
    reader = imageio_ffmpeg.read_frames(str(out / "video.mp4"))
    assert next(reader)["size"] == (3 * 80, 64)
    reader.close()


def test_a_camera_that_is_not_there_is_refused_before_anything_is_simulated(tmp_path):
    write_run(tmp_path / "run")
    run = reopen_run(tmp_path / "run")
    with pytest.raises(InputError, match="--camera 3: the scene has cameras 0 to 0"):
        run.simulate(SimulateRequest(5, camera=("3",)), tmp_path / "out")
    with pytest.raises(InputError, match="--slow 0"):
        run.simulate(SimulateRequest(5, slow=0.0), tmp_path / "out")
    assert not (tmp_path / "out").exists()
