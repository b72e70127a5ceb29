"""``masiv view``: what is asked of the simulation, what is drawn of it, and the page in a real browser."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
import urllib.request

import numpy as np
import pytest
from browser import watched
from small_run import FPS, UP, write_run

import masiv
from masiv.effects.per_body import DragBody
from masiv.errors import InputError
from masiv.files import write_npz
from masiv.materials.classical import ClassicalLaw
from masiv.pipeline import ViewRequest, reopen_run
from masiv.pipeline.view import observed_markers
from masiv.simulation.particle_fields import ParticleFields
from masiv.simulation.rollout import Rollout
from masiv.tracks.placement import Placement
from masiv.twin import Body, Boundary, InitialCondition, Twin, TwinEffect
from masiv.view.colours import coloured, field_range, legend
from masiv.view.page import free_port, open_page
from masiv.view.shown import LONGEST_ARROW, MAX_PATHS, PLAIN, SIMULATED, STRESS, Shown
from masiv.view.simulations import Simulations
from masiv.view.subject import Subject
from masiv.view.variation import Job, Variation, can_blend

FRAMES, WAIT_S = 4, 120
SPLAT_BOUNDS = "computeBoundingSphere(): Computed radius is NaN"
"""What viser 1.1 says when the pointer moves over any Gaussians: its splats have no box to be hit in."""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("view") / "run"
    write_run(folder)
    return folder


@pytest.fixture(scope="module")
def twin(run):
    return Twin.load(run)


def until(condition, what):
    end = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end, f"{what} did not happen within {WAIT_S} s"
        time.sleep(0.05)


# ---- what is asked of the simulation -------------------------------------------------------------------------------


def test_a_variation_is_the_simulation_with_its_values(taichi, twin):
    found = Job(twin, FRAMES).run(Variation(velocity=(1.0, 0, 0), gravity=(0.0, -1.6, 0)))
    expected = masiv.simulate(twin, frames=FRAMES, velocity=(1, 0, 0), gravity=(0, -1.6, 0))
    np.testing.assert_array_equal(found.positions, expected.positions)
    assert found.fields is not None
    with pytest.raises(InputError, match="no other law"):
        Job(twin, FRAMES).run(Variation(law=1.0))


def test_laws_of_one_kind_have_laws_in_between(twin):
    stiff = twin.with_body(law=ClassicalLaw("neo_hookean", youngs_modulus=4e4, poissons_ratio=0.3))
    fluid = twin.with_body(law=ClassicalLaw("newtonian", viscosity=5.0, bulk_modulus=1e5))
    assert can_blend(twin, stiff)
    assert not can_blend(twin, fluid)


class Heard:
    """What ``Simulations`` says."""

    def __init__(self):
        self.finished: list[tuple[Variation, Rollout]] = []
        self.failed: list[tuple[Variation, str]] = []
        self.progress: list[tuple[int, int]] = []

    def simulations(self, twin, frames=FRAMES):
        return Simulations(
            Job(twin, frames), "cpu",
            progress=lambda done, total: self.progress.append((done, total)),
            finished=lambda variation, rollout: self.finished.append((variation, rollout)),
            failed=lambda variation, sentence: self.failed.append((variation, sentence)),
        )  # fmt: skip


@pytest.mark.slow
def test_the_last_request_wins_and_failures_are_sentences(taichi, twin):
    heard = Heard()
    last = Variation(gravity=(0.0, -3.0, 0))
    with heard.simulations(twin) as simulations:
        for k in range(5):
            simulations.ask(Variation(gravity=(0.0, -4.0 - k, 0)))
        simulations.ask(last)
        until(lambda: heard.finished, "the simulation")
        assert [variation for variation, _ in heard.finished] == [last]
        expected = masiv.simulate(twin, frames=FRAMES, gravity=(0, -3, 0)).positions
        np.testing.assert_array_equal(heard.finished[0][1].positions, expected)
        assert heard.progress[-1] == (FRAMES - 1, FRAMES - 1)
        simulations.ask(Variation(velocity=(9e3, 0.0, 0)))
        until(lambda: heard.failed, "the refusal")
        assert "substeps" in heard.failed[0][1]
        process = simulations._process
        process.kill()
        simulations.ask(Variation())
        until(lambda: len(heard.failed) > 1 or len(heard.finished) > 1, "the end of the process")
        if len(heard.failed) > 1:
            assert "has died" in heard.failed[1][1]
            simulations.ask(Variation())
        until(lambda: len(heard.finished) > 1, "the next simulation")
        process = simulations._process
    assert not process.is_alive()


# ---- what is drawn -------------------------------------------------------------------------------------------------


def motion():
    """Three frames of 50 particles of a bar; stress 0 to 98 Pa, and a wind that grows from frame to frame."""
    start = np.zeros((50, 3), np.float32)
    start[:, 0] = np.arange(50) / 49
    positions = np.stack([start + np.array([0, 0.1 * k, 0]) for k in range(3)]).astype(np.float32)
    stress = np.tile(2.0 * np.arange(50), (3, 1)).astype(np.float32)
    wind = np.zeros((3, 50, 3), np.float32)
    wind[:, :, 2] = np.arange(3)[:, None]
    fields = ParticleFields(stress, stress / 1e4, {"wind": wind})
    return Rollout(positions, np.arange(3) / FPS, fields=fields)


def test_arrows_are_as_long_as_accelerations(twin):
    shown = Shown(Subject("bar", twin, 3), motion())
    assert shown.strongest("wind") == 2.0
    assert len(shown.arrows("wind", 0)) == 0
    for frame, length in ((1, 0.5 * LONGEST_ARROW), (2, LONGEST_ARROW)):
        arrows = shown.arrows("wind", frame)
        np.testing.assert_allclose(arrows[:, 1] - arrows[:, 0], np.tile([0, 0, length], (50, 1)), atol=1e-6)
        np.testing.assert_allclose(arrows[:, 0], shown.positions[frame])


def test_paths_join_the_frames_of_some_particles(twin):
    shown = Shown(Subject("bar", twin, 3), motion())
    assert shown.paths.shape == (2 * MAX_PATHS, 2, 3)
    np.testing.assert_allclose(
        shown.paths[:, 1] - shown.paths[:, 0], np.tile([0, 0.1, 0], (2 * MAX_PATHS, 1)), atol=1e-6
    )
    assert {0.0, 1.0} <= set(shown.paths[:, 0, 0].tolist())


def test_colours_say_the_stress(twin):
    from matplotlib import colormaps

    shown = Shown(Subject("bar", twin, 3), motion())
    colours = shown.colours(STRESS, 1, 50.0)
    np.testing.assert_array_equal(colours[0], colormaps["viridis"](0.0, bytes=True)[:3])
    np.testing.assert_array_equal(colours[10], colormaps["viridis"](20 / 50, bytes=True)[:3])
    np.testing.assert_array_equal(colours[25:], np.tile(colormaps["viridis"](1.0, bytes=True)[:3], (25, 1)))
    np.testing.assert_array_equal(shown.colours(PLAIN, 0, 1.0)[7], SIMULATED)
    assert field_range(np.zeros((2, 3))) == 1.0
    assert 97 <= shown.top(STRESS) <= 98
    text = legend("stress <1>", "Pa", 20000.0, 321456.0)
    assert "stress &lt;1&gt; [Pa]; highest 321,000" in text
    assert re.findall(r"<span>([^<]*)</span>", text) == ["0", "5,000", "10,000", "15,000", "20,000"]
    assert len(coloured(np.array([np.nan, 1.0]), 2.0)) == 2


def test_markers_are_taken_at_the_frames_of_the_twin(twin, tmp_path):
    """Samples at 0, 1 and 3 of 1/24 s: there is none for frame 2. Two axes are not enough to show a marker."""
    times = np.array([0.0, 1, 3]) / FPS
    places = np.arange(18.0).reshape(3, 2, 3)
    name = twin.initial_conditions[0].observation
    write_npz(tmp_path / "rollout.npz", **{f"times@{name}": times, f"observed@{name}": places})
    found = observed_markers(tmp_path / "rollout.npz", twin)
    assert found is not None
    np.testing.assert_array_equal(found[[0, 1, 3]], places)
    assert np.isnan(found[2]).all()
    write_npz(tmp_path / "flat.npz", **{f"times@{name}": times, f"observed@{name}": places[..., :2]})
    assert observed_markers(tmp_path / "flat.npz", twin) is None
    assert observed_markers(tmp_path / "none.npz", twin) is None


# ---- the page ------------------------------------------------------------------------------------------------------


def test_a_run_without_its_scene_is_shown_with_its_refined_cameras(run):
    subject = reopen_run(run).subject(ViewRequest(law=run))
    assert subject.frames == 3
    assert [camera.name for camera in subject.cameras] == ["view 0"]
    assert subject.picture(0, 0) is None
    assert "cameras have no pictures" in subject.notes[0]
    assert subject.observed is not None
    assert subject.observed.shape == (3, 27, 3)
    with pytest.raises(InputError, match="--condition is for scenes of tracks"):
        reopen_run(run).subject(ViewRequest(condition="load"))


@pytest.mark.slow
def test_what_a_point_does_not_have_is_not_on_its_page():
    ball = Body("ball", 1e-4, 500.0, drag=DragBody(0.06, 0.05, 1.2, 1.8e-5))
    start = InitialCondition("drop", "ball", 30.0, np.zeros(3), np.zeros(3), placement=Placement(np.eye(3), 9 * UP))
    drag = TwinEffect("linear_drag", {"rate": 0.5}, {"rate": 0.02})
    flying = Twin((ball,), Boundary(), -9.8 * UP, UP, (start,), masiv.load_config().simulator, (drag,))
    with open_page(Subject("ball", flying, 5), port=8700) as page:
        controls = page.controls
        assert set(controls.vectors) == {"velocity", "gravity"}
        assert controls.field.options == (PLAIN,)
        assert controls.law is None
        assert set(controls.layers) == {"simulated", "paths", "effect linear_drag"}
        until(lambda: page.shown is not None, "the simulation")
        until(lambda: "longest arrow of linear_drag: " in controls.arrows.content, "the arrows")
        fall = 9.8 / 0.5 * (1 - np.exp(-0.5 * 4 / 30))  # speed at the last frame
        assert float(controls.arrows.content.split()[-2]) == pytest.approx(0.5 * fall, rel=1e-2)


def pixels(page):
    """The picture of the page left of the widgets, (H, W, 3) int."""
    import cv2

    picture = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    return picture[:, : picture.shape[1] * 2 // 3, ::-1].astype(int)


def orange(page):
    """Number of pixels with about the hue of ``SIMULATED``."""
    r, g, b = np.moveaxis(pixels(page), -1, 0)
    return int(((r > 150) & (r - g > 60) & (g - b > 30)).sum())


def number_of(page, label):
    """The input of a slider."""
    row = page.get_by_text(label, exact=True).first
    return row.locator("xpath=ancestor::div[.//input[contains(@class, 'NumberInput')]][1]").locator(
        "input[class*='NumberInput']"
    )


def checkbox(page, label):
    """The box of a layer."""
    row = page.get_by_text(label, exact=True).first
    return row.locator("xpath=ancestor::div[.//input[@type='checkbox']][1]").locator("input")


@pytest.mark.slow
def test_the_page_shows_the_motion_and_simulates_it_again(taichi, run, twin, browser):
    subject = reopen_run(run).subject(ViewRequest(frames=FRAMES))
    with open_page(subject, port=8720) as page, watched(browser) as seen:
        address = f"http://127.0.0.1:{page.server.get_port()}"
        seen.page.goto(address)
        seen.page.get_by_text("particles, as identified").wait_for(timeout=1000 * WAIT_S)
        first = page.shown
        assert first is not None
        np.testing.assert_array_equal(first.positions, masiv.simulate(twin, frames=FRAMES).positions)
        # Drawn, and gone without its layers.
        page.controls.field.value = PLAIN
        until(lambda: orange(seen.page) > 5000, "the drawing")
        drawn = orange(seen.page)
        page.controls.layers["paths"].value = False
        checkbox(seen.page, "Simulated").click()
        until(lambda: not page.controls.layers["simulated"].value, "the click")
        until(lambda: orange(seen.page) < drawn / 4, "the drawing without particles")
        checkbox(seen.page, "Simulated").click()
        assert seen.errors == [], "before another gravity"
        # Another gravity, from the slider's own field.
        box = number_of(seen.page, "g y")
        box.fill("-1.62")
        box.press("Enter")
        seen.page.get_by_text("with the values of the sliders").wait_for(timeout=1000 * WAIT_S)
        assert page.controls.variation == Variation(gravity=(0.0, -1.62, 0.0))
        assert page.shown is not None
        np.testing.assert_array_equal(
            page.shown.positions, masiv.simulate(twin, frames=FRAMES, gravity=(0, -1.62, 0)).positions
        )
        assert seen.errors == [], "after another gravity"
        # Time.
        page.controls.play.value = True
        page.step()
        seen.page.get_by_text("frame 1: 0.042 s").wait_for(timeout=1000 * WAIT_S)
        assert seen.errors == [], "after a frame"
        # What diverges is said, and the motion before it stays.
        # The simulation of the widgets must be over before the next request, for the last one wins.
        before = page.shown
        page.controls.vectors["velocity"][0][0].value = 3.0
        until(lambda: page.shown is not before, "the simulation with another velocity")
        page.controls.layers["gaussians"].value = True
        page.simulations.ask(Variation(velocity=(9e3, 0.0, 0.0)))
        seen.page.get_by_text("This cannot be simulated:").wait_for(timeout=1000 * WAIT_S)
        assert [error for error in seen.errors if SPLAT_BOUNDS not in error] == []
        assert seen.requests == []


# ---- the command ---------------------------------------------------------------------------------------------------

COMMAND = (sys.executable, "-m", "masiv.cli.main", "view")


@pytest.mark.slow
def test_the_command_prints_its_address_and_ends_with_ctrl_c(run):
    process = subprocess.Popen(
        [*COMMAND, str(run), "--port", "8740"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    timer = threading.Timer(WAIT_S, process.kill)
    timer.start()
    line = process.stdout.readline()
    found = re.search(r"http://127\.0\.0\.1:\d+", line)
    assert found, line
    with urllib.request.urlopen(found[0], timeout=30) as page:
        assert b"<html" in page.read()
    children = subprocess.run(["pgrep", "-g", str(os.getpgid(process.pid))], capture_output=True, check=False)
    assert str(process.pid) in children.stdout.decode().split()
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=30)
    timer.cancel()
    assert process.returncode == 130
    assert out == ""
    assert err.splitlines() == ["error: interrupted; the same command goes on from the last checkpoint"]
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(found[0], timeout=5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["--host", "192.0.2.1"], "--host 192.0.2.1"),
        pytest.param(["--frames", "1"], "--frames 1: give 2 to", marks=pytest.mark.slow),
        pytest.param(["--law", "nowhere"], "--law nowhere is not a run folder", marks=pytest.mark.slow),
    ],
)
def test_what_cannot_be_shown_is_refused(run, given, message):
    done = subprocess.run([*COMMAND, str(run), *given], capture_output=True, text=True, timeout=WAIT_S, check=False)
    assert done.returncode == 2
    assert message in done.stderr
    assert len(done.stderr.splitlines()) == 1


def test_a_port_in_use_is_passed_over():
    import socket

    with socket.create_server(("127.0.0.1", 8760)):
        assert free_port("127.0.0.1", 8760) > 8760


def test_without_viser_the_command_says_what_to_install(twin, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r"pip install 'masiv\[view\]'"), open_page(Subject("bar", twin, 3)):
        pass
