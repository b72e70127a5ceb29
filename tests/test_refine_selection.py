"""Which effect is named, and which others the motion does not distinguish from it.

The observations have too few points for Vuong's test, so that the information criterion decides: effects whose errors
differ by 3 % are indistinguishable, by 10 % they are not.
"""

from __future__ import annotations

import numpy as np
import pytest
from small_fits import fit_with, noise_model

from masiv.refinement.answer import answer
from masiv.refinement.candidates import Candidate
from masiv.refinement.config import RefineConfig
from masiv.refinement.rounds import Trial
from masiv.refinement.selection import select


def trial(effect, fitted, held_out, count=9, passes=True):
    """A refit with these mean squares, in units of the noise, and ``count`` parameters."""
    candidate = Candidate(effect, 0.5, {}, {}, np.zeros((0, 0)), np.zeros(0))
    fit = fit_with(fitted, held_out, count=count, effects=(effect,))
    return Trial(candidate, fit, () if passes else ("it does not",))


def selected(*trials):
    selection = select(trials, noise_model(), RefineConfig.model_validate({}))
    return selection.trial and selection.trial.effect, list(selection.indistinguishable_from)


def test_the_one_that_explains_most_if_the_others_explain_less():
    assert selected(trial("drag", 1.0, 5), trial("swirl", 2.0, 1)) == ("drag", [])
    assert selected(trial("drag", 1.0, 5, passes=False), trial("swirl", 2.0, 1)) == ("swirl", [])
    assert selected(trial("drag", 1.0, 5, passes=False)) == (None, [])
    assert selected() == (None, [])


@pytest.mark.parametrize(
    ("trials", "named", "others"),
    [
        ([("quadratic", 1.0, 2.0), ("linear", 1.03, 1.9)], "linear", ["quadratic"]),
        ([("quadratic", 1.0, 5), ("linear", 1.03, 5)], "quadratic", ["linear"]),
        ([("quadratic", 1.0, 5), ("linear", 1.1, 4)], "quadratic", []),
        ([("quadratic", 1.0, 3), ("linear", 1.03, 4), ("force", 1.05, 9)], "quadratic", ["linear", "force"]),
    ],
)
def test_of_indistinguishable_effects_the_one_that_explains_all_instants_best(trials, named, others):
    assert selected(*(trial(*t) for t in trials)) == (named, others)


def test_a_richer_effect_is_no_rival_unless_that_pays():
    assert selected(trial("linear", 1.0, 5), trial("force", 0.99, 1, count=12)) == ("linear", [])
    better = trial("force", 0.7, 5, count=12)
    assert selected(better, trial("linear", 0.85, 4, count=11)) == ("linear", ["force"])


def test_an_effect_is_no_rival_of_itself_with_another_law():
    assert selected(trial("drag", 1.0, 5), trial("drag", 1.02, 4)) == ("drag", [])


def test_the_law_is_the_simplest_that_predicts_the_motion():
    def parameters(*trials):
        return len(select(trials, noise_model(), RefineConfig.model_validate({})).trial.fitted.values)

    # Of the same effect, over the fitted instants as good: plastic, and viscous with a parameter less.
    assert parameters(trial("wind", 1.0, 2.0), trial("wind", 1.2, 2.2, count=8)) == 8
    assert parameters(trial("wind", 1.0, 2.0), trial("wind", 1.2, 9.0, count=8)) == 9
    assert parameters(trial("wind", 1.0, 9.0), trial("wind", 1.2, 2.0, count=8)) == 8


def test_the_answer_says_what_the_motion_does_not_tell():
    accepted = [{"effect": "linear_drag", "indistinguishable_from": ["quadratic_drag"]}]
    document = {"verdict": "effect added", "accepted": accepted}
    assert (
        answer(document) == "effect added: one of linear drag, quadratic drag (this motion does not distinguish them)"
    )
    assert answer(document | {"accepted": [{"effect": "swirl"}]}) == "effect added: swirl"
    assert answer(document | {"verdict": "nothing missing", "accepted": []}) == "nothing missing"
    unexplained = {"verdict": "unexplained residual", "accepted": [{"effect": "hidden_obstacle"}]}
    assert answer(unexplained) == "unexplained residual, although an effect was added: hidden obstacle"
