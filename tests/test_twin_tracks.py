"""The twin of a scene of tracks: what the scene says of it, and simulations that need no scene any more."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from masiv.effects.catalogue import effect_named
from masiv.errors import InputError
from masiv.materials.classical import ClassicalLaw
from masiv.models.marked_body import marked_body
from masiv.mpm.config import SimulatorConfig
from masiv.simulation.force import ForcePulse
from masiv.simulation.simulate import simulate
from masiv.tracks.config import TracksConfig
from masiv.tracks.read import read_tracks
from masiv.twin import Twin, TwinEffect
from masiv.twin.from_tracks import particle_spacing, twin_of_tracks

pytestmark = pytest.mark.usefixtures("taichi")
SCENES = Path(__file__).parent / "golden"
SIMULATOR = SimulatorConfig(courant_number=0.6, max_substeps_per_frame=4000)
CONFIG = TracksConfig(particles=64, duration=0.22, rollouts=12)
FRAMES = 12


@pytest.fixture(scope="module")
def bar():
    return read_tracks(SCENES / "bar")


@pytest.fixture(scope="module")
def held(bar):
    """The clamped bar with a law, damping everywhere and a mass under load."""
    law = ClassicalLaw("neo_hookean", youngs_modulus=2e5, poissons_ratio=0.2)
    effects = (
        TwinEffect("viscosity", {"viscosity": 150.0}),
        TwinEffect("point_mass", {"mass": 0.04, "x": 0.0, "y": 0.0, "z": 0.09}, condition="load"),
    )
    twin = twin_of_tracks(bar, CONFIG, SIMULATOR, rigid=False)
    return replace(twin.with_body(law=law), effects=effects)


@pytest.fixture(scope="module")
def balls():
    return twin_of_tracks(read_tracks(SCENES / "balls"), CONFIG, SIMULATOR, rigid=True)


def test_what_a_scene_says_of_a_clamped_body(bar, held):
    body = held.body
    assert (body.name, body.geometry, body.density) == ("bar", "box", 1070.0)
    assert body.volume == pytest.approx(9e-5)
    assert body.particles is not None
    assert body.particles.dtype == np.float64
    assert [clamp.markers for clamp in body.clamps] == [("base",)]
    assert [(s.observation, s.condition) for s in held.initial_conditions] == [("own_a", ""), ("load_a", "load")]
    release = held.initial_conditions[0].release
    assert release is not None
    assert list(release.markers) == ["a", "b", "c"]  # not the one that is fixed to the clamp
    run = next(r for r in bar.runs if r.name == "own_a")
    fastest = np.linalg.norm(np.diff(run.moving().positions[:, :3], axis=0), axis=2).max() * run.rate
    assert release.max_speed == pytest.approx(fastest, rel=1e-3)


@pytest.mark.parametrize("condition", [None, "load"])
def test_a_release_moves_as_in_the_fit(bar, held, condition):
    """Equal in every bit to a simulation of the run, with the effects of its condition."""
    name = "load_a" if condition else "own_a"
    run = next(r for r in bar.runs if r.name == name)
    start = held.in_condition(condition).initial_conditions[0]
    body = marked_body(
        bar, run, SIMULATOR, particle_spacing=particle_spacing(9e-5, CONFIG), speed=start.release.max_speed
    )
    members = [
        (effect_named(e.name), torch.tensor(list(e.values.values()))) for e in held.in_condition(condition).effects
    ]
    times = np.arange(FRAMES) / run.rate
    acting = body.effects(members, body.context(float(times[-1]), 1 / run.rate))
    expected = body.markers_to_world(body.run(held.law, times, acting)[1])
    rollout = simulate(held, frames=FRAMES, condition=condition)
    np.testing.assert_array_equal(rollout.markers, expected)
    assert rollout.marker_names == ("a", "b", "c")
    assert rollout.positions.shape == (FRAMES, len(held.body.particles), 3)
    np.testing.assert_array_equal(rollout.times, times)
    assert np.abs(expected[-1] - expected[0]).max() > 1e-3


def test_a_twin_of_a_scene_needs_no_scene(held, balls, tmp_path):
    for name, twin in (("held", held), ("balls", balls)):
        twin.save(tmp_path / name)
        again = Twin.load(tmp_path / name)
        one, other = (simulate(t, frames=5) for t in (twin, again))
        np.testing.assert_array_equal(one.markers, other.markers)
        np.testing.assert_array_equal(one.positions, other.positions)


def test_a_flight_is_a_parabola(balls):
    """Without effects: x = x0 + v0 t + g t²/2, for every body, for another gravity and another velocity."""
    gravity, velocity = np.array([0.3, -1.6, 0.0]), np.array([1.0, 2.0, -0.5])
    rollout = simulate(balls, frames=FRAMES, fps=30.0, gravity=gravity, velocity=velocity)
    t = np.arange(FRAMES)[:, None, None] / 30.0
    start = np.array([s.placement.translation for s in balls.initial_conditions])
    np.testing.assert_allclose(rollout.markers, start + velocity * t + 0.5 * gravity * t**2, atol=1e-9)
    assert rollout.marker_names == tuple(body.name for body in balls.bodies)
    np.testing.assert_array_equal(rollout.positions, rollout.markers.astype(np.float32))


def test_an_effect_acts_on_its_bodies_alone(balls):
    """Quadratic drag on one ball: it falls at its terminal velocity in the end, and the others as before."""
    light = balls.bodies[-1]
    coefficient = 0.5
    drag = TwinEffect("quadratic_drag", {"drag_coefficient": coefficient}, bodies=(light.name,))
    slowed, free = (simulate(t, frames=90, fps=15.0) for t in (replace(balls, effects=(drag,)), balls))
    np.testing.assert_array_equal(slowed.markers[:, :-1], free.markers[:, :-1])
    rate = light.drag.medium_density * np.pi * light.drag.diameter**2 * coefficient / (8 * light.drag.mass)
    final = np.diff(slowed.markers[-2:, -1, 1])[0] * 15.0
    assert final == pytest.approx(-np.sqrt(np.linalg.norm(balls.gravity) / rate), rel=1e-3)
    bare = simulate(replace(balls, effects=(drag,)), frames=90, fps=15.0, without=("quadratic_drag",))
    np.testing.assert_array_equal(bare.markers, free.markers)


@pytest.mark.parametrize(
    ("which", "changes", "message"),
    [
        ("held", {"velocity": np.ones(3)}, "--velocity: the body is let go from rest"),
        ("held", {"force": ForcePulse(np.ones(3))}, "--force: the body is let go from rest"),
        ("held", {"condition": "wind"}, "no initial condition under 'wind': its conditions are '', 'load'"),
        ("held", {"frames": 1}, "--frames 1: give at least 2"),
        ("balls", {"omega": np.ones(3)}, "--omega: a rigid body is a point"),
        ("balls", {"without": ("swirl",)}, "--without swirl"),
        ("balls", {"gravity": np.ones(2)}, "--gravity takes three finite numbers"),
    ],
)
def test_what_a_body_cannot_have_is_refused(which, changes, message, request):
    with pytest.raises(InputError, match=message):
        simulate(request.getfixturevalue(which), **{"frames": 5, **changes})


def test_an_effect_that_no_point_has_is_refused(balls):
    with pytest.raises(InputError, match="viscosity does not act on a rigid body"):
        simulate(replace(balls, effects=(TwinEffect("viscosity", {"viscosity": 3.0}),)), frames=3)


def test_drag_of_a_medium_needs_a_body_whose_size_is_known(balls):
    drag = TwinEffect("quadratic_drag", {"drag_coefficient": 0.5})
    unknown = replace(balls, bodies=tuple(replace(b, drag=None) for b in balls.bodies), effects=(drag,))
    with pytest.raises(InputError, match=r"needs a place .* and a diameter"):
        simulate(unknown, frames=3)
