"""refine.json: the result of refine as plain values."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from masiv.effects.catalogue import effect_named
from masiv.inference.model_fit import PARTS, ModelFit, part_mm
from masiv.inference.predictive import Forecast
from masiv.models.base import EffectTerm
from masiv.models.free_body import GRID_CORRECTION
from masiv.observations.base import Observation, rms_mm
from masiv.refinement.answer import SCHEMA, answer
from masiv.refinement.candidates import Candidate
from masiv.refinement.discrepancy import DISCREPANCY_FORCE
from masiv.refinement.discrepancy_field import peak, sampled_fields, share
from masiv.refinement.limits import UpperLimit
from masiv.refinement.result import ADDED, NOTHING, BodyResult, Proposal, RefineResult, SharedFit
from masiv.refinement.rounds import Round, Trial, alternatives
from masiv.refinement.support import carried_weight, carried_weight_stderr
from masiv.refinement.world_vectors import vectors_in_world

WORST_POINTS = 0.1
"""Part of the points whose middle is the place where a residual is largest."""


def document(result: RefineResult) -> dict[str, Any]:
    """refine.json. ``before`` and ``after`` hold errors of the motion; pictures are added by whoever has them."""
    before, after = result.before, result.after
    first = result.search.rounds[0] if result.search.rounds else None
    out = {
        "schema": SCHEMA,
        "condition": result.condition,
        "verdict": result.verdict,
        "noise_floor_mm": 1e3 * float(np.mean([e.noise_std for e in result.observations])),
        "observation_error_mm": _expected_mm(result, _observation_variance),
        "camera_split": all(e.tracking_error is not None for e in result.observations),
        "discretization_mm": _expected_mm(result, _discretization_variance),
        "grid_change": {"before": _grid_change(result, before), "after": _grid_change(result, after)},
        "reduced_chi": {"before": result.reduced_chi(before), "after": result.reduced_chi(after)},
        "residual_mm": {"fit": before.fit_mm, "validation": before.validation_mm},
        "null_probability": result.search.null_probability,
        "unknown_probability": result.search.unknown_probability,
        "predictive_p": dict(result.predictive_p),
        "test": {name: _test(check.test) for name, check in result.search.checks.items() if check.test},
        "credible_set": _credible_set(first),
        "upper_limits": [_upper_limit(result, limit) for limit in result.search.limits],
        "candidates": [_candidate(result, c, first) for c in first.candidates] if first else [],
        "not_ranked": [_failure(result, n, why) for n, why in first.ranking.not_ranked.items()] if first else [],
        "accepted": [_accepted(result, term, after) for term in result.accepted],
        "discrepancy_force": _discrepancy(result),
        "before": _errors(result, before),
        "after": _errors(result, after),
        "unexplained": _unexplained(result),
        "laws": {"before": before.model.family.kind, "after": after.model.family.kind},
        "law_parameters": {
            p.name: {"value": after.values[p.name], "stderr": after.stderr[p.name]}
            for p in after.model.family.parameters
        },
        "rounds": [_round(result, r) for r in result.search.rounds],
        "observations": _observations(result),
        "bodies": {name: _body(body) for name, body in result.bodies.items()},
        "shared": [_shared(fit) for fit in result.shared],
        "next_experiment": None if result.proposal is None else _proposal(result.proposal),
        "rollouts": result.forward_model.rollouts,
    }  # fmt: skip
    return {**out, "answer": answer(out)}


def scope_of(term: EffectTerm) -> str:
    """Whom the term acts on, and whether they share its strength: all, each, or names."""
    return term.name.removeprefix(term.effect).removeprefix("@") or "all"


def _short(term: EffectTerm, name: str) -> str:
    return name.removeprefix(f"{term.name}.")


def _expected_mm(result: RefineResult, variances: Callable[[Observation], np.ndarray]) -> dict[str, float | None]:
    """Root mean square [mm] over the instants of each part, from ``variances`` (T,) [m²] of each observation."""

    def root(part: str) -> float | None:
        own = [variances(e)[e.parts[part]] for e in result.observations if part in e.parts]
        return 1e3 * math.sqrt(max(float(np.concatenate(own).mean()), 0.0)) if own else None

    return {part: root(part) for part in PARTS}


def _observation_variance(observation: Observation) -> np.ndarray:
    """Expected errors of the observation: noise, and errors of following points."""
    return observation.observation_std**2


def _discretization_variance(observation: Observation) -> np.ndarray:
    """By how much one grid more may differ."""
    return observation.residual_std**2 - observation.observation_std**2


def _grid_change(result: RefineResult, fitted: ModelFit) -> float | None:
    """Factor of what finer grids change on average, mean over the observations; None if it was not fitted."""
    factors = [fitted.values.get(f"{GRID_CORRECTION}@{e.name}") for e in result.observations]
    known = [f for f in factors if f is not None]
    return float(np.mean(known)) if known else None


def _credible_set(first: Round | None) -> list[dict[str, Any]]:
    """Sets of effects of the first round, the most probable first."""
    if first is None or first.posterior is None:
        return []
    sets = first.posterior.credible_answers()
    return [{"effects": sorted(effects), "probability": p} for effects, p in sets.items()]


def _probability(first: Round, effect: str) -> float | None:
    """Of the model with ``effect`` alone; None if it was not fitted."""
    if first.posterior is None:
        return None
    return first.posterior.sets().get(frozenset({*first.base.model.effects, effect}))


def _test(found: Forecast) -> dict[str, float]:
    return {"rmse_mm": found.found_mm, "expected_rmse_mm": found.expected_mm, "log_density": found.log_density}


def _upper_limit(result: RefineResult, limit: UpperLimit) -> dict[str, Any]:
    term = result.forward_model.term(limit.effect)
    return {
        "effect": term.effect,
        "scope": scope_of(term),
        "strength": limit.strength,
        "unit": term.units[term.strengths[0].name],
        "motion_mm": limit.motion_mm,
        "determined": limit.determined,
        "reason": limit.reason,
    }


def _candidate(result: RefineResult, candidate: Candidate, first: Round) -> dict[str, Any]:
    term = result.forward_model.term(candidate.effect)
    sizes = [candidate.theta[p.name] for p in term.strengths]
    errors = [candidate.stderr[p.name] for p in term.strengths]
    one = len(sizes) == 1
    return {
        "effect": term.effect,
        "scope": scope_of(term),
        "explained": candidate.explained,
        "theta": sizes[0] if one else math.hypot(*sizes),
        "unit": term.units[term.strengths[0].name],
        "stderr": errors[0] if one else math.hypot(*errors),
        "parameters": {_short(term, n): v for n, v in candidate.theta.items()},
        "probability": _probability(first, candidate.effect),
        "looks_like": effect_named(term.effect).looks_like,
    }


def _failure(result: RefineResult, name: str, reason: str) -> dict[str, Any]:
    term = result.forward_model.term(name)
    return {"effect": term.effect, "scope": scope_of(term), "reason": reason}


def _parameters(term: EffectTerm, fitted: ModelFit) -> dict[str, Any]:
    return {
        "theta": {_short(term, p.name): fitted.values[p.name] for p in term.parameters},
        "stderr": {_short(term, p.name): fitted.stderr.get(p.name) for p in term.parameters},
        "unit": {_short(term, p.name): term.units[p.name] for p in term.parameters},
    }


def _accepted(result: RefineResult, term: EffectTerm, fitted: ModelFit) -> dict[str, Any]:
    place = result.places.get(term.name)
    shown = _parameters(term, fitted)
    gravity = result.forward_model.effect_gravity(0)
    carried = carried_weight(term.effect, shown["theta"], gravity)
    others = alternatives(term.name, fitted, result.search.rounds)
    return {
        "effect": term.effect,
        "scope": scope_of(term),
        "bodies": list(term.bodies),
        **shown,
        "carried_weight": carried,
        "carried_weight_stderr": None
        if carried is None
        else carried_weight_stderr(term.effect, shown["stderr"], gravity),
        "world": vectors_in_world(term, fitted.values, fitted.stderr, result.forward_model.effect_axes(0)),
        "indistinguishable_from": list(others),
        "alternatives": others,
        **({} if place is None else {"place_in_body": {"value": list(place), "unit": "m"}}),
    }


def _discrepancy(result: RefineResult) -> dict[str, Any] | None:
    """A smooth force for what is unexplained; in no sense a cause."""
    fitted = result.search.discrepancy
    if fitted is None:
        return None
    term = result.forward_model.term(DISCREPANCY_FORCE)
    return {
        "effect": DISCREPANCY_FORCE, **_parameters(term, fitted),
        "fit_rmse_mm": fitted.fit_mm, "validation_rmse_mm": fitted.validation_mm, "test_rmse_mm": fitted.test_mm,
        "share": share(result), "peak": peak(sampled_fields(result)), "in_twin": result.force_in_twin,
    }  # fmt: skip


def _errors(result: RefineResult, fitted: ModelFit) -> dict[str, Any]:
    """[mm] over the instants of each part that there is."""
    known = {part: part_mm(fitted.fields, result.observations, part) for part in PARTS}
    return {part: {"trajectory_rmse_mm": value} for part, value in known.items() if value is not None}


def _round(result: RefineResult, done: Round) -> dict[str, Any]:
    """The refits that competed, best first, what could not be simulated, and effects that were exchanged after it."""
    return {
        "base": {"law": done.base.model.family.kind, "effects": list(done.base.model.effects)},
        "refits": [_refit(result, done, t) for t in done.trials],
        "not_fitted": [{**_failure(result, f.effect, f.reason), "law": f.law} for f in done.failures],
        "exchanges": [{"old": x.old, "new": x.new, "log_bayes_factor": x.log_bayes_factor} for x in done.exchanges],
    }


def _refit(result: RefineResult, done: Round, trial: Trial) -> dict[str, Any]:
    term = result.forward_model.term(trial.effect)
    fitted = trial.fitted
    return {
        "law": trial.law,
        "effect": term.effect,
        "scope": scope_of(term),
        "explained": trial.candidate.explained,
        "fit_rmse_mm": fitted.fit_mm,
        "validation_rmse_mm": fitted.validation_mm,
        "parameters": {
            _short(term, p.name): {"value": fitted.values[p.name], "stderr": fitted.stderr.get(p.name)}
            for p in term.parameters
        },
        "log_bayes_factor": trial.log_bayes_factor,
        "accepted": done.accepted is trial,
        "converged": trial.converged,
        "impossible": list(trial.impossible),
        "not_weighed": trial.not_weighed,
    }


def _observations(result: RefineResult) -> list[dict[str, Any]]:
    """Errors [mm] of each observation, over the instants of each part."""
    rows = []
    for e, before, after in zip(result.observations, result.before.fields, result.after.fields, strict=True):
        rows.append({
            "observation": e.name,
            "instants": {name: len(before[part]) for name, part in e.parts.items()},
            "before_mm": {name: rms_mm([before[part]]) for name, part in e.parts.items()},
            "after_mm": {name: rms_mm([after[part]]) for name, part in e.parts.items()},
        })  # fmt: skip
    return rows


def _unexplained(result: RefineResult) -> dict[str, Any]:
    """What is left, and where and when it is largest."""
    by_instant = [1e3 * np.sqrt((f**2).sum(2).mean(1)) for f in result.after.fields]
    k = max(range(len(by_instant)), key=lambda k: float(by_instant[k].max()))
    observation, instant = result.observations[k], int(by_instant[k].argmax())
    by_point = (result.after.fields[k] ** 2).sum(2).mean(0)
    weight = by_point * (by_point >= np.quantile(by_point, 1 - WORST_POINTS))
    place = (weight[:, None] * observation.points_in_world).sum(0) / max(weight.sum(), 1e-300)
    return {
        "rmse_mm": rms_mm(result.after.fields),
        "noise_floor_mm": 1e3 * observation.noise_std,
        "worst_observation": observation.name,
        "worst_time_s": float(observation.times[instant]),
        "worst_instant_rmse_mm": float(by_instant[k][instant]),
        "worst_distance_mm": 1e3 * max(float(np.linalg.norm(f, axis=2).max()) for f in result.after.fields),
        "worst_place_at_start_m": place.tolist(),
        "worst_place_rmse_mm": 1e3 * float(np.sqrt(by_point[weight > 0].mean())) if weight.any() else 0.0,
        "rmse_mm_by_instant": {e.name: v.tolist() for e, v in zip(result.observations, by_instant, strict=True)},
    }


def _body(body: BodyResult) -> dict[str, Any]:
    return {
        "verdict": ADDED if body.effects else NOTHING,
        "effects": list(body.effects),
        "validation_mm": {"before": body.before_mm, "after": body.after_mm},
        "objections": list(body.objections),
    }


def _shared(fit: SharedFit) -> dict[str, Any]:
    p = fit.term.parameters[0]
    return {
        "effect": fit.term.effect, "bodies": list(fit.term.bodies), "parameter": _short(fit.term, p.name),
        "value": fit.fitted.values[p.name], "stderr": fit.fitted.stderr[p.name], "unit": fit.term.units[p.name],
        "std_between_bodies": fit.strength_std, "validation_rmse_mm": fit.fitted.validation_mm,
        "log_bayes_factor": fit.log_bayes_factor,
    }  # fmt: skip


def _proposal(proposal: Proposal) -> dict[str, Any]:
    def state(velocity: np.ndarray, omega: np.ndarray) -> dict[str, Any]:
        return {
            "initial_velocity": {"value": velocity.tolist(), "unit": "m/s"},
            "initial_omega": {"value": omega.tolist(), "unit": "rad/s"},
        }

    return {
        "distinguishes": list(proposal.distinguishes),
        **state(proposal.velocity, proposal.omega),
        "predicted_difference_mm": proposal.difference_mm,
        "present_difference_mm": proposal.present_mm,
        "not_simulated": [{**state(v, w), "reason": reason} for v, w, reason in proposal.not_simulated],
    }
