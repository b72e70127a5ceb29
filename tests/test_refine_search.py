"""What a search of effects decides, on a forward model in closed form whose truth is known."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from linear_model import EFFECTS, NOISE, ONES, POINTS, TIMES, LinearModel, baseline, pattern
from small import only_first_quick

from masiv.errors import InputError, MasivError, NonFiniteError
from masiv.inference.noise_model import NoiseModel
from masiv.models.families import Family
from masiv.refinement.candidates import score
from masiv.refinement.config import RefineConfig
from masiv.refinement.document import document
from masiv.refinement.document_text import text
from masiv.refinement.effect_fit import fit_with_effect
from masiv.refinement.rounds import Trial
from masiv.refinement.search import whitened_start
from masiv.refinement.search_state import SearchSettings
from masiv.refinement.stage import refine
from masiv.refinement.trials import could_improve

DRAG, GRAVITY = {"linear_drag.strength": 0.5}, {"gravity_scale.strength": 0.4}


def settings(config=None, **changes):
    return SearchSettings.of(RefineConfig.model_validate(config or {}), discrepancy_force=False, **changes)


def refined(model, config=None, known=(), **changes):
    return refine(model, [baseline(model, known)], settings(config, **changes))


@pytest.mark.parametrize("seed", only_first_quick(range(8)))
def test_nothing_is_missing_if_nothing_is(seed):
    result = refined(LinearModel({"velocity_z": 0.3}, seed=seed))
    assert (result.verdict, result.accepted, result.changes_twin) == ("nothing missing", (), False)
    assert result.reduced_chi(result.after) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(("determined", "verdict"), [(True, "nothing missing"), (False, "cannot tell")])
def test_a_probable_effect_that_would_not_have_been_seen_leaves_the_question_open(determined, verdict):
    result = refined(LinearModel({"velocity_z": 0.3}))
    sets = {frozenset[str](): 0.6, frozenset({"viscosity"}): 0.36}
    (last,) = result.search.rounds[-1:]
    last = replace(last, posterior=SimpleNamespace(credible_set=lambda: sets))
    limits = [replace(x, determined=determined or x.effect != "viscosity") for x in result.search.limits]
    assert "viscosity" in {x.effect for x in limits}
    search = replace(result.search, rounds=(last,), limits=tuple(limits))
    assert replace(result, search=search).verdict == verdict


@pytest.mark.parametrize("seed", only_first_quick(range(4)))
def test_an_effect_within_the_noise_is_not_named(seed):
    weak = LinearModel({"viscosity.strength": 0.05 * NOISE}, seed=seed)
    assert refined(weak).accepted == ()


@pytest.mark.parametrize("discrepancy_force", only_first_quick([True, False]))
def test_two_strong_effects_are_found_by_every_kind_of_search(discrepancy_force):
    """A search without a force for the discrepancy, as tracks have it, goes on after the first effect, too."""
    model = LinearModel({**DRAG, **GRAVITY, "velocity_z": 0.3})
    result = refine(model, [baseline(model)], replace(settings(), discrepancy_force=discrepancy_force))
    assert {t.name for t in result.accepted} == {"linear_drag", "gravity_scale"}
    assert result.verdict == "effect added"
    assert result.after.values["linear_drag.strength"] == pytest.approx(0.5, abs=1e-3)
    assert result.after.values["gravity_scale.strength"] == pytest.approx(0.4, abs=1e-3)
    assert result.reduced_chi(result.after) == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
def test_no_more_effects_are_added_than_asked_and_the_rest_is_called_unexplained():
    result = refined(LinearModel({**DRAG, **GRAVITY}), {"max_effects": 1})
    assert [t.name for t in result.accepted] == ["gravity_scale"]
    assert result.verdict == "unexplained residual"
    written = document(result)
    assert written["verdict"] == "unexplained residual"
    assert [a["effect"] for a in written["accepted"]] == ["gravity_scale"]
    assert written["answer"] == "unexplained residual, although an effect was added: gravity scale"
    assert text(written).endswith(written["answer"])


@pytest.mark.slow
def test_arguments_stay_as_they_are():
    model = LinearModel({**DRAG, **GRAVITY})
    base, config = baseline(model), settings()
    observations, values = model.observations, dict(base.values)
    std = observations[0].residual_std.copy()
    changing = Grids({**DRAG})
    own = changing.observations[0]
    refine(model, [base], config)
    result = refine(changing, [baseline(changing)], settings())
    assert model.observations is observations
    np.testing.assert_array_equal(observations[0].residual_std, std)
    assert base.values == values
    assert (changing.observations[0], own.grid_corrections) == (own, ())
    assert len(result.observations[0].grid_corrections) == 2  # its own are known to the result


class Grids(LinearModel):
    """Finer grids change the motion along y; ``factor`` times as much once an effect is in the model."""

    factor = 1.0

    def finer_grids(self, model, values, index):
        size = self.factor if model.effects else 1.0
        one = size * 2e-3 * pattern(1, TIMES**3, ONES)
        return [one, 1.5 * one + size * 1e-3 * pattern(0, np.sin(20 * TIMES), POINTS[:, 1])]


@pytest.mark.slow
@pytest.mark.parametrize("named", [[], ["linear_drag", "body_force", "gravity_scale"]])
def test_effects_that_exclude_each_other_are_never_in_one_model(named):
    """Two contact effects, for instance: in the second round the configuration names one that cannot be added."""
    strengths = {"body_force.strength": 0.5, "gravity_scale.strength": 0.05}
    model = LinearModel(strengths, exclusive=("linear_drag", "body_force"))
    result = refined(model, {"effects": named})
    assert [t.name for t in result.accepted] == ["body_force", "gravity_scale"]
    first, second, *_ = result.search.rounds
    assert first.ranking.not_ranked == {}
    assert second.ranking.not_ranked == ({"linear_drag": "it cannot act here in addition"} if named else {})


def test_an_effect_on_request_is_looked_for_if_it_is_named():
    model = LinearModel({}, effects={**EFFECTS, "internal_pressure": EFFECTS["viscosity"]})
    here = baseline(model, ()).model
    assert settings().considered(model, here) == list(EFFECTS)
    named = settings({"effects": ["internal_pressure", "linear_drag"]})
    assert named.considered(model, here) == ["internal_pressure", "linear_drag"]


SPHERE, HALF = "stiffness_contrast", "stiffness_contrast_half_space"
SHAPES = {
    "linear_drag": EFFECTS["linear_drag"],
    SPHERE: pattern(2, TIMES**2, np.exp(-0.5 * (POINTS**2).sum(1) / 0.1**2)),
    HALF: pattern(2, TIMES**2, (POINTS[:, 2] > 0).astype(float)),
}


def test_the_shapes_of_a_cause_are_looked_for_if_it_is_named():
    model = LinearModel({}, effects=SHAPES)
    here, drag = baseline(model).model, "linear_drag"
    assert settings().considered(model, here) == [drag, SPHERE]
    assert settings().causes(model, here) == [[drag], [SPHERE]]
    named = settings({"effects": [SPHERE, drag]})
    assert named.considered(model, here) == [SPHERE, HALF, drag]
    assert named.causes(model, here) == [[SPHERE, HALF], [drag]]
    assert settings({"effects": [HALF]}).considered(model, here) == [HALF]
    again = named.for_effects([SPHERE])  # what a search did not look at closely enough
    assert again.considered(model, here) == [SPHERE]


@pytest.mark.parametrize("shape", only_first_quick([HALF, SPHERE]))
def test_of_the_shapes_of_a_cause_the_one_that_is_there_is_named_once(shape):
    model = LinearModel({f"{shape}.strength": 0.1, **DRAG}, effects=SHAPES)
    result = refined(model, {"effects": [SPHERE, "linear_drag"]})
    assert {t.name for t in result.accepted} == {shape, "linear_drag"}
    assert result.after.values[f"{shape}.strength"] == pytest.approx(0.1, abs=2e-3)
    assert result.search.limits == ()  # its other shape is no further cause
    first = result.search.rounds[0]
    assert {c.effect for c in first.candidates} == set(SHAPES)


@pytest.mark.slow
def test_the_shapes_of_a_cause_share_its_prior():
    """Two shapes that move the body alike are, together, as probable as one cause."""
    same = {SPHERE: SHAPES[HALF], HALF: SHAPES[HALF]}
    alone = refined(LinearModel({}, effects={HALF: SHAPES[HALF]}), {"effects": [HALF]})
    both = refined(LinearModel({}, effects=same), {"effects": [SPHERE]})
    null = [r.search.rounds[0].posterior.with_at_most(0) for r in (alone, both)]
    assert null[1] == pytest.approx(null[0], rel=1e-6)


@pytest.mark.slow
def test_what_diverges_is_listed_with_its_reason():
    result = refined(LinearModel({**DRAG}, diverges=("viscosity",)))
    written = document(result)
    assert [(r["effect"], "flew apart" in r["reason"]) for r in written["not_ranked"]] == [("viscosity", True)]
    assert "viscosity" not in {c["effect"] for c in written["candidates"]}
    assert "not ranked: it flew apart" in text(written)
    limits = {x["effect"]: x for x in written["upper_limits"]}
    assert not limits["viscosity"]["determined"]
    assert "both sides of viscosity.strength" in limits["viscosity"]["reason"]
    assert "no upper limit of viscosity: " in text(written)
    assert all(x["reason"] is None for name, x in limits.items() if name != "viscosity")


class Brittle(LinearModel):
    """An effect that can be simulated at the strengths of the ranking alone: its refit has no derivatives."""

    def fields(self, model, values, *, held_out=False):
        strength = values.get("body_force.strength", 0.0)
        if strength not in (0.0, 0.01):
            raise NonFiniteError(5, 6, "it broke")
        return super().fields(model, values, held_out=held_out)


def test_a_refit_that_cannot_be_simulated_is_listed_with_its_reason():
    result = refined(Brittle({"body_force.strength": 0.3}), {"effects": ["body_force"]})
    (done,) = document(result)["rounds"]
    assert done["refits"] == []
    assert [(f["effect"], f["law"]) for f in done["not_fitted"]] == [("body_force", "rigid")]
    assert "diverges" in done["not_fitted"][0]["reason"] or "it broke" in done["not_fitted"][0]["reason"]


class NoDerivatives(LinearModel):
    """A motion over all instants that can be simulated where a fit ends and nowhere near: for models with an effect, or
    for those without."""

    with_effect = True
    last: dict | None = None

    def fields(self, model, values, *, held_out=False):
        if held_out and ("body_force" in model.effects) == self.with_effect:
            if self.last is not None and self.last.keys() == values.keys():
                moved = max(abs(self.last[n] - values[n]) for n in values)
                if abs(moved - 0.01) < 1e-9:  # the step of a finite difference
                    raise NonFiniteError(5, 6, "it broke")
            self.last = dict(values)
        return super().fields(model, values, held_out=held_out)


@pytest.mark.slow
def test_a_model_without_derivatives_is_listed_with_its_reason_and_not_accepted():
    result = refined(NoDerivatives({"body_force.strength": 0.3, "velocity_z": 0.3}), {"effects": ["body_force"]})
    assert result.accepted == ()
    written = document(result)
    (refit,) = written["rounds"][0]["refits"]
    assert "diverges on both sides of body_force.strength" in refit["not_weighed"]
    assert "not weighed: " in text(written)


def test_nothing_is_accepted_if_there_is_nothing_to_compare_it_with():
    model = NoDerivatives({"body_force.strength": 0.3, "velocity_z": 0.3})
    model.with_effect = False
    with pytest.raises(MasivError, match=r"no model without a further effect can be weighed.*velocity_z"):
        refined(model, {"effects": ["body_force"]})


def noisy(truth, noise, seed):
    """Points whose own errors are large: an effect explains little of the whole residual."""
    model = LinearModel(truth, noise=noise, seed=seed)
    (own,) = model.observations
    ratio = noise / NOISE
    return model.with_observations(
        [replace(own, noise_std=noise, residual_std=ratio * own.residual_std, observation_std=np.zeros(0))]
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", only_first_quick(range(3)))
def test_what_explains_a_small_part_of_large_errors_is_named_if_it_is_evident(seed):
    """The errors of points average out over the body, its motion does not."""
    model = noisy({"linear_drag.strength": 0.035, "velocity_z": 0.3}, 30 * NOISE, seed)
    result = refined(model)
    assert result.search.rounds[0].candidates[0].explained < RefineConfig().min_explained
    assert [t.name for t in result.accepted] == ["linear_drag"]
    nothing = refined(noisy({"velocity_z": 0.3}, 30 * NOISE, seed))
    assert (nothing.verdict, nothing.accepted) == ("nothing missing", ())


class Stuck(LinearModel):
    """A fit with a body force never leaves its start: its motion does not change with small strengths."""

    def fields(self, model, values, *, held_out=False):
        name = "body_force.strength"
        ranked = abs(values.get(name, 0.0)) <= 0.011  # about zero, where the score test looks
        kept = values if ranked or name not in values else {**values, name: 0.0}
        return super().fields(model, kept, held_out=held_out)


def test_a_fit_that_falls_short_says_nothing_against_its_effect():
    result = refined(Stuck({"body_force.strength": 0.3, "velocity_z": 0.3}), {"effects": ["body_force"]})
    (refit,) = document(result)["rounds"][0]["refits"]
    assert not refit["converged"]
    assert result.accepted == ()
    assert result.verdict in ("cannot tell", "unexplained residual")
    assert result.search.null_probability < 0.05


def test_noise_is_no_outlier_in_any_observation():
    """Whitened residuals of an observation have its own noise."""
    model = LinearModel({"velocity_z": 0.3})
    (quiet,) = model.observations
    (loud,) = LinearModel({"velocity_z": 0.3}, noise=20 * NOISE, name="b").observations
    loud = replace(loud, noise_std=20 * NOISE, residual_std=20 * quiet.residual_std, observation_std=np.zeros(0))
    scales = []
    for observations in ([quiet, loud], [loud, quiet]):
        both = model.with_observations(observations)
        scales.append(whitened_start(both, [baseline(both)], settings())[0].robust_scale)
    assert scales[0] == scales[1] >= 5 * 20 * NOISE


@pytest.mark.slow
def test_the_model_before_is_judged_by_the_errors_of_its_own_motion():
    """Also if a further effect was looked for after the first, and rejected."""
    kind = type("Changing", (Grids,), {"factor": 10.0})
    result = refined(kind({**DRAG}))
    assert [t.name for t in result.accepted] == ["linear_drag"]
    assert result.search.rounds[-1].accepted is None
    alone = refined(kind({**DRAG}), rank_only=True)
    assert result.before.fit_mm == pytest.approx(alone.before.fit_mm)
    assert result.reduced_chi(result.before) == pytest.approx(alone.reduced_chi(alone.before), rel=1e-6)
    in_the_end = NoiseModel(result.observations).reduced_chi(result.before.squares)
    assert in_the_end != pytest.approx(result.reduced_chi(result.before), rel=0.05)


def test_ranking_alone_fits_and_changes_nothing():
    model = LinearModel({**DRAG, **GRAVITY})
    result = refined(model, rank_only=True)
    assert (result.verdict, result.accepted, result.changes_twin) == ("ranked only", (), False)
    (done,) = result.search.rounds
    assert done.trials == ()
    assert done.candidates[0].effect == "gravity_scale"
    assert len(done.candidates) == len(EFFECTS)


@pytest.mark.slow
def test_effects_that_are_known_are_not_called_added():
    model = LinearModel({**DRAG, **GRAVITY})
    result = refined(model, known=["linear_drag"])
    assert result.before.model.effects == ("linear_drag",)
    assert [t.name for t in result.accepted] == ["gravity_scale"]


def test_names_are_checked_before_anything_is_simulated():
    model = LinearModel({})
    base = baseline(model)
    rollouts = model.rollouts
    with pytest.raises(InputError, match="unknown effect 'ether'"):
        refine(model, [base], settings({"effects": ["ether"]}))
    twice = model.with_observations([*model.observations, *model.observations])
    with pytest.raises(ValueError, match="names that differ: a, a"):
        refine(twice, [base], settings())
    assert model.rollouts == rollouts


def test_a_worse_law_is_not_fitted_with_what_would_not_make_up_for_it():
    model = LinearModel({**DRAG, **GRAVITY})
    base = baseline(model)
    ranking = score(model, base, list(EFFECTS), robust_scale=1.0)
    best, worst = ranking.candidates[0], ranking.candidates[-1]
    trials = [Trial(best, fit_with_effect(model, base, best, 1.0))]
    assert could_improve(worst, base, [])
    assert could_improve(best, base, trials)
    assert not could_improve(worst, base, trials)


@pytest.mark.slow
def test_a_baseline_that_cannot_be_simulated_does_not_end_the_search():
    model = LinearModel({**DRAG})
    good = baseline(model)

    class Fragile(LinearModel):
        def fields(self, model, values, *, held_out=False):
            if model.family.kind == "fragile":
                raise MasivError("it cannot be simulated here")
            return super().fields(model, values, held_out=held_out)

    fragile = Fragile({**DRAG})
    bad = replace(good, model=replace(good.model, family=Family("fragile", (), {})), cost=2 * good.cost)
    result = refine(fragile, [good, bad], settings())
    assert [t.name for t in result.accepted] == ["linear_drag"]
    with pytest.raises(MasivError, match="cannot be simulated here"):
        refine(fragile, [bad, bad], settings())


def test_what_was_accepted_first_is_exchanged_once_the_others_are_known():
    """The first effect stands for both that act; with the second one known, another fits better in its place."""
    both = EFFECTS["linear_drag"] + 0.7 * EFFECTS["gravity_scale"] + 0.02 * EFFECTS["viscosity"]
    patterns = {**{n: EFFECTS[n] for n in ("linear_drag", "gravity_scale")}, "quadratic_drag": both}
    model = LinearModel({"linear_drag.strength": 0.5, "gravity_scale.strength": 0.4}, effects=patterns)
    result = refined(model)
    assert result.search.rounds[0].accepted.effect == "quadratic_drag"
    assert {t.name for t in result.accepted} == {"linear_drag", "gravity_scale"}
    (exchange,) = (x for r in result.search.rounds for x in r.exchanges)
    assert (exchange.old, exchange.new) == ("quadratic_drag", "linear_drag")
    assert exchange.log_bayes_factor > 0
    assert result.after.values["linear_drag.strength"] == pytest.approx(0.5, abs=0.02)
    written = document(result)
    assert "exchanged quadratic drag for linear drag" in text(written)


def test_what_cannot_act_beside_another_effect_is_tried_in_its_place():
    """Two contacts with the ground, for instance: the wrong one was named while another effect was missing."""
    patterns = {n: EFFECTS[n] for n in ("linear_drag", "gravity_scale")}
    patterns["quadratic_drag"] = EFFECTS["linear_drag"] + 0.7 * EFFECTS["gravity_scale"] + 0.02 * EFFECTS["viscosity"]
    truth = {"linear_drag.strength": 0.5, "gravity_scale.strength": 0.4}
    model = LinearModel(truth, effects=patterns, exclusive=("linear_drag", "quadratic_drag"))
    assert {t.name for t in refined(model).accepted} == {"linear_drag", "gravity_scale"}


def test_the_search_goes_on_with_what_the_ranking_had_overlooked():
    """Neither effect explains enough of the residual for a fit, as the other one is missing; their limits show one."""
    model = LinearModel({**DRAG, **GRAVITY})
    result = refined(model, {"min_explained": 0.9})
    assert result.search.rounds[0].accepted is None
    assert {t.name for t in result.accepted} == {"linear_drag", "gravity_scale"}
