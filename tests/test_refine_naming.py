"""Which cause is named, and which the motion does not tell from it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from masiv.refine import selection as naming
from masiv.refine.answer import answer
from masiv.refine.config import RefineConfig
from masiv.refine.rounds import Trial

FITTED, ALL, NOISE = 4, 6, 1e-3
WATCHED = [
    SimpleNamespace(noise_std=NOISE, residual_std=np.full(ALL, NOISE), fit_count=FITTED, holds_out=True, time_count=ALL)
]


def trial(effect, fitted, held_out, count=9, passes=True):
    """A refit with these mean squares, in units of the noise, and ``count`` parameters."""
    squares = NOISE**2 * np.repeat([float(fitted), float(held_out)], [FITTED, ALL - FITTED])
    fit = SimpleNamespace(
        squares=[squares], values=dict.fromkeys(range(count)), cost=fitted, samples=100,
        bic=lambda samples: samples * np.log(fitted) + count * np.log(samples),
    )  # fmt: skip
    return Trial(SimpleNamespace(effect=effect), fit, [] if passes else ["it does not"])


@pytest.fixture(autouse=True)
def apart(monkeypatch):
    """Told apart by ten sigmas for each noise of mean square."""
    monkeypatch.setattr(naming, "vuong_z", lambda a, b, _: 10 * (b.cost - a.cost))


def named(*trials):
    first, others = naming.named(trials, WATCHED, RefineConfig())
    return first and first.candidate.effect, others


def test_the_one_that_explains_most_where_the_others_explain_less():
    assert named(trial("drag", 1.0, 5), trial("swirl", 2.0, 1)) == ("drag", [])
    assert named(trial("drag", 1.0, 5, passes=False), trial("swirl", 2.0, 1)) == ("swirl", [])
    assert named(trial("drag", 1.0, 5, passes=False)) == (None, [])
    assert named() == (None, [])


def test_of_causes_that_are_not_told_apart_the_one_that_explains_all_instants_best_and_the_others_beside_it():
    assert named(trial("quadratic", 1.0, 2.0), trial("linear", 1.1, 1.9)) == ("quadratic", ["linear"])
    assert named(trial("quadratic", 1.0, 5), trial("linear", 1.1, 4)) == ("linear", ["quadratic"])
    assert named(trial("quadratic", 1.0, 3), trial("linear", 1.1, 4), trial("force", 1.15, 9)) == (
        "quadratic", ["linear", "force"]
    )  # fmt: skip


def test_a_richer_cause_is_no_rival_unless_that_pays():
    assert named(trial("linear", 1.0, 5), trial("force", 0.99, 1, count=12)) == ("linear", [])
    better = trial("force", 0.7, 5, count=12)
    assert named(better, trial("linear", 0.85, 4, count=11)) == ("linear", ["force"])


def test_a_cause_is_no_rival_of_itself_beside_another_law():
    assert named(trial("drag", 1.0, 5), trial("drag", 1.05, 4)) == ("drag", [])


def test_the_law_is_the_simplest_that_foretells_the_motion():
    def law(*trials):
        return len(naming.named(trials, WATCHED, RefineConfig())[0].fitted.values)

    # Of the same cause, over the fitted instants as good: plastic, and viscous with a parameter less.
    assert law(trial("wind", 1.0, 2.0), trial("wind", 1.2, 2.2, count=8)) == 8
    assert law(trial("wind", 1.0, 2.0), trial("wind", 1.2, 9.0, count=8)) == 9
    assert law(trial("wind", 1.0, 9.0), trial("wind", 1.2, 2.0, count=8)) == 8


def test_the_answer_says_what_the_motion_does_not_tell():
    document = {"verdict": "effect added", "accepted": [{"effect": "linear_drag", "or_else": ["quadratic_drag"]}]}
    assert answer(document) == (
        "effect added: one of linear drag, quadratic drag (this motion does not tell which)"
    )  # fmt: skip
    assert answer(document | {"accepted": [{"effect": "swirl"}]}) == "effect added: swirl"
    assert answer(document | {"verdict": "nothing missing", "accepted": []}) == "nothing missing"
    assert answer({"verdict": "unexplained residual", "accepted": [{"effect": "hidden_obstacle"}]}) == (
        "unexplained residual, beside what was added: hidden obstacle"
    )  # fmt: skip
