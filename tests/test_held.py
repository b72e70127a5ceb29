"""A body that something undeclared holds is said to be held, and no other: counted on fresh draws."""

from __future__ import annotations

from dataclasses import replace

import held_draws as draws
import numpy as np
import pytest
import yaml

import masiv
from masiv.identifiability.held import FALSE_ALARM, SLACK, MediumForce, held
from masiv.identifiability.held_tracks import held_in, held_problems
from masiv.pipeline import RefineRequest, inspect_scene

FLIGHTS = 200
LARGEST_NUMBER = 3
"""Of false alarms in 200 draws: with ``FALSE_ALARM`` each, four or more come once in 17000 tests."""


def noisy(random, path):
    return path + random.normal(0, 10 ** random.uniform(-4, -2.3), path.shape)


def sample_times(random):
    return np.arange(random.integers(8, 90)) / random.choice([24.0, 60.0, 120.0])


@pytest.mark.parametrize("known", [True, False])
def test_flights_with_drag_are_free(known):
    """Balls of 3 to 600 g, thrown at some 5 m/s; of unknown mass, no lighter than a sheet of paper."""
    random, alarms = np.random.default_rng(1), 0
    for _ in range(FLIGHTS):
        mass = 10 ** random.uniform(-2.5, -0.2)
        times = sample_times(random)
        path = noisy(random, draws.flight(random, times, draws.drag_rate(mass, 0.065)))
        alarms += held_in(*draws.scene(path, times, mass=mass, known=known)) is not None
    assert alarms <= LARGEST_NUMBER


def test_a_box_that_tumbles_with_all_markers_on_one_face_is_free():
    random, alarms = np.random.default_rng(2), 0
    for _ in range(100):
        times = sample_times(random)
        markers, own = draws.tumbling_box(random, times, (0.1, 0.2, 0.3))
        made = draws.scene(noisy(random, markers), times, mass=3.0, box=(0.1, 0.2, 0.3), own=own)
        alarms += held_in(*made) is not None
    assert alarms <= LARGEST_NUMBER


def test_what_bounces_or_rests_on_the_declared_ground_is_free():
    random, alarms = np.random.default_rng(3), 0
    for k in range(FLIGHTS // 2):
        times = sample_times(random)
        path = draws.bounce(random, times) if k % 2 else np.tile([0, 0, 0.0325], (len(times), 1))
        alarms += held_in(*draws.scene(noisy(random, path), times, ground=0.0)) is not None
    assert alarms <= LARGEST_NUMBER


def test_what_rests_on_no_declared_ground_is_supported():
    random = np.random.default_rng(4)
    times = np.arange(40) / 60
    tracks, run = draws.scene(np.tile([0, 0, 0.0325], (40, 1)) + random.normal(0, 1e-3, (40, 3)), times)
    found = held_in(tracks, run)
    assert found.carried == pytest.approx(1, abs=4 * found.carried_std)
    assert found.pivot is None
    assert (found.start, found.stop) == pytest.approx((0, times[-1]))
    [sentence] = held_problems(tracks)
    assert "held or supported by something that is not declared" in sentence


def test_pendulums_are_held_and_their_threads_are_measured():
    random, errors, missed, pivots = np.random.default_rng(5), [], 0, 0
    for _ in range(100):
        times = np.arange(120) / 60
        length = random.uniform(0.3, 2.0)
        path = draws.pendulum(random, times, length) + random.normal(0, 1e-3, (120, 3))
        found = held_in(*draws.scene(path, times, mass=0.06))
        missed += found is None
        if found is not None and found.pivot is not None:
            pivots += 1
            errors.append((found.pivot.radius - length) / found.pivot.radius_std)
    assert missed == 0
    assert pivots > 80
    assert np.std(errors) == pytest.approx(1, abs=0.25)
    assert abs(np.mean(errors)) < 0.4


def test_a_declared_clamp_holds_what_it_says():
    random = np.random.default_rng(6)
    times = np.arange(120) / 60
    path = draws.pendulum(random, times)
    assert held_in(*draws.scene(path, times)) is not None
    assert held_in(*draws.scene(path, times, clamp=draws.declared_clamp())) is None


def test_the_rate_of_false_alarms_at_the_border_is_what_is_said():
    """Bodies that seem to carry just what a wrong frame rate explains: the worst case of the null hypothesis."""
    random, count, alarms = np.random.default_rng(7), 1000, 0
    times = np.arange(32) / 60
    path = -0.5 * draws.G * (1 - SLACK) * times[:, None] ** 2 * draws.UP
    for _ in range(count):
        points = (path + random.normal(0, 2e-3, path.shape))[:, None]
        found = held(times, points, 2e-3, np.ones(32, bool), -draws.G * draws.UP, MediumForce(0, 0, 0))
        alarms += found is not None
    assert alarms <= count * FALSE_ALARM + 3 * np.sqrt(count * FALSE_ALARM)


def test_a_fall_in_a_thick_medium_is_free():
    """A ball that sinks in oil at its terminal velocity: the medium carries its weight."""
    random = np.random.default_rng(8)
    times = np.arange(60) / 60
    path = np.stack([0 * times, 0 * times, 1 - 0.3 * times], axis=1) + random.normal(0, 1e-3, (60, 3))
    tracks, run = draws.scene(path, times)
    assert held_in(tracks, run) is not None
    oil = replace(tracks, medium_density=900.0, medium_viscosity=1.0)
    assert held_in(oil, run) is None


@pytest.mark.slow
def test_every_command_says_that_a_pendulum_is_held(tmp_path):
    """Tracks of a bob, declared as a ball in flight: a body force is found, and what it means is said."""
    random, times, runs = np.random.default_rng(9), np.arange(60) / 60, []
    for name, amplitude, use in (("one", 0.3, "fit"), ("two", 0.4, "hold_out")):
        path = draws.pendulum(random, times, 1.0, amplitude) + random.normal(0, 1e-3, (60, 3))
        rows = ["t,bob_x_m,bob_y_m,bob_z_m", *(f"{t},{x},{y},{z}" for t, (x, y, z) in zip(times, path, strict=True))]
        (tmp_path / f"{name}.csv").write_text("\n".join(rows))
        runs.append({"file": f"{name}.csv", "use": use})
    ball = {"mass": 0.1, "geometry": {"sphere": 0.05, "units": "m", "markers_at": {"bob": [0, 0, 0]}}}
    (tmp_path / "scene.yaml").write_text(
        yaml.safe_dump({"layout": "tracks", "up_axis": "z", "bodies": {"bob": ball}, "runs": runs})
    )
    said = "it is held or supported by something that is not declared"
    inspected = inspect_scene(tmp_path, tmp_path / "picture.png")
    assert sum(said in problem for problem in inspected.data["problems"]) == 2
    run = masiv.open_run(tmp_path, tmp_path / "run")
    identified = run.identify()
    assert len(identified.data["problems"]) == 2
    assert said in identified.text
    refined = run.refine(RefineRequest(group=True))
    assert said in refined.text
    assert "as on a thread or a pivot" in refined.data["problems"][0]
    assert said in run.folder.report.read_text()
