"""What counts as evidence for an effect, in closed form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from linear_model import EFFECTS, NOISE, LinearModel, baseline
from small import only_first_quick

from masiv.inference.least_squares import linearize
from masiv.inference.model_fit import evaluate_fit, gauss_newton_fit, residual_of
from masiv.refinement import savage_dickey
from masiv.refinement.candidates import score
from masiv.refinement.config import RefineConfig
from masiv.refinement.hypotheses import evidence_of, linearized, weighed
from masiv.refinement.round_posterior import RoundPosterior
from masiv.refinement.rounds import Trial
from masiv.refinement.search import whitened_start
from masiv.refinement.search_state import SearchSettings
from masiv.refinement.stage import refine

NAME = "body_force"
ONE = {NAME: EFFECTS[NAME]}


def settings(**config):
    return SearchSettings.of(RefineConfig.model_validate(config), discrepancy_force=False)


def both(strength):
    """Hypotheses without and with an effect of a ``strength``, and the term."""
    model = LinearModel({"velocity_z": 0.3, f"{NAME}.strength": strength}, effects=ONE)
    base = baseline(model)
    fit = gauss_newton_fit(model, base.model.with_effect(NAME), base.values, budget=20)
    pairs = [(f, linearized(model, f)) for f in (base, fit)]
    return *weighed(model, pairs, None, evidence_of(model, pairs)), model.term(NAME)


def test_the_density_ratio_at_zero_is_the_ratio_of_evidences():
    """Dickey's theorem."""
    without, with_it, term = both(0.0)
    factor = with_it.marginal.log_evidence - without.marginal.log_evidence
    assert savage_dickey.log_bayes_factor(with_it, term) == pytest.approx(factor, abs=0.3)


@pytest.mark.parametrize("strength", [NOISE, -4 * NOISE, 40 * NOISE])
def test_without_other_grids_the_density_ratio_takes_nothing_from_an_effect(strength):
    """Larger errors may explain a strength beside the effect: the ratio of evidences knows, that of densities not."""
    without, with_it, term = both(strength)
    factor = with_it.marginal.log_evidence - without.marginal.log_evidence
    assert savage_dickey.log_bayes_factor(with_it, term) > factor > 3


def test_a_strength_that_may_as_well_be_zero_is_no_evidence():
    _, known, term = both(10 * NOISE)
    assert savage_dickey.log_bayes_factor(known, term) > 10
    sd = abs(float(known.linear.values[f"{NAME}.strength"]))
    vague = replace(known, marginal=replace(known.marginal, covariance=sd**2 * np.eye(len(known.marginal.mean))))
    assert savage_dickey.log_bayes_factor(vague, term) < 3


class OtherGrids(LinearModel):
    """Two finer grids move the body as the effect does, one forth, the other back."""

    def finer_grids(self, model, values, index):
        return [0.02 * sign * EFFECTS[NAME] for sign in (1, -1)]


@pytest.mark.parametrize("strength", only_first_quick([0.02, 0.4]))
def test_an_effect_as_large_as_what_another_grid_may_do_is_not_named(strength):
    model = OtherGrids({"velocity_z": 0.3, f"{NAME}.strength": strength}, effects=ONE)
    result = refine(model, [baseline(model)], settings())
    assert [t.name for t in result.accepted] == ([NAME] if strength > 0.1 else [])


class CoarseGrid(LinearModel):
    """A grid that is too coarse: on finer ones the body moves as with a little of the effect."""

    def finer_grids(self, model, values, index):
        return [strength * EFFECTS[NAME] for strength in (0.02, 0.0205)]


@pytest.mark.parametrize("strength", only_first_quick([0.02, 0.4]))
def test_what_a_finer_grid_explains_is_no_effect(strength):
    model = CoarseGrid({"velocity_z": 0.3, f"{NAME}.strength": strength}, effects=ONE)
    result = refine(model, [baseline(model)], settings())
    assert [t.name for t in result.accepted] == ([NAME] if strength > 0.1 else [])
    for done in result.search.rounds:
        assert done.accepted is None or any(done.accepted is t for t in done.trials)


class DeadZone(LinearModel):
    """A velocity of less than 0.15 m/s moves nothing: a fit that starts there stays."""

    def motion(self, values):
        v = values.get("velocity_z", 0.0)
        return super().motion({**values, "velocity_z": v if abs(v) >= 0.15 else 0.0})


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of SciPy, about a parameter without effect
def test_what_a_restart_explains_is_no_evidence_for_an_effect():
    model = DeadZone({"velocity_z": 0.3}, effects=ONE)
    state, _ = whitened_start(model, [baseline(model)], settings())
    assert state.fit.values["velocity_z"] == pytest.approx(0.0, abs=0.1)
    found = state.fit.model.with_effect(NAME)
    values, parameters = {"velocity_z": 0.3, f"{NAME}.strength": 1e-4}, model.parameters(found)
    there = linearize(residual_of(state.forward_model, found), parameters, values)
    fit = evaluate_fit(state.forward_model, found, parameters, values, there.jacobian, robust_scale=state.robust_scale)
    (candidate,) = score(state.forward_model, state.fit, [NAME], robust_scale=state.robust_scale).candidates
    trial = Trial(candidate, fit)
    judged = RoundPosterior.of(state, [state.fit], [trial], settings())
    assert judged.posterior.best(0).fitted.values["velocity_z"] == pytest.approx(0.0, abs=0.1)
    again = judged.with_restarted(state, trial, settings())
    assert again.posterior.best(0).fitted.values["velocity_z"] == pytest.approx(0.3, abs=0.01)
    assert again.posterior.with_at_most(0) > 0.5
