"""Fits with an effect go on until they have ended, in closed form."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
from linear_model import EFFECTS, LinearModel, baseline

from masiv.inference.least_squares import linearize
from masiv.inference.model_fit import evaluate_fit, linear_minimum, residual_of
from masiv.refinement.candidates import score
from masiv.refinement.config import RefineConfig
from masiv.refinement.refits import refit_unconverged
from masiv.refinement.rounds import Trial
from masiv.refinement.search import whitened_start
from masiv.refinement.search_state import SearchSettings
from masiv.refinement.stage import refine
from masiv.refinement.trials import worth_fitting


def settings(**config):
    return SearchSettings.of(RefineConfig.model_validate(config), discrepancy_force=False)


class Saturating(LinearModel):
    """A strength s acts as s / (1 + |s| / 2): at zero it seems to do more than it does."""

    def motion(self, values):
        return super().motion({n: v / (1 + abs(v) / 2) if "strength" in n else v for n, v in values.items()})


def test_an_effect_that_may_act_is_fitted_to_the_end_and_its_limit_is_not_below_that():
    model = Saturating({"body_force.strength": 4.0}, effects={"body_force": EFFECTS["body_force"]})
    result = refine(model, [baseline(model)], settings(max_null_probability=1e-300))
    assert not result.search.after.model.effects  # no evidence is enough
    (trial,) = result.search.rounds[-1].trials
    assert trial.fitted.values["body_force.strength"] == pytest.approx(4.0, rel=0.05)
    (limit,) = result.search.limits
    assert limit.strength == pytest.approx(4.0, rel=0.05)  # by the derivative at zero, 4 / (1 + 4 / 2)


def stopped(state, name, strength):
    """A trial of the effect ``name`` whose fit has stopped at ``strength``."""
    model = state.fit.model.with_effect(name)
    parameters, values = state.forward_model.parameters(model), {**state.fit.values, f"{name}.strength": strength}
    there = linearize(residual_of(state.forward_model, model), parameters, values)
    fitted = evaluate_fit(
        state.forward_model, model, parameters, values, there.jacobian, robust_scale=state.robust_scale
    )
    (candidate,) = score(state.forward_model, state.fit, [name], robust_scale=state.robust_scale).candidates
    return Trial(candidate, fitted)


def test_a_fit_that_has_stopped_on_the_way_goes_on_if_it_could_then_be_the_best():
    """Half of what the ranking promised is reached, and a rival ended nearer. What cannot become as good stays."""
    model = Saturating({"body_force.strength": 4.0, "velocity_z": 0.3})
    state, _ = whitened_start(model, [baseline(model)], settings())
    rival, cause, other = (stopped(state, *x) for x in (("linear_drag", 3.0), ("body_force", 1.0), ("viscosity", 0.3)))
    assert cause.fitted.cost < 0.5 * state.fit.cost
    assert rival.fitted.cost < cause.fitted.cost < other.fitted.cost
    after = refit_unconverged(state, [rival, cause, other], [state.fit], settings())
    assert after[1].fitted.values["body_force.strength"] == pytest.approx(4.0, rel=0.01)
    assert after[2].fitted is other.fitted


def test_the_minimum_of_a_linear_model_is_within_the_bounds_of_its_parameters():
    model = LinearModel({"body_force.strength": 4.0, "velocity_z": 5.0})  # beyond the bound of the velocity, 3
    state, _ = whitened_start(model, [baseline(model)], settings())
    state = replace(state, robust_scale=1e6)
    away, there = (stopped(state, "body_force", strength).fitted for strength in (0.0, 4.0))
    assert [linear_minimum(fit, 1e6) for fit in (away, there)] == pytest.approx([there.cost, there.cost], rel=0.01)
    assert there.cost > 0.1  # m²: the bound of the velocity is felt


def test_what_explains_nearly_as_much_as_an_effect_that_is_worth_fitting_is_fitted_too():
    shares = {"a": 0.12, "b": 0.09, "c": 0.07, "d": 0.01}
    found = [SimpleNamespace(effect=name, explained=share) for name, share in shares.items()]
    assert [c.effect for c in worth_fitting(found, 0.1)] == ["a", "b"]
    assert worth_fitting(found[1:], 0.1) == []
    assert len(worth_fitting(found, 0.0)) == 4
