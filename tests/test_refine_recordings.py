"""What refine makes of recordings before it simulates anything, and of rollouts that diverge after."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from masiv.errors import NonFiniteError
from masiv.inference.model_fit import ModelFit
from masiv.models.base import Model
from masiv.models.families import Family
from masiv.refinement.candidates import Candidate, Ranking
from masiv.refinement.experiment_design import INITIAL_STATES, propose
from masiv.refinement.from_video import Recording, split_frames, with_unique_names
from masiv.refinement.hypotheses import Hypothesis, Posterior
from masiv.refinement.rounds import Round, SearchResult, Trial
from masiv.scene.transforms import SimulationFrame

UNUSED: Any = None


def test_recordings_of_one_name_keep_their_own_parameters():
    """Parameters are named after their recording: two folders of one name would share an initial state."""
    names = ["run", "run", "other", "run", "run_2"]
    recordings = [Recording(name, UNUSED, UNUSED, UNUSED, k) for k, name in enumerate(names)]
    unique = with_unique_names(recordings)
    assert [r.name for r in unique] == ["run", "run_2", "other", "run_3", "run_2_2"]
    assert [r.fit_frames for r in unique] == [0, 1, 2, 3, 4]
    assert [r.name for r in recordings] == names


def test_held_out_frames_are_those_of_the_run_or_the_last_quarter():
    assert split_frames(16, 12) == 12
    assert split_frames(16, 16) == 12
    assert split_frames(5, 5) == 4


class Thrown:
    """Two effects that push by as much as the body is fast along x, in opposite ways; ``limit`` [m/s] diverges."""

    def __init__(self, limit):
        self.limit, self.rollouts = limit, 0
        frame = SimulationFrame(np.eye(3), np.zeros(3))
        self.observations = (SimpleNamespace(name="a"),)
        self.setups = (SimpleNamespace(body=SimpleNamespace(axes=frame, frames=4)),)

    def positions(self, model, values, index, frames):
        speed = values.get("velocity_x@a", 0.1)
        if abs(speed) >= self.limit:
            raise NonFiniteError(1, 2, "too fast")
        return torch.full((frames, 5, 3), speed * (1 if model.effects == ("linear_drag",) else -1))


def search_of(forward_model):
    candidate = Candidate("linear_drag", 0.9, {}, {}, np.zeros((0, 0)), np.zeros(0))
    family = Family("rigid", (), {})
    fits = [
        ModelFit(Model(family, "none", (name,)), {}, (), np.zeros(0), np.zeros((0, 0)), 1.0, 9, 1.0, 1.0, None, [], {})
        for name in ("linear_drag", "quadratic_drag")
    ]
    trials = tuple(Trial(candidate, fitted) for fitted in fits)
    hypotheses = [
        Hypothesis(f, UNUSED, SimpleNamespace(log_evidence=float(k), unknown=0.0)) for k, f in enumerate(fits)
    ]
    first = Round(UNUSED, Ranking(), trials, trials[0], Posterior.of(hypotheses, 2))
    return SearchResult(forward_model, trials[0].fitted, trials[0].fitted, (first,))


def quiet(*_):
    """No progress."""


@pytest.mark.parametrize(("limit", "best"), [(9.0, 3.0), (2.5, 2.0)])
def test_initial_states_that_diverge_are_listed_and_not_proposed(limit, best):
    proposal = propose(search_of(Thrown(limit)), quiet)
    assert proposal.distinguishes == ("linear_drag", "quadratic_drag")
    assert abs(proposal.velocity[0]) == best
    assert proposal.difference_mm == pytest.approx(1e3 * 2 * best * 3**0.5, rel=1e-6)
    assert proposal.present_mm == pytest.approx(1e3 * 0.2 * 3**0.5, rel=1e-6)
    expected = [v for v, _ in INITIAL_STATES if abs(v[0]) >= limit]
    assert [tuple(v) for v, _, _ in proposal.not_simulated] == expected
    assert {reason for _, _, reason in proposal.not_simulated} <= {"too fast"}


def test_nothing_is_proposed_if_everything_diverges():
    assert propose(search_of(Thrown(0.0)), quiet) is None
