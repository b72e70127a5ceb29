"""report.html of pictures, point clouds and tracks: complete in one small file, and alive in a browser."""

from __future__ import annotations

import base64
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import refined_by_hand
import small_run
from browser import watched

from masiv.config import load_config
from masiv.continuum.trajectory import Trajectory
from masiv.files import write_json
from masiv.identification.from_tracks import described_twin
from masiv.observations.read import read_scene
from masiv.pipeline import stages
from masiv.report import camera_view, motion_view
from masiv.report.motion_view import Motion, motion_data
from masiv.report.numbers import run_numbers
from masiv.report.plotly_script import packed_script
from masiv.report.tracks import write_report as write_report_of_tracks
from masiv.report.video import write_report
from masiv.runfolder import RunFolder
from masiv.scene.cloud import Cloud
from masiv.tracks.read import read_tracks
from masiv.twin import Twin

MAX_BYTES = 5_000_000
MATERIAL = {
    "schema": 1, "summary": "An elastic solid.", "behaviour": "an elastic solid", "quantities": {}, "families": [],
    "sensitivities": [], "error_mm": 1.0, "excited": {},
    "curves": {"shear": {"strain": [0, 0.1], "stress_pa": [0, 1e3], "family_pa": [0, 9e2], "observed": [0.0, 0.05]}},
}  # fmt: skip
MOTION = {
    "frames": [0, 1, 2], "chamfer_1e3mm2": 0.2, "tracked_error_mm": 7.25,
    "tracked_error_mm_by_frame": [0.0, 7.0, 14.75],
}  # fmt: skip


def evaluation():
    """evaluate.json."""
    return {
        "schema": 1, "units": {}, "truth": {"folder": "gt", "frames": 3, "particles": 512}, "chamfer_floor_1e3mm2": 0.2,
        "motion": {"trajectory": {"observed": MOTION, "future": None}, "twin": {"observed": MOTION, "future": None}},
    }  # fmt: skip


@pytest.fixture(scope="module")
def run(taichi, tmp_path_factory):
    """A run of pictures of 27 particles, and its scene."""
    folder = tmp_path_factory.mktemp("report")
    scene = read_scene(small_run.write_scene(folder / "scene", frames=small_run.FRAMES))
    run = small_run.write_run(folder / "run")
    write_json(run.path / "material.json", MATERIAL)
    write_json(run.evaluation, evaluation())
    arrays = refined_by_hand.fields(instants=2, fitted=1, particles=27)
    refined_by_hand.write(run.path, refined_by_hand.document(), arrays | {"times@run": np.arange(1, 3) / small_run.FPS})
    run.log.write_text("".join(f"identify: fit,{k},4,{k} mm over {2 + k // 3} frames\n" for k in range(1, 5)))
    return run, scene


def written(run, scene) -> Path:
    """report.html."""
    dynamic, trajectory = stages.load_gaussians(run), Trajectory.load(run.trajectory)
    rollout = trajectory.positions + np.linspace(0, 0.06, small_run.FRAMES)[:, None, None].astype(np.float32)
    numbers = run_numbers(run, scene, dynamic, trajectory, rollout)
    write_report(run, scene, dynamic, trajectory, Twin.load(run.path), rollout, numbers)
    return run.report


@pytest.fixture(scope="module")
def report(run):
    return written(*run)


