"""Vectors and places of effects along the axes of the world."""

from __future__ import annotations

import numpy as np
import pytest

from masiv.models.base import EffectTerm
from masiv.models.parameters import Parameter
from masiv.refinement.world_vectors import vectors_in_world
from masiv.scene.transforms import SimulationFrame

UP_IS_Z = SimulationFrame(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.array([0.0, -0.4, 0.0]))
"""Of a world whose ground is at z = 0.4 m."""


def term(names, units, bodies=()):
    made = tuple(Parameter(n, 0.0, -1.0, 1.0, 0.1) for n in names)
    return EffectTerm("push", "push", made, (), ((),), dict(zip(names, units, strict=True)), bodies)


def test_a_vector_and_its_errors_turn_with_the_axes():
    names = [f"push.acceleration_{a}" for a in "xyz"]
    values, errors = dict(zip(names, (1.0, 2.0, 3.0), strict=True)), dict(zip(names, (0.1, 0.2, 0.3), strict=True))
    (entry,) = vectors_in_world(term(names, ["m/s^2"] * 3), values, errors, UP_IS_Z).values()
    assert entry["value"] == pytest.approx([1.0, -3.0, 2.0])  # upwards is along z
    assert entry["stderr"] == pytest.approx([0.1, 0.3, 0.2])
    assert entry["unit"] == "m/s^2"


def test_errors_of_any_rotation_are_those_of_independent_components():
    angle = 0.6
    rotation = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    names, spread = [f"push.acceleration_{a}" for a in "xyz"], np.array([0.1, 0.4, 0.2])
    zero = dict.fromkeys(names, 0.0)
    errors = dict(zip(names, spread.tolist(), strict=True))
    entry = vectors_in_world(term(names, ["N"] * 3), zero, errors, SimulationFrame(rotation, np.zeros(3)))
    drawn = np.random.default_rng(0).normal(size=(200_000, 3)) * spread @ rotation
    assert entry["acceleration"]["stderr"] == pytest.approx(drawn.std(0), rel=0.02)


def test_a_place_moves_with_the_origin_and_may_have_no_error():
    names = ["push.strength", "push.x", "push.y", "push.z"]
    values = dict(zip(names, (9.0, 0.1, 0.2, 0.3), strict=True))
    found = vectors_in_world(term(names, ["1", "m", "m", "m"]), values, {"push.x": 0.1}, UP_IS_Z)
    assert list(found) == ["place"]
    assert found["place"]["value"] == pytest.approx([0.1, -0.3, 0.6])
    assert found["place"]["stderr"] is None


def test_a_place_without_a_height_is_a_vertical_axis():
    names = ["push.x", "push.z"]
    found = vectors_in_world(term(names, ["m", "m"]), {"push.x": 0.1, "push.z": 0.3}, {}, UP_IS_Z)
    assert found["place"]["value"] == pytest.approx([0.1, -0.3, 0.4])
    assert found["axis"]["value"] == pytest.approx([0.0, 0.0, 1.0])


def test_an_inclination_is_given_as_a_direction_too():
    """The normal leans from upwards by 30 degrees, towards the first axis of the simulation."""
    names = ["push.inclination_x", "push.inclination_z"]
    values = dict(zip(names, (np.pi / 6, 0.0), strict=True))
    found = vectors_in_world(term(names, ["rad"] * 2), values, dict.fromkeys(names, 0.1), UP_IS_Z)
    assert found["inclination"]["value"] == pytest.approx([np.pi / 6, 0.0, 0.0])
    assert found["direction"]["value"] == pytest.approx([0.5, 0.0, np.sqrt(0.75)])
    assert found["direction"]["unit"] == "1"


def test_each_body_has_its_own_and_a_plain_strength_has_none():
    names = [f"push.acceleration_{a} of {body}" for body in ("light", "heavy") for a in "xyz"]
    values = {n: float(k) for k, n in enumerate(names)}
    found = vectors_in_world(term(names, ["m/s^2"] * 6, ("light", "heavy")), values, {}, UP_IS_Z)
    assert {n: q["value"] for n, q in found.items()} == {
        "acceleration of light": pytest.approx([0.0, -2.0, 1.0]),
        "acceleration of heavy": pytest.approx([3.0, -5.0, 4.0]),
    }
    assert vectors_in_world(term(["push.rate"], ["1/s"]), {"push.rate": 1.0}, {}, UP_IS_Z) == {}
