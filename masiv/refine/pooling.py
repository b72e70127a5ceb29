"""Refine several bodies that share physics: what do they lack together, and what each by itself?"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from masiv.errors import InputError, MasivError
from masiv.inference.model_fit import ModelFit, gauss_newton_fit, robust_scale_of
from masiv.models.base import EffectTerm
from masiv.models.free_body import Model
from masiv.models.point_mass import RIGID, PointSimulation, point_runs
from masiv.progress import Progress, silent
from masiv.refine.config import RefineConfig
from masiv.refine.evidence import objections
from masiv.refine.search import SearchResult, search_effects
from masiv.tracks.tracks import Tracks


@dataclass(frozen=True)
class SharedFit:
    """An effect that several bodies have, with one strength for them all. gain: how much lower the information
    criterion is than with one strength each (negative: the data asks for one each)."""

    effect: str
    bodies: tuple[str, ...]
    fitted: ModelFit
    gain: float


@dataclass(frozen=True)
class GroupRefined:
    """before, after: fields of all runs, see ``PointSimulation.fields``. refused: what an effect that was accepted for
    all, one strength each, came to for a body by itself: body -> reasons against it."""

    result: SearchResult
    simulation: PointSimulation
    before: list[np.ndarray]
    after: list[np.ndarray]
    refused: dict[str, list[str]] = field(default_factory=dict)
    shared: tuple[SharedFit, ...] = ()


def refine_group(
    tracks: Tracks, group: str, config: RefineConfig, *, dry_run: bool = False, progress: Progress = silent
) -> GroupRefined:
    """Look for what the flights of ``group`` lack; runs with ``use: hold_out`` judge it.

    An effect of the surroundings is one for all bodies. One that depends on the body is tried for all with one
    strength, for all with one each, and for each body alone. A strength is shared only where no body's held-out flight
    gets worse by it; of one strength each, a body keeps its own where its own flights confirm it.
    Raises InputError where nothing is held out.
    """
    simulation = PointSimulation(tracks, point_runs(tracks, group))
    for body in simulation.bodies:
        if {run.fitted for run in simulation.observations if run.body == body} != {True, False}:
            raise InputError(f"{tracks.path}: body {body} needs a run to fit and one with `use: hold_out` to judge by")
    base = baseline(simulation)
    config = config.model_copy(update={"search_second_effect": False})  # every body is looked at by itself already
    if dry_run:
        searched = config.model_copy(update={"shortlist": 0, "above_noise": 0.0})
    else:
        more = len(simulation.bodies)  # flights cost nothing: try all that a body may have of its own
        searched = config.model_copy(
            update={"max_effects": config.max_effects + more, "shortlist": config.shortlist + 2 * more}
        )
    result = search_effects(simulation, [base], searched, progress)
    result, refused = confirmed(simulation, result, config)
    fields = [simulation.fields(f.model, f.values, held_out=True) for f in (result.before, result.after)]
    return GroupRefined(result, simulation, fields[0], fields[1], refused, shared(simulation, result))


def baseline(
    simulation: PointSimulation, model: Model | None = None, values: Mapping[str, float] | None = None
) -> ModelFit:
    """Free fall, where only the start of each run is fitted; or ``model``, from ``values``."""
    model = model or Model(RIGID, "none")
    return gauss_newton_fit(simulation, model, values or {}, budget=12 * (len(simulation.parameters(model)) + 1))


def confirmed(
    simulation: PointSimulation, result: SearchResult, config: RefineConfig
) -> tuple[SearchResult, dict[str, list[str]]]:
    """``result`` where of an effect with one strength each only those bodies keep it whose own flights confirm it, by
    the loop's own rules; and the objections of the others. Standard errors are from each body's own flights."""
    after, refused = result.after, {}
    for term in [simulation.term(name) for name in after.model.effects]:
        if len(term.bodies) < 2:
            continue
        others = Model(after.model.family, "none", tuple(n for n in after.model.effects if n != term.name))
        kept, values, stderr = [], dict(after.values), {}
        for body in term.bodies:
            own = simulation.made(term.effect, (body,))
            # Not from nothing: a fit that begins on a bound hardly leaves it.
            start = {
                p.name: max(after.values[q.name], p.step)
                for p, q in zip(own.parameters, simulation.own(term, body), strict=True)
            }
            found = _alone(simulation, body, others, {**after.values, **start}, own, config)
            if isinstance(found, ModelFit):
                kept.append(own.name)
                values |= found.values
                stderr |= {p.name: found.stderr[p.name] for p in own.parameters}
            else:
                refused[body] = found
        model = replace(others, effects=(*others.effects, *kept))
        after = gauss_newton_fit(
            simulation,
            model,
            values,
            budget=3 * (len(simulation.parameters(model)) + 1),
            robust_scale=soft_of(simulation, result),
        )
        after = replace(after, stderr={**after.stderr, **stderr})
    if not after.model.effects:
        after = result.before
    return replace(result, after=after), refused


def _alone(
    simulation: PointSimulation, body: str, others: Model, values: Mapping[str, float], own: EffectTerm,
    config: RefineConfig,
) -> ModelFit | list[str]:  # fmt: skip
    """The fit of ``own`` to the flights of ``body`` alone, or the reasons against it."""
    one = simulation.alone(body, others, values)
    try:
        without = baseline(one, others, values)
        tried = baseline(one, others.with_effect(own.name), values)
    except MasivError as failed:
        return [str(failed)]
    reasons = [*objections(without, tried, own, one.observations, config), *one.objections(without, tried, own, config)]
    return reasons or tried


def soft_of(simulation: PointSimulation, result: SearchResult) -> float:
    """Size [m] from which a residual of the outcome counts as wild."""
    return robust_scale_of(simulation.residual(result.before.model, result.before.values))


def shared(simulation: PointSimulation, result: SearchResult) -> tuple[SharedFit, ...]:
    """Effects accepted for two bodies or more, each refitted with one strength for those."""
    after, out = result.after, []
    terms = [simulation.term(name) for name in after.model.effects]
    for effect in dict.fromkeys(t.effect for t in terms if t.bodies):
        parts = [t for t in terms if t.effect == effect]
        if len(parts) < 2:
            continue
        bodies = tuple(b for t in parts for b in t.bodies)
        one = simulation.made(effect, bodies)
        kept = tuple(n for n in after.model.effects if simulation.term(n) not in parts)
        model = replace(after.model, effects=(*kept, one.name))
        start = {
            p.name: float(np.mean([after.values[q.parameters[k].name] for q in parts]))
            for k, p in enumerate(one.parameters)
        }
        budget = 6 * (len(after.parameters) + 1)
        fitted = gauss_newton_fit(
            simulation, model, {**after.values, **start}, budget=budget, robust_scale=soft_of(simulation, result)
        )
        out.append(SharedFit(effect, bodies, fitted, after.bic(after.samples) - fitted.bic(after.samples)))
    return tuple(out)


def unlike(fits: SharedFit, result: SearchResult, simulation: PointSimulation) -> float:
    """How far bodies differ in the first strength that ``fits`` gives them in common: standard deviation."""
    own = [
        result.after.values[t.parameters[0].name]
        for t in (simulation.term(n) for n in result.after.model.effects)
        if t.effect == fits.effect and t.bodies
    ]
    return float(np.std(own, ddof=1)) if len(own) > 1 else math.nan
