"""The search: rank the effects, fit the best through the rollout, accept what is probable, and again."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

from masiv.errors import MasivError
from masiv.inference.discretization import with_residual_std
from masiv.inference.evidence import Evidence
from masiv.inference.model_fit import ModelFit, rank_by_bic, refit_whitened
from masiv.inference.predictive import forecast, predictive_p
from masiv.inference.robust import robust_scale_of
from masiv.models.base import EffectTerm, ForwardModel
from masiv.refinement.discrepancy import discrepancy_force
from masiv.refinement.effect_fit import BROYDEN_STEPS
from masiv.refinement.exchange import with_exchanges
from masiv.refinement.hypotheses import log_prior
from masiv.refinement.limits import UpperLimit, limit_of_fit, places_to_limit, sensitivities, upper_limit
from masiv.refinement.posterior_fit import posterior_fit
from masiv.refinement.rounds import Check, Round, SearchResult
from masiv.refinement.search_round import run_round
from masiv.refinement.search_state import SearchSettings, SearchState
from masiv.refinement.tasks import map_tasks
from masiv.workers import TaskError, Workers

MIN_ROBUST_SCALE = 5.0
"""Robust scale of the search over the noise of the noisiest observation, at the least: the whitened residual of an
observation has its own ``noise_std``, and noise is no outlier in any of them."""
WHITENING_PASSES = 2
"""How often the best law is chosen: the one that is best before ``residual_std`` is known may not be it."""
SUBSTEP_PASSES = 4
"""How often a law is fitted, with shorter substeps each time: from one to the next its modulus may double."""
RIVALS = 1
"""Further models on top of which one effect more is looked for: effects take each other over."""


def search_effects(
    forward_model: ForwardModel, baselines: Sequence[ModelFit], settings: SearchSettings
) -> SearchResult:
    """Add effects to the best of ``baselines`` (one a law, without effects) as long as one more is probable. Raises
    MasivError if no baseline can be simulated."""
    start, laws = whitened_start(forward_model.with_workers(settings.workers), baselines, settings)
    state, rounds = _add_effects(start, laws, settings)
    before = rounds[0].base if rounds else start.fit
    if settings.rank_only:
        return SearchResult(
            state.forward_model.with_workers(Workers()), before, before, tuple(rounds),
            whitened_before=start.forward_model.with_workers(Workers()),
        )  # fmt: skip
    before = posterior_fit(start.forward_model, before, start.robust_scale, settings.linearizations)
    after, limits = _settled(state, before, rounds, settings)
    overlooked = [state.forward_model.term(name).effect for name in _overlooked(rounds, limits, settings)]
    left = settings.max_effects - (len(after.model.effects) - len(before.model.effects))
    if overlooked and left > 0:
        state, more = _add_effects(
            state.with_fit(after), [after], replace(settings.for_effects(overlooked), max_effects=1)
        )
        rounds += more
        if more[-1].accepted is not None and left > 1:  # with what was overlooked, others may be probable
            state, rest = _add_effects(state, [state.fit], replace(settings, max_effects=left - 1))
            rounds += rest
        after, limits = _settled(state, before, rounds, settings)
    checked = {"before": _check(start, before, settings)}
    checked["after"] = checked["before"] if after is before else _check(state, after, settings)
    discrepancy = None
    if settings.discrepancy_force and checked["after"].p < settings.config.min_predictive_p:
        discrepancy = discrepancy_force(state.with_fit(after), settings)
    null = min((r.posterior.with_at_most(0) for r in rounds if r.posterior and not r.base.model.effects), default=1.0)
    if after is before:
        null = _with_unfitted(null, rounds, limits)
    unknown = rounds[-1].posterior.unknown() if rounds and rounds[-1].posterior else 0.0
    return SearchResult(
        state.forward_model.with_workers(Workers()), before, after, tuple(rounds), null, unknown, checked,
        tuple(limits), discrepancy, whitened_before=start.forward_model.with_workers(Workers()),
    )  # fmt: skip


def whitened_start(
    forward_model: ForwardModel, baselines: Sequence[ModelFit], settings: SearchSettings
) -> tuple[SearchState, list[ModelFit]]:
    """The best of ``baselines``, and all of them that compete, best first, fitted again with ``residual_std`` as the
    best of them moves. The order is that of the information criterion; evidence decides in the rounds."""
    observation_std = [e.observation_std for e in forward_model.observations]
    first = min(baselines, key=lambda f: f.cost)
    state, laws = SearchState(forward_model, first, observation_std, 0.0), [first]
    for _ in range(WHITENING_PASSES):
        whitened = with_residual_std(state.forward_model, first, observation_std)
        scale = max(
            robust_scale_of(whitened.residual(first.model, first.values)),
            MIN_ROBUST_SCALE * max(e.noise_std for e in whitened.observations),
        )
        settings.progress("refine: fit whitened residuals", 0, 1, "")
        again = rank_by_bic(_fitted_again(whitened, baselines, scale, settings.workers))
        settings.progress("refine: fit whitened residuals", 1, 1, "")
        laws = again[: settings.config.families]
        state = replace(state, forward_model=whitened, robust_scale=scale)
        if laws[0].model == first.model:
            break
        first = laws[0]
    return state.with_fit(laws[0]), laws


def _fitted_again(
    forward_model: ForwardModel, baselines: Sequence[ModelFit], robust_scale: float, workers: Workers
) -> list[ModelFit]:
    """``refit_whitened`` of ``baselines``; those that the substep stopped, again with shorter ones."""
    fits: list[ModelFit] = []
    todo = list(baselines)
    for left in reversed(range(SUBSTEP_PASSES)):
        tasks = [(base, BROYDEN_STEPS, robust_scale) for base in todo]
        todo = []
        for fit in fits_of(map_tasks(workers, forward_model, refit_whitened, tasks)):
            stopped = left > 0 and forward_model.shorten_substeps(fit.model, fit.values)
            (todo if stopped else fits).append(fit)
        if not todo:
            break
    return fits


def fits_of(results: Iterable[ModelFit | TaskError]) -> list[ModelFit]:
    """The fits among ``results``. Raises the first error if there is none."""
    fits, failed = [], None
    for result in results:
        if isinstance(result, TaskError):
            failed = failed or result
        else:
            fits.append(result)
    if not fits:
        raise failed.kind(failed.reason) if failed else MasivError("refine: there is no law to start from")
    return fits


def _add_effects(
    state: SearchState, laws: Sequence[ModelFit], settings: SearchSettings
) -> tuple[SearchState, list[Round]]:
    rounds: list[Round] = []
    bases = list(laws)
    while len(rounds) < settings.max_effects:
        done = run_round(state, bases, settings, _places(rounds[0]) if rounds else {})
        rounds.append(done)
        if done.accepted is None:
            # Standard errors are those of the posterior; the model is the one that the last round confirmed.
            return state.with_fit(done.base), rounds
        settings.progress("refine: fit whitened residuals", 0, 1, "")
        state, rivals = state.with_fit(done.accepted.fitted).whitened_again(_rivals(done), settings.workers)
        settings.progress("refine: fit whitened residuals", 1, 1, "")
        state, exchanges = with_exchanges(state, _places(rounds[0]), settings)
        if exchanges:
            rounds[-1], rivals = replace(done, exchanges=(*done.exchanges, *exchanges)), []
        bases = [state.fit, *rivals]
    return state, rounds


def _places(first: Round) -> dict[str, dict[str, float]]:
    """Where the first ranking saw effects: their parameters."""
    return {c.effect: dict(c.theta) for c in first.candidates}


def _settled(
    state: SearchState, before: ModelFit, rounds: Sequence[Round], settings: SearchSettings
) -> tuple[ModelFit, list[UpperLimit]]:
    """The final model with values of its posterior, ``before`` if nothing was added; and limits of all else."""
    added = len(state.fit.model.effects) > len(before.model.effects)
    after = before
    if added:
        after = posterior_fit(state.forward_model, state.fit, state.robust_scale, settings.linearizations)
    return after, _upper_limits(state.with_fit(after), rounds, settings)


def _overlooked(rounds: Sequence[Round], limits: Sequence[UpperLimit], settings: SearchSettings) -> list[str]:
    """Effects that would be named if the linear model of the limits were right, and were not fitted, or in vain: the
    ranking counts what an effect explains of all errors, most of which may not be of its kind."""
    known = _weighed_effects(rounds) | {f.effect for r in rounds for f in r.failures}
    named = math.log(1 / settings.config.max_null_probability - 1)
    once = log_prior(1, len(limits)) - log_prior(0, len(limits)) if limits else 0.0
    return [x.effect for x in limits if x.effect not in known and x.log_bayes_factor + once > named]


def _weighed_effects(rounds: Sequence[Round]) -> set[str]:
    """Effects whose refit reached what the ranking promised and has an evidence, or cannot act: only these can be told
    not to act."""
    trials = [t for r in rounds for t in r.trials if t.converged]
    return {t.effect for t in trials if t.impossible or t.log_bayes_factor is not None}


def _with_unfitted(null: float, rounds: Sequence[Round], limits: Sequence[UpperLimit]) -> float:
    """Probability that no effect acts, effects that were not fitted through the rollout, or in vain, included: their
    evidence is that of the linear model."""
    fitted = _weighed_effects(rounds)
    once = math.exp(log_prior(1, len(limits)) - log_prior(0, len(limits))) if limits else 0.0
    odds = (
        1 / max(null, 1e-300)
        - 1
        + sum(once * math.exp(min(x.log_bayes_factor, 700.0)) for x in limits if x.effect not in fitted)
    )
    return 1 / (1 + odds)


def _rivals(done: Round) -> list[ModelFit]:
    """What may act in place of what was accepted, with the same law; most probable first."""
    assert done.accepted is not None
    assert done.posterior is not None
    here = done.accepted.fitted.model
    credible = done.posterior.credible_set()
    own = [
        (p, h.fitted)
        for h, p in zip(done.posterior.hypotheses, done.posterior.probabilities, strict=True)
        if h.law == here.family.kind
        and len(h.effects) == len(here.effects)
        and h.effects != frozenset(here.effects)
        and h.effects in credible
    ]
    return [fitted for _, fitted in sorted(own, key=lambda pair: -pair[0])[:RIVALS]]


def _check(state: SearchState, fitted: ModelFit, settings: SearchSettings) -> Check:
    line = settings.linearizations.of(state.forward_model, fitted)
    terms = [state.forward_model.term(n) for n in fitted.model.effects]
    evidence = Evidence.of(state.forward_model.observations, line.fields)
    found = forecast(evidence, line, terms, evidence.marginal(line, terms))
    return Check(predictive_p(evidence, line, terms), found)


def _upper_limits(state: SearchState, rounds: Sequence[Round], settings: SearchSettings) -> list[UpperLimit]:
    """Of all effects that could act in addition to ``state.fit``, wherever they may act; their Bayes factors are of the
    places where the first ranking saw them. Of those in the last credible set, not below what their own fits allow."""
    model, fitted = state.forward_model, state.fit
    names = settings.considered(model, fitted.model)
    places = _places(rounds[0]) if rounds else {}
    line = settings.linearizations.of(model, fitted)
    terms = [model.term(n) for n in fitted.model.effects]
    evidence = Evidence.of(model.observations, line.fields)
    here = evidence.marginal(line, terms)
    label = "refine: upper limits"
    settings.progress(label, 0, len(names))
    out = []
    tasks = [
        (line, name, places_to_limit(model.term(name), places.get(name, {}), model.observations)) for name in names
    ]
    for done, (name, found) in enumerate(
        zip(names, map_tasks(settings.workers, model, sensitivities, tasks), strict=True)
    ):
        settings.progress(label, done + 1, len(names), name)
        if isinstance(found, TaskError):
            out.append(UpperLimit.unknown(name, found.reason))
        else:
            least = _allowed(model.term(name), fitted, rounds)
            out.append(upper_limit(evidence, line, terms, model.term(name), here, found, least))
    return out


def _allowed(term: EffectTerm, fitted: ModelFit, rounds: Sequence[Round]) -> float:
    """How strong ``term`` may be in addition to ``fitted`` by the fits of the last credible set; 0 if it is in none."""
    posterior = rounds[-1].posterior if rounds else None
    wanted = frozenset((*fitted.model.effects, term.name))
    if posterior is None or wanted not in posterior.credible_set():
        return 0.0
    return max(limit_of_fit(h, term) for h in posterior.hypotheses if h.effects == wanted)
