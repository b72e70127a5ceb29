"""Refine on simulated throws: the effect that was not declared must be named, measured and confirmed; a control must
come back as nothing missing."""

from __future__ import annotations

import numpy as np
import pytest
from flight import COUNT, FITTED, VELOCITY, observed, scene
from small import SMALL

from masiv.errors import InputError
from masiv.identification.config import IdentifyConfig
from masiv.inference.least_squares import clipped_step
from masiv.models.parameters import Parameter
from masiv.observations.motion import SampledMotion
from masiv.observations.noise_floor import noise_floor
from masiv.refinement.config import RefineConfig
from masiv.refinement.document import document as document_of
from masiv.refinement.from_video import Recording, refine_recordings, split_frames

pytestmark = pytest.mark.usefixtures("taichi")


def found(*motions, **settings):
    config = RefineConfig.model_validate(
        {"particles": COUNT, "laws": ["neo_hookean"], "shortlist": 3, "samples_per_frame": 1, "max_effects": 2}
        | settings
    )
    recordings = [
        Recording(f"run{k}" if k else "run", scene(),
              SampledMotion(m.positions[:FITTED], m.times[:FITTED], m.volume), m, FITTED)
        for k, m in enumerate(motions)
    ]  # fmt: skip
    refined = refine_recordings(recordings, IdentifyConfig.model_validate({"contact": "sticky"}), SMALL, config)
    return refined, document_of(refined)


@pytest.mark.slow
def test_undeclared_drag_is_named_measured_and_confirmed():
    refined, document = found(observed({"linear_drag": [1.0]}))
    assert document["verdict"] == "effect added"
    assert [a["effect"] for a in document["accepted"]] == ["linear_drag"]
    assert document["accepted"][0]["theta"]["rate"] == pytest.approx(1.0, rel=0.1)
    before, after = (document[k]["validation"]["trajectory_rmse_mm"] for k in ("before", "after"))
    assert after < before / 3
    assert document["after"]["test"]["trajectory_rmse_mm"] < document["before"]["test"]["trajectory_rmse_mm"] / 3
    assert document["candidates"][0]["explained"] > 0.5
    assert refined.after.values["velocity_x@run"] == pytest.approx(VELOCITY[0], abs=0.05)


@pytest.mark.slow
def test_two_recordings_share_law_and_effect_and_keep_their_own_initial_state():
    other = observed({"body_force": [0.0, 0.0, 2.0]}, velocity=(-0.5, 1.0, 1.0), omega=(0.0, -2.0, 1.0))
    refined, document = found(
        observed({"body_force": [0.0, 0.0, 2.0]}),
        other,
        effects=["body_force", "linear_drag"],
        max_effects=1,
        baseline_rollouts=24,
    )
    assert [a["effect"] for a in document["accepted"]] == ["body_force"]
    assert list(document["accepted"][0]["theta"].values()) == pytest.approx([0, 0, 2], abs=0.1)
    values = refined.after.values
    assert values["velocity_x@run"] == pytest.approx(VELOCITY[0], abs=0.05)
    assert values["velocity_x@run1"] == pytest.approx(-0.5, abs=0.05)
    assert len(refined.after.fields) == 2
    with pytest.raises(InputError, match="unknown effect 'ether'"):
        found(other, effects=["ether"])


@pytest.mark.slow
def test_a_second_effect_is_seen_in_addition_to_one_that_took_it_over():
    pair = {"body_force": [1.5, 0.0, -1.0], "linear_drag": [0.7]}
    _, document = found(
        observed(pair, noise_m=3e-3), effects=["body_force", "linear_drag"], shortlist=2, baseline_rollouts=24
    )
    values = {a["effect"]: list(a["theta"].values()) for a in document["accepted"]}
    assert values.keys() == pair.keys()
    for name, true in pair.items():
        assert values[name] == pytest.approx(true, abs=0.05)
    assert [[r["effect"] for r in done["refits"] if r["accepted"]] for done in document["rounds"]] == [
        ["body_force"], ["linear_drag"]
    ]  # fmt: skip


@pytest.mark.slow
def test_nothing_is_missing_where_nothing_is():
    _, document = found(observed({}))
    assert document["verdict"] == "nothing missing"
    assert document["accepted"] == []
    assert document["before"] == document["after"]


def test_noise_of_a_rigid_flight_is_found_whatever_the_flight():
    random = np.random.default_rng(1)
    body = random.uniform(-0.2, 0.2, (400, 3))
    path = []
    for k in range(8):
        c, s = np.cos(0.3 * k), np.sin(0.3 * k)
        turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        path.append(body @ turn.T + [0.1 * k**1.5, -0.02 * k**2, 0.3 * np.sin(k)])
    noisy = np.array(path)
    noisy[1:] += random.normal(0, 2e-3, noisy[1:].shape)
    assert noise_floor(noisy, 7) == pytest.approx(2e-3 * np.sqrt(6), rel=0.05)


def test_held_out_frames_are_the_runs_own_or_the_last_quarter():
    assert split_frames(16, 12) == 12
    assert split_frames(16, 16) == 12
    assert split_frames(5, 5) == 4


def test_steps_stay_within_bounds_and_keep_what_is_not_fitted():
    rate = Parameter("linear_drag.rate", 0.1, 0.0, 20.0, 0.05)
    out = clipped_step([rate], {"linear_drag.rate": 0.1, "velocity_x@run": 2.0}, np.array([-5.0]))
    assert out == {"linear_drag.rate": 0.0, "velocity_x@run": 2.0}
