"""A force that carries the weight of a body raises the question what holds it."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import calibration_draws as draws

from masiv.identification.flights import fit_flights
from masiv.models.point_mass import PointMassModel
from masiv.observations.tracks import flight_noise
from masiv.refinement.config import RefineConfig
from masiv.refinement.document import document
from masiv.refinement.document_text import text
from masiv.refinement.search_state import SearchSettings
from masiv.refinement.stage import refine
from masiv.refinement.support import carried_weight, carried_weight_stderr, question

GRAVITY = np.array([0.0, -9.8, 0.0])


def test_the_part_of_the_weight_that_a_force_carries():
    push = {"acceleration_x": 3.0, "acceleration_y": 7.35, "acceleration_z": 0.0}
    assert carried_weight("body_force", push, GRAVITY) == pytest.approx(0.75)
    assert carried_weight("body_force", {**push, "acceleration_y": 2.0}, GRAVITY) is None  # wind
    assert carried_weight("body_force", {**push, "acceleration_y": -9.0}, GRAVITY) is None  # more weight
    assert carried_weight("gravity_scale", {"relative_change": -0.98}, GRAVITY) == pytest.approx(0.98)
    assert carried_weight("gravity_scale", {"relative_change": 0.9}, GRAVITY) is None
    assert carried_weight("linear_drag", {"rate": 9.8}, GRAVITY) is None
    assert carried_weight("body_force", push, None) is None
    assert carried_weight("body_force", push, np.zeros(3)) is None


def test_a_force_that_cancels_gravity_within_its_error_says_that_the_body_is_held():
    errors = {"acceleration_x": 0.1, "acceleration_y": 0.196, "acceleration_z": 0.1}
    known = carried_weight_stderr("body_force", errors, GRAVITY)
    assert known == pytest.approx(0.02)
    assert carried_weight_stderr("gravity_scale", {"relative_change": 0.03}, GRAVITY) == pytest.approx(0.03)
    assert carried_weight_stderr("body_force", {**errors, "acceleration_y": None}, GRAVITY) is None
    assert carried_weight_stderr("linear_drag", {"rate": 0.1}, GRAVITY) is None
    assert "cancels gravity within its error" in question(0.97, known)
    assert "is the body held" in question(0.9, known)
    assert "is the body held" in question(0.97)
    assert "is the body held" in question(0.6, 1.0)  # it may be nothing as well


def test_a_pendulum_that_is_taken_for_a_ball_in_flight_is_said_to_be_held(taichi):
    """A bob on a thread of 1 m, let go at 20 degrees, tracked for a third of its period."""
    tracks, run = draws._ball()
    swing = 0.35 * np.cos(np.sqrt(9.8) * run.times)
    path = np.stack([np.sin(swing), 2 - np.cos(swing), 0 * swing], axis=1)
    values = (path + np.random.default_rng(0).normal(0, 1e-3, path.shape))[:, None]
    noise = flight_noise(run.times, values[:, 0])
    std = np.full(len(values), noise)
    model = PointMassModel(
        tracks, [replace(run, values=values, noise_std=noise, residual_std=std, observation_std=std)]
    )
    settings = SearchSettings.of(RefineConfig(max_effects=1), discrepancy_force=False)
    found = document(refine(model, [fit_flights(model)], settings))
    assert found["accepted"]
    assert 0.8 < found["accepted"][0]["carried_weight"] < 1.1
    assert found["accepted"][0]["carried_weight_stderr"] > 0
    assert "of the weight" in text(found)
