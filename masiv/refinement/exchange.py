"""Exchange of effects that were accepted one after the other (sequential replacement; Miller 2002, Subset Selection in
Regression).

A search that adds one effect at a time keeps what it found first, when the others were still missing: a drag that is
linear, and later a force with it, for one that is quadratic. So once a second effect was accepted or may act, each of
those before it is compared with what else may act in its place.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from masiv.errors import NonFiniteError
from masiv.inference.evidence import Evidence
from masiv.inference.linear_model import LinearModel
from masiv.inference.model_fit import ModelFit, gauss_newton_fit, held_parameters
from masiv.models.base import EffectTerm, ForwardModel, Model
from masiv.refinement.hypotheses import NEGLIGIBLE, Hypothesis, evidence_of, weighed
from masiv.refinement.limits import extended, sensitivity
from masiv.refinement.posterior_fit import linearized_at_mean
from masiv.refinement.refits import reasons_against, with_free_places
from masiv.refinement.rounds import Exchange
from masiv.refinement.search_state import SearchSettings, SearchState
from masiv.refinement.tasks import map_tasks
from masiv.workers import TaskError

FITTED = 2
"""Exchanges that are fitted through the rollout, of those that are probable by the linear model. Chosen."""
DERIVATIVES = 4
"""Jacobians that the fit of one may take: it starts where a linear model ends that was made with another effect.
Chosen."""


def with_exchanges(
    state: SearchState, places: Mapping[str, Mapping[str, float]], settings: SearchSettings
) -> tuple[SearchState, tuple[Exchange, ...]]:
    """``state`` with the effects that are most probable in place of those of its fit, one at a time; and what was
    exchanged. The last accepted effect was weighed against others already. places: of effects, where they are tried.
    """
    done: list[Exchange] = []
    for _ in state.fit.model.effects[:-1]:
        found = _best_exchange(state, places, settings, {x.old for x in done})
        if found is None:
            break
        state, exchange = state.with_fit(found[0]), found[1]
        done.append(exchange)
    return state, tuple(done)


def without_effect(line: LinearModel, term: EffectTerm) -> LinearModel:
    """``line`` as its derivatives say that it is without ``term``: with a strength of zero, and no place of it."""
    own = {p.name for p in term.parameters}
    names = [p.name for p in line.parameters]
    kept = [k for k, name in enumerate(names) if name not in own]
    fields = [f.copy() for f in line.fields]
    for p in term.strengths:
        if p.name in names:
            for field, jacobian in zip(fields, line.jacobians, strict=True):
                field -= p.fitted(line.values[p.name]) * jacobian[..., names.index(p.name)]
    return replace(
        line, model=_without(line.model, term.name), fields=fields,
        values={name: value for name, value in line.values.items() if name not in own},
        parameters=tuple(line.parameters[k] for k in kept), jacobians=[j[..., kept] for j in line.jacobians],
    )  # fmt: skip


def _without(model: Model, name: str) -> Model:
    return replace(model, effects=tuple(n for n in model.effects if n != name))


def _best_exchange(
    state: SearchState, places: Mapping[str, Mapping[str, float]], settings: SearchSettings, gone: set[str]
) -> tuple[ModelFit, Exchange] | None:
    """The exchange of one effect that makes the data most probable, fitted; None if there is none. gone: effects that
    were exchanged already."""
    model, here = state.forward_model, state.fit
    settings.progress("refine: exchange effects", 0, 1, "")
    try:
        line = settings.linearizations.of(model, here)
    except NonFiniteError:  # a round can do without the derivatives of its base, an exchange cannot
        return None
    fits = {}
    probable = _probable(state, line, places, settings, gone)[:FITTED]
    for old, new, values in (*_excluded(state, places, settings, gone), *probable):
        other = _without(here.model, old).with_effect(new)
        held = held_parameters(model, here) | {p.name for p in model.term(new).others}
        fits[old, new] = other, values, frozenset(name for name in held if name in values)
    tasks = [(*own, state.robust_scale) for own in fits.values()]
    fitted = dict(zip(fits, map_tasks(settings.workers, model, _fitted, tasks), strict=True))
    possible = {
        pair: with_free_places(state, fit)
        for pair, fit in fitted.items()
        if not isinstance(fit, TaskError) and not reasons_against(model, fit, pair[1])
    }
    settings.progress("refine: exchange effects", 1, 1, ", ".join(f"{old} for {new}" for old, new in possible))
    lines = zip(possible.items(), settings.linearizations.each(model, list(possible.values())), strict=True)
    known = {pair: (fit, own) for (pair, fit), own in lines if not isinstance(own, TaskError)}
    if not known:
        return None
    pairs = [(here, line), *known.values()]
    evidence = evidence_of(model, pairs)
    at_mean = [
        (fit, linearized_at_mean(model, fit, evidence, state.robust_scale, settings.linearizations)) for fit, _ in pairs
    ]
    first, *others = weighed(model, at_mean, settings.workers, evidence)
    (old, new), best = max(zip(known, others, strict=True), key=lambda row: row[1].marginal.log_evidence)
    factor = best.marginal.log_evidence - first.marginal.log_evidence
    return (best.with_posterior(), Exchange(old, new, factor)) if factor > 0 else None


def _fitted(
    forward_model: ForwardModel, model: Model, values: dict[str, float], held: frozenset[str], robust_scale: float
) -> ModelFit:
    """Raises NonFiniteError and MasivError."""
    budget = DERIVATIVES * (len(values) - len(held) + 2)
    return gauss_newton_fit(forward_model, model, values, budget=budget, robust_scale=robust_scale, held=held)


def _probable(
    state: SearchState, line: LinearModel, places: Mapping[str, Mapping[str, float]], settings: SearchSettings,
    gone: set[str],
) -> list[tuple[str, str, dict[str, float]]]:  # fmt: skip
    """Exchanges (old, new, values to start from) that the linear model does not rule out, most probable first."""
    model, here = state.forward_model, state.fit
    names = [n for n in settings.considered(model, here.model) if n not in gone]
    plain = [n for n in names if not model.term(n).replaces_parameter]
    tasks = [(line, name, dict(places.get(name, {}))) for name in plain]
    found = dict(zip(plain, map_tasks(settings.workers, model, sensitivity, tasks), strict=True))
    terms = [model.term(n) for n in here.model.effects]
    evidence = Evidence.of(model.observations, line.fields)
    own = evidence.marginal(line, terms)
    out = []
    for old in terms[:-1]:
        if old.replaces_parameter:
            continue
        rest = without_effect(line, old)
        for name, columns in found.items():
            if isinstance(columns, TaskError):
                continue
            term = model.term(name)
            joined = extended(rest, term, *columns)
            marginal = evidence.marginal(joined, [*(t for t in terms if t is not old), term], near=own)
            if marginal.log_evidence > own.log_evidence - NEGLIGIBLE:
                values = Hypothesis(here, joined, marginal).mean_values(columns[0])
                out.append((marginal.log_evidence, old.name, name, _of(model, rest.model.with_effect(name), values)))
    return [row[1:] for row in sorted(out, key=lambda row: -row[0])]


def _excluded(
    state: SearchState, places: Mapping[str, Mapping[str, float]], settings: SearchSettings, gone: set[str]
) -> list[tuple[str, str, dict[str, float]]]:
    """Exchanges (old, new, values to start from) for what can act only without the old effect, such as another contact
    with the ground: it has no linear model beside it."""
    model, here = state.forward_model, state.fit
    beside = {*here.model.effects, *settings.considered(model, here.model), *gone}
    out = []
    for old in here.model.effects[:-1]:
        rest = _without(here.model, old)
        for new in settings.considered(model, rest):
            if new in beside or new not in places or model.term(old).replaces_parameter:
                continue
            start = {**places[new], **here.values}
            parameters = model.parameters(rest.with_effect(new))
            out.append((old, new, {p.name: start.get(p.name, p.start) for p in parameters}))
    return out


def _of(forward_model: ForwardModel, model: Model, values: Mapping[str, float]) -> dict[str, float]:
    """Those of ``values`` that ``model`` has."""
    return {p.name: values[p.name] for p in forward_model.parameters(model) if p.name in values}