def data_of(path: Path):
    """What report.js reads."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', path.read_text(), re.S)
    assert found
    return json.loads(found[1])


def opened(page, path: Path):
    page.goto(path.as_uri())
    page.add_style_tag(content=".player { position: static !important }")  # it would cover a part of other pictures
    page.wait_for_selector("body[data-ready=yes][data-shown='0']", timeout=120_000)


def to_frame(page, frame: int):
    page.locator("#time").fill(str(frame))
    page.wait_for_selector(f"body[data-shown='{frame}']", timeout=60_000)


def picture_of(page, selector: str) -> np.ndarray:
    """(H, W, 3), as the browser shows it."""
    shot = page.locator(selector).screenshot()
    return cv2.imdecode(np.frombuffer(shot, np.uint8), cv2.IMREAD_COLOR).astype(int)


# ---- the file ------------------------------------------------------------------------------------------------------


def test_one_small_file_that_needs_no_other(report):
    text = report.read_text(encoding="utf-8")
    assert report.stat().st_size < MAX_BYTES
    assert packed_script() in text
    rest = text.replace(packed_script(), "")
    assert re.findall(r"https?://", rest) == []
    assert [
        source[:5] for source in re.findall(r'(?:src|href)="([^"]*)"', rest) if not source.startswith("data:")
    ] == []


def test_the_largest_page_is_below_the_limit():
    """The library and the most that views may take, with 1.2 MB for everything else."""
    views = 4 / 3 * (motion_view.MAX_BYTES + camera_view.MAX_BYTES)
    assert len(packed_script()) + views + 1_200_000 < MAX_BYTES


def test_the_answer_comes_first_and_settings_last(report):
    text = report.read_text(encoding="utf-8")
    order = ['class="cards"', "Linear drag", 'id="space"', "How the error grows", "Against the true motion",
             "Closing the loop", "Convergence of the fits", "<details>", "seed 0"]  # fmt: skip
    places = [text.index(part) for part in order]
    assert places == sorted(places)
    assert "7.25 mm: mean distance from the true motion" in text[: places[2]]


def test_the_3d_view_has_what_was_observed_and_simulated(report, run):
    motion = data_of(report)["motion"]["motions"]
    assert [m["name"] for m in motion] == ["twin", "best fit without the effect", "the same with the effect"]
    trajectory = Trajectory.load(run[0].trajectory).positions
    twin = motion[0]
    values = np.frombuffer(base64.b64decode(twin["observed"]), "<u2").reshape(3, 27, 3) / 65534
    np.testing.assert_allclose(np.array(twin["low"]) + values * twin["span"], trajectory, atol=2e-5)
    assert twin["meanError"] == pytest.approx([0, 1e3 * 0.03 * 3**0.5, 1e3 * 0.06 * 3**0.5], rel=1e-3)
    without, having = motion[1]["meanError"], motion[2]["meanError"]
    assert having[2] == pytest.approx(0.3 * without[2], rel=1e-3)
    assert twin["parts"] == ["fitted"] * 3


def test_points_that_were_not_seen_stay_unknown():
    times = np.arange(4.0)
    simulated = np.random.default_rng(0).random((4, 5000, 3))
    observed = simulated + np.array([0.003, 0, 0])
    observed[2:] = np.nan
    observed[1, 7] = np.nan
    packed = motion_data([Motion("a", times, simulated, observed, [(2, "fitted")])], np.array([0, 1.0, 0]), None)
    (motion,) = packed["motions"]
    count = motion["points"]
    assert 100 < count <= motion_view.MAX_POINTS
    error = np.frombuffer(base64.b64decode(motion["error"]), "<u2").reshape(4, count)
    np.testing.assert_allclose(error[0] / 65534 * motion["errorScale"], 3.0, rtol=1e-3)
    assert (error[2:] == motion_view.UNKNOWN).all()
    assert motion["meanError"][2:] == [None, None]
    assert motion["parts"] == ["fitted", "fitted", "", ""]
    assert packed["errorTop"] == pytest.approx(3.0)


def test_a_long_motion_is_shown_at_some_instants():
    long = np.zeros((500, 30, 3)) + np.arange(500)[:, None, None]
    packed = motion_data([Motion("a", np.arange(500) / 240, long, long)], np.array([0, 1.0, 0]), None)
    (motion,) = packed["motions"]
    assert motion["frames"][0] == 0
    assert motion["frames"][-1] == 499
    assert len(motion["frames"]) == motion_view.MAX_INSTANTS
    assert len(json.dumps(packed)) < 2 * motion_view.MAX_BYTES


def test_pictures_of_the_cameras_are_those_of_the_scene(report, run):
    """The observed pictures, read back by another decoder, show the square where the scene has it."""
    camera = data_of(report)["cameras"][0]
    assert len(camera["observed"]) == len(camera["twin"]) == 3
    shown = cv2.imdecode(np.frombuffer(base64.b64decode(camera["observed"][0].partition(",")[2]), np.uint8), 1)
    red = shown[..., 2].astype(int) - shown[..., 0]
    assert (red > 100).sum() == pytest.approx(100, abs=25)  # 10 by 10 pixels


def test_point_clouds_have_no_cameras_and_no_pictures(run, tmp_path):
    original, scene = run
    folder = RunFolder.open(shutil.copytree(original.path, tmp_path / "run"))
    points = Trajectory.load(folder.trajectory).positions
    clouds = replace(scene, cameras=(), load_cloud=lambda frame: Cloud(points[frame].astype(np.float64)))
    page = written(folder, clouds)
    data, text = data_of(page), page.read_text(encoding="utf-8")
    assert "cameras" not in data
    assert "Point clouds, 3 frames" in text
    assert "Distance to the point clouds" in text
    assert len(data["motion"]["motions"]) == 3


# ---- in a browser --------------------------------------------------------------------------------------------------


def test_it_draws_without_an_error_or_a_request(browser, report):
    with watched(browser) as seen:
        opened(seen.page, report)
        assert seen.errors == []
        assert seen.requests == []
        charts = seen.page.locator(".chart").count()
        assert charts >= 6
        assert seen.page.locator(".chart .main-svg").count() >= charts
        shown = picture_of(seen.page, "#space")
        coloured = np.ptp(shown, axis=2) > 60  # of the points' scale of colours: paper and grid are grey
        assert coloured.mean() > 0.002
        assert picture_of(seen.page, "#pictures").std() > 5


@pytest.mark.slow
def test_the_slider_moves_every_view(browser, report):
    with watched(browser) as seen:
        opened(seen.page, report)
        places = ("#space", "#pictures", ".chart >> nth=0")
        before = [picture_of(seen.page, place) for place in places]
        to_frame(seen.page, 2)
        after = [picture_of(seen.page, place) for place in places]
        changed = [(np.abs(a - b).max(axis=2) > 30).mean() for a, b in zip(before, after, strict=True)]
        assert min(changed) > 5e-4, changed
        assert "0.083 s" in seen.page.locator("#now").inner_text()
        assert "104 mm" in seen.page.locator("#now").inner_text()  # 60 mm along each axis
        to_frame(seen.page, 0)
        again = picture_of(seen.page, "#pictures")
        assert (np.abs(again - before[1]) > 30).mean() < 1e-3
        assert seen.errors == []


@pytest.mark.slow
def test_controls_change_what_is_shown(browser, report):
    with watched(browser) as seen:
        opened(seen.page, report)
        page = seen.page
        to_frame(page, 2)
        page.locator("#wipe").fill("1000")
        observed = picture_of(page, "#pictures")
        page.locator("#wipe").fill("0")
        assert (np.abs(picture_of(page, "#pictures") - observed).max(axis=2) > 30).mean() > 0.01
        page.select_option("#camera", "1")
        page.get_by_role("button", name="reconstruction").click()
        assert page.locator("#right-name").inner_text() == "reconstruction"
        both = picture_of(page, "#space")
        page.get_by_role("button", name="above").click()
        page.wait_for_timeout(500)
        assert (np.abs(picture_of(page, "#space") - both).max(axis=2) > 30).mean() > 0.005
        mean = page.locator("#now").inner_text()
        page.select_option("#motion", "1")
        page.wait_for_function("before => document.getElementById('now').textContent !== before", arg=mean)
        page.get_by_role("button", name="Play").click()
        page.wait_for_selector("body:not([data-shown='2'])")
        page.get_by_role("button", name="Pause").click()
        assert seen.errors == []


@pytest.mark.slow
def test_it_is_readable_on_a_telephone(browser, report):
    with watched(browser, 400, 800) as seen:
        opened(seen.page, report)
        size = "({page: document.documentElement.scrollWidth, window: innerWidth})"
        assert seen.page.evaluate(size) == {"page": 400, "window": 400}
        boxes = "[...document.querySelectorAll('.chart, #space, img, .card')].map(e => e.getBoundingClientRect().right)"
        assert max(seen.page.evaluate(boxes)) <= 400
        scrolls = "[...document.querySelectorAll('.scroll')].some(e => e.scrollWidth > e.clientWidth)"
        assert seen.page.evaluate(scrolls)  # wide tables, inside their box
        sizes = "[...document.querySelectorAll('.chart text')].map(e => parseFloat(getComputedStyle(e).fontSize))"
        assert min(seen.page.evaluate(sizes)) >= 11


@pytest.mark.slow
def test_tracks_have_the_same_page(browser, tmp_path):
    tracks = read_tracks(Path(__file__).parent / "golden/bar")
    config = load_config("quick")
    times = np.arange(30) / 100
    observed = np.zeros((30, 3, 3)) + np.arange(3)[None, :, None] * 0.05
    observed[:, :, 0] += 0.02 * np.sin(20 * times)[:, None]
    late = observed.copy()
    late[:, :, 0] += 0.01 * times[:, None]
    curves = {"own_a": {"times": times, "observed": observed, "before": late, "after": observed + 1e-4}}
    rows = [{"run": "own_a", "use": "fit", "before_mm": 1.7, "after_mm": 0.173}]
    twin = described_twin(tracks, config.tracks, config.simulator)
    page = tmp_path / "report.html"
    write_report_of_tracks(page, tracks, twin, rows, curves, [refined_by_hand.document(condition="load")])
    text = page.read_text(encoding="utf-8")
    assert page.stat().st_size < MAX_BYTES
    assert "Condition load" in text
    assert text.index('class="cards"') < text.index('id="space"') < text.index("<details>")
    with watched(browser, 400, 800) as seen:
        opened(seen.page, page)
        before = picture_of(seen.page, "#space")
        to_frame(seen.page, 8)
        assert (np.abs(picture_of(seen.page, "#space") - before).max(axis=2) > 30).mean() > 5e-4
        assert seen.page.evaluate("document.documentElement.scrollWidth") == 400
        assert seen.errors == []
        assert seen.requests == []
