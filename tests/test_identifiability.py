"""Whether a recording will tell stiffness, viscosity, drag, friction and restitution: motions with a known answer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dropped_balls import Ball, write_scene

from masiv.identifiability.answers import identifiability
from masiv.identifiability.drag import rate_sensitivity
from masiv.identifiability.from_scene import scene_motion
from masiv.identifiability.from_tracks import track_motion
from masiv.identifiability.motion import ObservedMotion, noise_std
from masiv.scene.cloud import Cloud
from masiv.scene.scene import Ground, Scene
from masiv.tracks.read import read_tracks
from masiv.tracks.tracks import Run, TrackedBody, Tracks

UP = np.array([0.0, 1.0, 0.0])
G = -9.8 * UP
FPS, HIT = 60.0, 0.3


def fallen(frames=40, *, sideways=1.0, slides=True, deformation=0.0, back=True, rest_height=0.0, size=0.3):
    """A body that hits the ground after 0.3 s and stays there, or slides on; it is flattened by ``deformation`` [m] and
    springs back in 0.2 s, or not."""
    t = np.arange(frames) / FPS
    height = np.maximum(0.5 * 9.8 * (HIT**2 - t**2), 0.0) + rest_height
    along = sideways * np.where(t < HIT, t, HIT + (t - HIT) * (1 if slides else 0))
    since = np.maximum(t - HIT, 0)
    pressed = np.where(since < 0.1, since / 0.1, np.where(back, np.maximum(1 - (since - 0.1) / 0.1, 0), 1.0))
    return ObservedMotion(
        name="one", times=t, centre=np.stack([along, height + 0.5 * size, 0 * t], axis=1), centre_std=1e-3,
        shape=size - deformation * pressed[:, None], shape_std=1e-3, lowest=height, height_std=1e-3, size=size,
        mass=10.0, gravity=G, normal=UP,
    )  # fmt: skip


def verdicts(motion):
    return {answer.quantity: answer.verdict for answer in identifiability(motion).answers}


def answer(motion, name):
    return next(a for a in identifiability(motion).answers if a.quantity == name)


def test_a_body_that_flies_only_tells_nothing_of_its_material():
    motion = fallen(frames=15)
    said = verdicts(motion)
    assert [said[k] for k in ("stiffness", "viscosity", "friction", "restitution")] == ["no"] * 4
    assert "hitting the ground" in answer(motion, "stiffness").film
    assert answer(motion, "friction").signal_mm is None


def test_what_springs_back_tells_its_stiffness_and_what_stays_flat_does_not_for_sure():
    assert verdicts(fallen(deformation=0.03))["stiffness"] == "yes"
    assert verdicts(fallen(deformation=0.03))["viscosity"] == "yes"
    flowed = answer(fallen(deformation=0.03, back=False), "stiffness")
    assert flowed.verdict == "doubtful"
    assert "does not spring back" in flowed.because
    assert verdicts(fallen(deformation=0.001))["stiffness"] == "no"
    ends = answer(fallen(frames=24, deformation=0.03), "stiffness")
    assert ends.verdict == "doubtful"
    assert "the recording ends" in ends.because
    assert "0.3 s" in ends.film


def test_the_numbers_are_those_of_the_motion():
    found = answer(fallen(deformation=0.03), "stiffness")
    assert found.signal_mm == pytest.approx((1 - 2**-0.5) * 30, rel=0.02)
    assert 0.1 < found.noise_mm < 1.0
    assert "30 mm" in found.because


def test_friction_needs_sliding():
    assert verdicts(fallen(sideways=1.0))["friction"] == "yes"
    sticks = answer(fallen(sideways=1.0, slides=False), "friction")
    assert sticks.verdict == "doubtful"
    assert "stops at once" in sticks.because
    assert verdicts(fallen(sideways=0.0))["friction"] == "no"


def test_restitution_needs_frames_after_a_hard_hit():
    assert verdicts(fallen())["restitution"] == "yes"
    assert verdicts(fallen(frames=20))["restitution"] != "yes"
    assert verdicts(fallen(deformation=0.03))["restitution"] == "doubtful"  # the material's rebound


def test_without_a_ground_it_is_said_what_to_declare():
    import dataclasses

    motion = dataclasses.replace(fallen(), lowest=None)
    assert "scene.yaml: ground" in answer(motion, "friction").because


def test_the_least_drag_that_shows_is_the_error_of_its_fit():
    """1000 flights with noise; position, velocity and drag rate are fitted by least squares on the exact solution,
    linearised at a small rate. The standard deviation of the rates is the Cramér–Rao bound that inspect uses."""
    t = np.linspace(0, 1.2, 30)
    velocity, noise = np.array([2.0, 3.0, -1.0]), 2e-3

    def flight(k):
        gone = -np.expm1(-k * t)[:, None] / k
        return gone * (velocity - G / k) + G / k * t[:, None]

    path = flight(1e-6)
    by_rate = (flight(1e-3) - path) / (1e-3 - 1e-6)
    basis = np.zeros((3 * len(t), 7))
    for axis in range(3):
        basis[axis::3, 2 * axis], basis[axis::3, 2 * axis + 1] = 1, t
    basis[:, 6] = by_rate.ravel()
    rates = np.linalg.lstsq(basis, noise * np.random.default_rng(0).normal(size=(3 * len(t), 1000)), rcond=None)[0][6]
    bound = noise / np.sqrt((rate_sensitivity(t, path) ** 2).sum())
    assert rates.std() == pytest.approx(bound, rel=0.1)


def test_a_light_ball_in_a_long_fall_tells_its_drag_and_a_heavy_one_does_not(tmp_path):
    balls = {"light": Ball(0.057, 0.065, 0.5), "heavy": Ball(50.0, 0.065, 0.5)}
    write_scene(tmp_path, balls)
    tracks = read_tracks(tmp_path)
    found = {run.body: answer(track_motion(tracks, run), "drag") for run in tracks.chosen("fit")}
    assert found["light"].verdict == "yes"
    assert found["heavy"].verdict != "yes"
    assert found["light"].signal_mm > 100 * found["heavy"].signal_mm
    light = track_motion(tracks, tracks.runs[0])
    assert light.centre_std < 0.02  # of the one axis that was measured: 10 mm
    assert light.centre_std > 0.003
    assert "one marker" in answer(light, "stiffness").because


def test_pictures_and_markers_give_the_same_answers():
    """The same cloud of points: as a recording of point clouds, and as markers."""
    motion = fallen(deformation=0.1, slides=True)
    unit = np.random.default_rng(0).normal(size=(12, 3))
    unit *= 0.15 / np.linalg.norm(unit, axis=1, keepdims=True)
    pressed = (motion.shape[:, 0] / motion.shape[0, 0])[:, None, None]
    places = motion.centre[:, None] + unit * np.where(UP > 0, pressed, 1.0)
    places[..., 1] += motion.lowest[:, None] - places[..., 1].min(axis=1, keepdims=True)
    places = places + 1e-3 * np.random.default_rng(1).normal(size=places.shape)
    ground = Ground(UP, 0.0)
    scene = Scene(
        Path("clouds"), "test", FPS, len(places), (), G, UP, ground, 1000.0, _no_picture, "none",
        load_cloud=lambda frame: Cloud(places[frame]),
    )  # fmt: skip
    names = tuple(f"m{k}" for k in range(12))
    run = Run(
        "run", "body", "", "fit", names, motion.times, places, FPS, None, places[0], None, None, None
    )  # fmt: skip
    body = TrackedBody("body", "body", None, None, 14.0, None)
    marked = track_motion(Tracks(Path("tracks"), UP, G, ground, {"body": body}, (run,)), run)
    filmed = scene_motion(scene)
    assert verdicts(marked) == verdicts(filmed)
    assert verdicts(marked)["stiffness"] == "yes"
    for one, other in zip(identifiability(marked).answers[:1], identifiability(filmed).answers[:1], strict=True):
        assert 0.3 < one.signal_mm / other.signal_mm < 3


def test_noise_is_told_from_motion_by_third_differences():
    t = np.arange(200) / 50
    path = np.stack([3 * t - 4.9 * t**2, np.sin(2 * t)], axis=1)
    noisy = path + 0.01 * np.random.default_rng(0).normal(size=path.shape)
    assert noise_std(noisy, 1e-6) == pytest.approx(0.01, rel=0.15)
    assert noise_std(path[:, :1], 1e-6) == 1e-6


def _no_picture(view, frame):
    raise AssertionError("a recording of point clouds has no pictures")
