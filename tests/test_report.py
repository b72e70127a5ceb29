"""Gaussians that follow particles, backgrounds, the log and the page."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from masiv.errors import InputError
from masiv.report import history, measure, pictures
from masiv.report.camera_view import Cut
from masiv.report.draw import backdrop, draw
from masiv.report.follow import Binding
from masiv.report.media import write_png, write_video
from masiv.report.numbers import rows, table
from masiv.report.page import Page, number
from masiv.report.plotly_script import packed_script
from masiv.report.time_charts import convergence, over_time
from masiv.scene.camera import Camera
from masiv.scene.scene import Frame, Ground, Scene
from masiv.splat.gaussians import Gaussians

UP = np.array([0.0, 1.0, 0.0])


def cloud(count=40, seed=0):
    means = torch.from_numpy(0.2 + 0.6 * np.random.default_rng(seed).random((count, 3)))
    return Gaussians(means, torch.full((count,), 0.02).double(), torch.ones(count), torch.ones(count, 3))


def camera():
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = 0, 1.0, 3.0  # at (0, 1, 3), looking along −z
    return Camera("front", 64, 48, np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), pose)


def test_gaussians_follow_a_rigid_motion_exactly():
    particles = np.random.default_rng(1).random((2000, 3))
    gaussians = cloud()
    turn, shift = Rotation.from_rotvec([0.3, -0.8, 0.4]), np.array([1.0, 2, -3])
    moved = Binding.at_rest(gaussians, particles).moved(turn.apply(particles) + shift)
    np.testing.assert_allclose(moved.means.numpy(), turn.apply(gaussians.means.numpy()) + shift, atol=1e-9)
    np.testing.assert_allclose(moved.scales.numpy(), 0.02, rtol=1e-6)
    at_rest = Binding.at_rest(gaussians, particles).moved(particles)
    np.testing.assert_allclose(at_rest.means.numpy(), gaussians.means.numpy(), atol=1e-12)


def test_gaussians_grow_with_the_body():
    particles = np.random.default_rng(1).random((2000, 3))
    moved = Binding.at_rest(cloud(), particles).moved(1.5 * particles)
    assert 1.3 < float(moved.scales.mean()) / 0.02 <= 1.5


def test_too_few_particles_are_refused():
    with pytest.raises(InputError, match="at least 4"):
        Binding.at_rest(cloud(), np.zeros((3, 3)))


def test_backdrop_has_its_horizon_where_the_camera_looks_level():
    picture = backdrop(camera(), UP, Ground(UP, 0.0), 0.5).astype(int)
    assert picture.shape == (48, 64, 3)
    assert len(np.unique(picture[40:].reshape(-1, 3), axis=0)) > 1  # squares near by
    assert (np.ptp(picture[:23], axis=1) <= 3).all()  # sky above, without squares
    assert (np.ptp(backdrop(camera(), UP, None, 0.5)[30:].astype(int), axis=(0, 1)) <= 1).all()


def test_draw_puts_a_gaussian_where_the_camera_projects_it(taichi):
    point = torch.tensor([[0.3, 1.2, 0.0]])
    one = Gaussians(point, torch.tensor([0.1]), torch.tensor([0.95]), torch.tensor([[1.0, 0.0, 0.0]]))
    picture, alpha = draw(one, camera(), np.full((48, 64, 3), 200, np.uint8))
    pixel, _ = camera().project(point.numpy().astype(float))
    row, column = np.unravel_index(alpha.argmax(), alpha.shape)
    np.testing.assert_allclose([column + 0.5, row + 0.5], pixel[0], atol=1)
    assert picture[row, column, 0] > 230
    assert picture[row, column, 1] < 40
    np.testing.assert_array_equal(picture[0, 0], 200)


def test_log_gives_back_the_reported_numbers(tmp_path):
    report = history.logged(lambda *a: None, tmp_path / "log.csv")
    for k in range(1, 6):
        report("fit", k, 5, f"loss {1 / k:.3f} mm over {k} frames")
    report("fit", 5, 5, "loss 9.5 mm over 9 frames")  # a resumed run repeats
    for k, word in enumerate(("jelly", "sand", "water")):
        report("choice", k, 3, f"{word} {k} mm")
    found = history.curves(tmp_path / "log.csv")["fit"]
    assert found.iterations == [1, 2, 3, 4, 5]
    assert found.values == [1, 0.5, 0.333, 0.25, 9.5]
    assert found.label == "loss mm"
    assert found.frames == [1, 2, 3, 4, 9]
    assert "choice" not in history.curves(tmp_path / "log.csv")


def test_convergence_is_apart_for_each_number_of_frames(tmp_path):
    """The error jumps where frames are added: no line joins the two sides, and a band gives their number."""
    report = history.logged(lambda *a: None, tmp_path / "log.csv")
    for k, (value, frames) in enumerate(((4, 5), (3, 5), (7, 6), (6, 6)), start=1):
        report("identify: fit", k, 4, f"{value} mm over {frames} frames")
    for k in (1, 2, 3):
        report("reconstruct", k, 3, f"loss {1 / k}, 12 frames")
    found = history.curves(tmp_path / "log.csv")
    chart = convergence("identify: fit", found["identify: fit"]).data()
    assert [line["x"] for line in chart["lines"]] == [[1, 2], [3, 4]]
    assert [(band["name"], band["from"], band["to"]) for band in chart["bands"]] == [("5", 0.5, 2.5), ("6", 2.5, 4.5)]
    assert chart["y"] == "distance [mm]"
    assert "no divergence" in convergence("identify: fit", found["identify: fit"]).note
    assert convergence("reconstruct", found["reconstruct"]).note == ""  # always as many frames


def test_page_is_self_contained_and_escapes(tmp_path):
    page = Page("a <twin>")
    page.table(["x"], [[1.23456], [None], ["<b>"], [[0.5, 2]]])
    page.charts([over_time({"a": ([0, 1], [1.0, None])}, "t </script>", "mm")])
    page.write(tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    assert "a &lt;twin&gt;" in text
    assert "1.235" in text
    assert "(0.5, 2)" in text
    assert "<b>" not in text
    scripts = text[text.index('<script type="application/json"') :]
    assert "http" not in text.replace(packed_script(), "")
    assert scripts.count("</script>") == 3  # data, library, report.js: none ends early
    assert number(float("inf")) == "∞"


def test_video_and_picture_are_written_whole(tmp_path):
    frames = [np.full((33, 47, 3), 40 * k, np.uint8) for k in range(4)]
    write_video(tmp_path / "a" / "v.mp4", frames, 24)
    write_png(tmp_path / "b" / "p.png", frames[1])
    import imageio_ffmpeg

    reader = imageio_ffmpeg.read_frames(str(tmp_path / "a" / "v.mp4"))
    assert next(reader)["size"] == (48, 34)
    shown = np.stack([np.frombuffer(data, np.uint8).reshape(34, 48, 3) for data in reader])
    np.testing.assert_allclose(shown.mean(axis=(1, 2, 3)), [0, 40, 80, 120], atol=4)
    assert sorted(p.name for p in tmp_path.rglob("*.*")) == ["p.png", "v.mp4"]


def test_of_a_large_recording_as_many_pictures_are_measured_as_a_mean_needs(taichi, monkeypatch):
    monkeypatch.setattr(pictures, "MAX_PICTURES", 6)
    loaded = []

    def load(view, frame):
        loaded.append((view, frame))
        return Frame(np.zeros((48, 64, 3), np.uint8), np.ones((48, 64)), np.ones((48, 64), bool))

    cameras = (camera(), camera())
    scene = Scene(
        path=Path("drawn"), layout="none", fps=10.0, frame_count=9, cameras=cameras, gravity=np.zeros(3),
        up=np.array([0.0, 1.0, 0.0]), ground=None, density=1.0, load=load, mask_source="none",
    )  # fmt: skip
    points = cloud()
    drawn = Gaussians(points.means.float(), points.scales.float(), points.opacities, points.colours)
    scores = pictures.score_pictures(scene, {"one": lambda _: drawn, "same": lambda _: drawn}, list(range(9)))
    assert scores["one"].by_picture == scores["same"].by_picture
    numbers = scores["one"].mean([0, 1], list(range(9)))
    assert numbers is not None
    assert numbers["frames"] == [0, 4, 8]
    assert len(numbers["psnr_box_db_by_frame"]) == 3
    assert sorted(loaded) == [(v, f) for v in (0, 1) for f in (0, 4, 8)]  # once for both
    alone = scores["one"].mean([1], [4])
    assert alone is not None
    assert (alone["views"], alone["frames"]) == ([1], [4])
    assert alone["psnr_db"] == scores["one"].by_picture[1, 4]["psnr_db"]
    assert scores["one"].mean([], [4]) is None


@settings(max_examples=50, deadline=None)
@given(numbers=st.lists(st.integers(0, 12), min_size=8, max_size=8))
def test_of_a_picture_with_a_small_object_only_that_is_kept(numbers):
    pairs = [slice(*sorted(numbers[k : k + 2])) for k in range(0, 8, 2)]
    lit, box = pairs[:2], pairs[2:]
    picture = np.zeros((12, 12, 3), np.uint8)
    picture[lit[0], lit[1]] = np.arange(1, 145, dtype=np.uint8).reshape(12, 12, 1)[lit[0], lit[1]]
    cut = Cut.of(picture)
    np.testing.assert_array_equal(cut.within((box[0], box[1])), picture[box[0], box[1]])
    assert cut.content.size == picture[lit[0], lit[1]].size


def test_truth_and_motion_numbers(tmp_path):
    points = np.random.default_rng(0).random((400, 3))
    truth = points + np.arange(3)[:, None, None] * np.array([0.1, 0, 0])
    for frame, positions in enumerate(truth):
        np.save(tmp_path / f"particles_{frame}.npy", positions)
    read = measure.read_truth(tmp_path, 9)
    np.testing.assert_array_equal(read, truth)
    late = truth.copy()
    late[2] += [0, 0.005, 0]
    numbers = measure.motion_numbers(late, read, [1, 2])
    assert numbers["tracked_error_mm"] == pytest.approx(2.5, abs=1e-3)
    assert measure.motion_numbers(truth, read, [0, 1, 2])["chamfer_1e3mm2"] == 0
    assert measure.motion_numbers(truth, read, [3]) is None
    np.save(tmp_path / "particles_1.npy", points[:5])
    with pytest.raises(InputError, match="same particles"):
        measure.read_truth(tmp_path, 9)
    with pytest.raises(InputError, match="particles_0"):
        measure.read_truth(tmp_path / "none", 9)


def test_initial_motion_of_a_thrown_spinning_body():
    from masiv.metrics import rigid_ballistic

    points = np.random.default_rng(2).random((200, 3))
    times, gravity = np.arange(4) / 24, np.array([0, -9.8, 0])
    velocity, omega = np.array([0.5, 1, -2]), np.array([1.0, 3, -2])
    motion = rigid_ballistic(points, velocity, omega, points.mean(0), gravity, times)
    found_velocity, found_omega = measure.initial_motion(motion, times, gravity)
    np.testing.assert_allclose(found_velocity, velocity, atol=1e-9)
    np.testing.assert_allclose(found_omega, omega, atol=1e-9)


def test_agreement_is_a_root_mean_square_without_frame_0():
    motion = np.zeros((3, 10, 3))
    other = motion.copy()
    other[1, :, 0], other[2, :, 1] = 0.003, 0.004
    block = measure.agreement(other, motion)
    assert block["trajectory_rmse_mm"] == pytest.approx(np.sqrt(12.5))
    assert block["frames"] == [1, 2]


def test_table_has_a_row_a_block():
    numbers = {
        "schema": 1,
        "units": {"psnr_db": "dB"},
        "reconstruction": {
            "training_views": {"frames": [0, 1, 2, 5], "views": [0], "psnr_db": 20.0},
            "held_out_views": None,
        },
        "fit": {"frames": [1, 2], "trajectory_rmse_mm": 3.0},
        "twin": {"frames": list(range(0, 120, 6)), "views": [0, 1], "psnr_db": 10.0},
    }
    header, body = rows(numbers)
    assert header == ["what", "frames", "views", "PSNR [dB]", "to trajectory [mm]"]
    assert body[0] == ["reconstruction, training views", "0–2, 5", "0", 20.0, None]
    assert body[1][0] == "fit"
    assert body[2][:3] == ["twin", "20 of 0–114", "0–1"]
    assert "20" in table(numbers)
