"""What is enough evidence for an effect, and for two in place of one."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from small_fits import DRAG, NOISE, fit_with, noise_model

from masiv.models.parameters import Parameter
from masiv.refinement.config import RefineConfig
from masiv.refinement.evidence import (
    log_predictive_gain,
    simplest,
    statistical_objections,
    strength_z,
    too_little_explained,
)
from masiv.refinement.second_effect import objections_to_pair

CONFIG = RefineConfig.model_validate({})


def judged(before, after, residual_std=NOISE, adapts=True, gls_z=None):
    """Objections to a fall of the mean squares (fitted, held out), in units of the noise's."""
    before, after = fit_with(*before), fit_with(*after)
    return too_little_explained(before, after, noise_model(residual_std), CONFIG, adapts=adapts, gls_z=lambda: gls_z)


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ((9, 9), (1, 1)),
        ((9, 20), (2, 20)),  # held-out instants cannot tell, the fitted ones are decisive
        ((9, 20), (2, 17)),  # nor does a little in favour (8 %) count against it
        ((2, 20), (1.5, 3)),  # held-out instants are decisive
        ((1.6, 20), (1.1, 8)),  # half of what noise could change in fitted instants: a third of the held-out error
    ],
)
def test_enough_is_explained(before, after):
    assert judged(before, after) == []


@pytest.mark.parametrize(
    ("before", "after", "objection"),
    [
        ((1.6, 1.6), (1.0, 1.5), "of what noise"),  # less than noise
        ((9, 20), (6, 22), "held-out"),  # held-out instants contradict
        ((9, 20), (2, 22), "held-out"),
        ((9, 20), (6, 20), "held-out"),  # not decisive enough for held-out instants that cannot tell
        ((1.6, 20), (1.1, 10), "asked: 32 %"),
    ],
)
def test_too_little_is_explained(before, after, objection):
    assert objection in judged(before, after)[-1]


def test_a_part_that_is_significant_under_smooth_noise_may_be_smaller():
    assert judged((9, 20), (6, 20), gls_z=7.0) == []
    assert "held-out" in judged((9, 20), (6, 20), gls_z=5.0)[0]
    assert "held-out" in judged((9, 20), (6, 22), gls_z=7.0)[0]  # not if held-out instants contradict
    assert "held-out" in judged((1.9, 20), (1, 20), gls_z=7.0)[-1]  # nor for next to nothing


def test_an_effect_of_one_parameter_may_explain_less_but_not_against_what_is_held_out():
    little = (1.6, 2.0), (1.2, 1.2)
    assert "of what noise" in judged(*little)[0]
    assert judged(*little, adapts=False) == []
    assert "held-out" in judged((1.6, 2.0), (1.4, 1.3), adapts=False)[-1]  # the less, the more held-out again
    assert judged((2.6, 2.0), (1.4, 1.3), adapts=False) == []
    assert "held-out" in judged((1.6, 2.0), (1.2, 2.0), adapts=False)[-1]


def test_nothing_is_decisive_if_no_instant_is_simulated_as_well_as_observed():
    assert "held-out" in judged((36, 80), (8, 80), residual_std=2 * NOISE)[0]


def test_held_out_instants_are_one_sample_of_the_criterion():
    noise = noise_model()
    assert log_predictive_gain(fit_with(2, 6), fit_with(1, 2), noise) == pytest.approx(math.log(3))
    # Of an error within the noise there is nothing to predict.
    assert log_predictive_gain(fit_with(2, 6), fit_with(1, 0.1), noise) == pytest.approx(math.log(6))
    assert log_predictive_gain(fit_with(2, 2), fit_with(1, 6), noise) == pytest.approx(-math.log(3))
    assert log_predictive_gain(fit_with(2, 6), fit_with(1, 2), noise_model(holds_out=False)) == 0.0


@pytest.mark.parametrize(
    ("gain", "was", "now", "objection"),
    [(5.4, 6, 2, ""), (5.4, 2.2, 2, "falls by 5.5, less than 6"), (7.0, 2, 6, "falls by 5.9, less than 6")],
)
def test_the_criterion_falls_for_held_out_instants_too(gain, was, now, objection):
    before, after = fit_with(9, was, gain=0.0), fit_with(1, now, gain=gain)
    objections = " ".join(statistical_objections(before, after, DRAG, noise_model(), CONFIG))
    assert objection in objections
    assert bool(objections) == bool(objection)


@pytest.mark.parametrize(
    ("gain", "was", "now", "z", "objection"),
    [
        (15, 4.0, 1.8, 5.0, ""),  # held-out instants confirm both
        (15, 4.0, 2.5, 5.0, "asked: 30 %"),
        (25, 4.0, 2.5, 5.0, ""),  # less will do if the criterion is clear
        (99, 2.0, 2.0, 5.0, "asked: 15 %"),
        (99, 2.0, 3.0, 5.0, "-22 % of the held-out"),
        (5, 4.0, 2.0, 5.0, "less than 6"),
        (25, 4.0, 2.0, 2.0, "2.0 standard errors"),
    ],
)
def test_two_effects_in_place_of_one(gain, was, now, z, objection):
    forward_model = SimpleNamespace(
        term=lambda name: DRAG, objections=lambda *_: [], observations=noise_model().observations
    )
    before = fit_with(1, was, gain=0.0)
    after = fit_with(1, now, gain=gain, effects=("linear_drag",), z=z)
    objections = " ".join(objections_to_pair(forward_model, before, after, CONFIG))
    assert objection in objections
    assert bool(objections) == bool(objection)


def test_a_strength_counts_with_its_place_held():
    random = np.random.default_rng(4)
    along, start, apart = random.normal(size=(3, 40))
    strength, place = (Parameter(f"mass.{n}", 0.0, -9.0, 9.0, 1e-3) for n in ("size", "x"))
    other = Parameter("start", 0.0, -9.0, 9.0, 1e-3)
    term = SimpleNamespace(strengths=(strength,), others=(place,))
    # The place does nearly what the strength does: its standard error alone is large.
    jacobian = np.stack([start, along, along + 0.1 * apart], axis=1)
    stderr = 0.2 * np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    names = ("start", strength.name, place.name)
    fitted = SimpleNamespace(
        jacobian=jacobian, parameters=(other, strength, place),
        values=dict.fromkeys(names, 0.5), stderr=dict(zip(names, stderr, strict=True)),
    )  # fmt: skip
    alone = 0.2 * np.sqrt(np.linalg.inv(jacobian[:, :2].T @ jacobian[:, :2])[1, 1])
    assert 0.5 / stderr[1] < 4
    assert strength_z(fitted, term) == pytest.approx(0.5 / alone, rel=1e-6)


def test_of_fits_that_explain_as_much_the_simplest():
    rich, plain, poor = (fit_with(1.0, 1, count=9), fit_with(1.1, 1, count=4), fit_with(3, 1, count=2))
    assert simplest([rich, plain, poor], noise_model()) is plain
    assert simplest([], noise_model()) is None
    assert simplest([rich, plain, poor], noise_model(10 * NOISE)) is poor
    assert noise_model().reduced_chi(fit_with(9, 1).squares) == pytest.approx(3.0)
