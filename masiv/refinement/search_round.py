"""One pass of the search: rank the effects, fit the best through the rollout, weigh them against each other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from masiv.effects.catalogue import effect_named
from masiv.errors import MasivError
from masiv.inference.model_fit import (
    ModelFit,
    gauss_newton_fit,
    held_parameters,
    rank_by_bic,
)
from masiv.models.base import EffectTerm, ForwardModel
from masiv.refinement.candidates import Ranking
from masiv.refinement.hypotheses import (
    NEGLIGIBLE,
    Hypothesis,
    Linearized,
    Posterior,
    evidence_of,
    nearly_linearized,
    weighed,
)
from masiv.refinement.refits import refit_simpler, refit_unconverged, restart_base
from masiv.refinement.rounds import Round, Trial, rank_trials
from masiv.refinement.search_state import SearchSettings, SearchState
from masiv.refinement.tasks import map_tasks
from masiv.refinement.trials import Attempts, converged, try_effects
from masiv.workers import TaskError

MOST_COMPLETED = 3
"""Effects of a round that are fitted to the end before they are judged."""


def run_round(state: SearchState, bases: Sequence[ModelFit], settings: SearchSettings) -> Round:
    """Add one effect to ``state.fit``. bases: fits without that effect to start from, the first to be ranked in
    full."""
    attempts = try_effects(state, bases, settings)
    trials, current = rank_trials(attempts.trials), state.fit
    if trials:
        trials = rank_trials(refit_simpler(state, trials, settings))
        trials = rank_trials(refit_unconverged(state, trials, bases, settings))
        if current.model.effects:
            current = restart_base(state, trials[0].fitted)
    ranking = _with_inapplicable(state, attempts.ranking, settings)
    if settings.rank_only:
        return Round(current, ranking, (), None, failures=attempts.failures)
    trials = [
        replace(
            t, impossible=tuple(reasons_against(state.forward_model, t.fitted, t.effect)), converged=converged(t, bases)
        )
        for t in trials
    ]
    return _judged(state.with_fit(current), bases, trials, replace(attempts, ranking=ranking), settings)


def _with_inapplicable(state: SearchState, ranking: Ranking, settings: SearchSettings) -> Ranking:
    """``ranking`` with a reason for each effect that the configuration names and that cannot be added here."""
    effects = state.fit.model.effects
    known = {state.forward_model.term(n).effect for n in (*effects, *state.forward_model.candidates(state.fit.model))}
    others = {n: "it cannot act here in addition" for n in settings.config.effects if n not in known}
    return replace(ranking, not_ranked={**ranking.not_ranked, **others})


def reasons_against(forward_model: ForwardModel, fitted: ModelFit, name: str) -> list[str]:
    """Why the term ``name`` cannot act as it was fitted; empty if it can."""
    term = forward_model.term(name)
    return [*forward_model.impossible(fitted, term), *parameters_at_bounds(fitted, term)]


def parameters_at_bounds(fitted: ModelFit, term: EffectTerm) -> list[str]:
    """Which parameters of ``term`` ran into the bound of what is possible."""
    # What acts on the matter at a place may well be at the body's face, where its place ends.
    bounded = term.strengths if effect_named(term.effect).hints.inside else term.parameters
    return [
        f"{p.name} runs into the bound of what is possible, {p.upper:g}"
        for p in bounded
        if fitted.values[p.name] >= p.upper - 1e-9 * abs(p.upper)
    ]


def _judged(
    state: SearchState, bases: Sequence[ModelFit], trials: Sequence[Trial], attempts: Attempts,
    settings: SearchSettings,
) -> Round:  # fmt: skip
    """The round with the posterior over the models without (``bases``) and with one effect more (``trials``). What may
    act is fitted to the end before it is judged, as the models without it are."""
    without, fewer = [state.fit, *bases[1:]], len(state.fit.model.effects)
    posterior, trials = _posterior(state, without, trials, settings)
    for _ in range(MOST_COMPLETED):
        trial = _to_be_completed(posterior, trials, fewer)
        if trial is None:
            break
        ended = [_completed(state, t, settings) if t is trial else t for t in trials]
        posterior, trials = _posterior(state, without, ended, settings)
    accepted = None
    trial = _most_probable(posterior, trials, fewer)
    if trial is not None and _named(posterior, fewer, settings):
        final = trial if trial.completed else _completed(state, trial, settings)
        trials = [final if t is trial else t for t in trials]
        accepted = final if not final.impossible else None
    current = posterior.best(fewer)
    base = current.with_posterior() if current is not None else state.fit
    return Round(base, attempts.ranking, tuple(trials), accepted, posterior, attempts.failures)


def _named(posterior: Posterior, fewer: int, settings: SearchSettings) -> bool:
    return posterior.with_at_most(fewer) < settings.config.max_null_probability


def _to_be_completed(posterior: Posterior, trials: Sequence[Trial], fewer: int) -> Trial | None:
    """What is to be fitted to the end: the most probable effect if it may act, else that with the nearest fit, unless
    its odds are negligible. Far from where a fit ends its evidence is wrong. None if both have ended."""
    first = _most_probable(posterior, trials, fewer)
    if first is not None and not first.completed and frozenset(first.fitted.model.effects) in posterior.credible_set():
        return first
    factors = {id(t): t.log_bayes_factor for t in trials if t.log_bayes_factor is not None and not t.impossible}
    possible = [t for t in trials if factors.get(id(t), -math.inf) > max([0.0, *factors.values()]) - NEGLIGIBLE]
    nearest = min(possible, key=lambda t: t.fitted.cost, default=None)
    return None if nearest is None or nearest.completed else nearest


def _most_probable(posterior: Posterior, trials: Sequence[Trial], fewer: int) -> Trial | None:
    """With more than ``fewer`` effects."""
    chosen = posterior.best(fewer + 1)
    return None if chosen is None else next(t for t in trials if t.fitted is chosen.fitted)


def _posterior(
    state: SearchState, without: Sequence[ModelFit], trials: Sequence[Trial], settings: SearchSettings
) -> tuple[Posterior, list[Trial]]:
    """Over models ``without`` one effect more and those of ``trials`` that can act; the trials with their evidence,
    most probable first."""
    possible = [t for t in trials if not t.impossible]
    hypotheses, failed = _weighed(state, without, [t.fitted for t in possible], settings)
    simpler = [h.marginal.log_evidence for h in hypotheses if len(h.effects) == len(state.fit.model.effects)]
    if not simpler:  # against what would an effect be probable?
        raise MasivError(f"no model without a further effect can be weighed: {failed[id(state.fit)]}")
    known = {id(h.fitted): h.marginal.log_evidence - max(simpler) for h in hypotheses}
    trials = [
        replace(t, log_bayes_factor=known.get(id(t.fitted)), not_weighed=failed.get(id(t.fitted))) for t in trials
    ]
    trials.sort(key=lambda t: -math.inf if t.log_bayes_factor is None else t.log_bayes_factor, reverse=True)
    causes = settings.causes(state.forward_model, state.fit.model)
    shapes = {name: len(cause) for cause in causes for name in cause}
    return Posterior.of(hypotheses, len(causes), shapes), trials


def _weighed(
    state: SearchState, without: Sequence[ModelFit], fits: Sequence[ModelFit], settings: SearchSettings
) -> tuple[list[Hypothesis], dict[int, str]]:
    """Hypotheses of ``without``, models without the effect that each of ``fits`` adds, and of ``fits``, but for those
    that have no derivatives over all instants; of these, by their id, why not. What is improbable with the derivatives
    of the model without the effect is not looked at more closely."""
    model, workers = state.forward_model, settings.workers
    bases, failed = _linearized(state, without, settings)
    near = {id(f): next((line for other, line in bases if _extends(f, other)), None) for f in fits}
    others, why = _linearized(state, [f for f in fits if near[id(f)] is None], settings)
    rough = [f for f in fits if near[id(f)] is not None]
    tasks = [(f, near[id(f)]) for f in rough]
    lines = list(zip(rough, map_tasks(workers, model, nearly_linearized, tasks), strict=True))
    failed |= why | {id(f): line.reason for f, line in lines if isinstance(line, TaskError)}
    known = [*bases, *others, *((f, line) for f, line in lines if not isinstance(line, TaskError))]
    if not known:
        return [], failed
    evidence = evidence_of(model, known)
    found = weighed(model, known, workers, evidence)
    best = max(h.marginal.log_evidence for h in found)
    close = {
        id(h.fitted) for h in found
        if near.get(id(h.fitted)) is not None and h.marginal.log_evidence > best - NEGLIGIBLE
    }  # fmt: skip
    exact, why = _linearized(state, [f for f in rough if id(f) in close], settings)
    kept = [h for h in found if id(h.fitted) not in close]
    return [*kept, *weighed(model, exact, workers, evidence)], failed | why


def _extends(fit: ModelFit, base: ModelFit) -> bool:
    """Whether ``fit`` is ``base`` with an effect more."""
    one, other = fit.model, base.model
    return one.family == other.family and one.contact == other.contact and set(other.effects) < set(one.effects)


def _linearized(
    state: SearchState, fits: Sequence[ModelFit], settings: SearchSettings
) -> tuple[list[Linearized], dict[int, str]]:
    """``fits`` with their derivatives over all instants; of those that have none, by their id, why not."""
    label, kept, failed = "refine: weigh models", [], {}
    settings.progress(label, 0, len(fits))
    for done, (fit, line) in enumerate(zip(fits, settings.linearizations.each(state.forward_model, fits), strict=True)):
        settings.progress(label, done + 1, len(fits))
        if isinstance(line, TaskError):
            failed[id(fit)] = line.reason
        else:
            kept.append((fit, line))
    return kept, failed


def _completed(state: SearchState, trial: Trial, settings: SearchSettings) -> Trial:
    """``trial`` fitted to the end, its places free if that pays, with the standard errors of its posterior."""
    model, start = state.forward_model, trial.fitted
    final = gauss_newton_fit(
        model, start.model, start.values, budget=2 * len(start.parameters) + 6, robust_scale=state.robust_scale,
        held=held_parameters(model, start),
    )  # fmt: skip
    best = with_free_places(state, min(final, start, key=lambda f: f.cost))
    hypotheses, failed = _weighed(state, [best], [], settings)
    if not hypotheses:
        return replace(trial, fitted=best, impossible=(f"at its best fit, {failed[id(best)]}",))
    done = replace(trial, fitted=hypotheses[0].with_posterior(), completed=True)
    reasons = reasons_against(model, done.fitted, done.effect)
    covers_zero = hypotheses[0].covers_zero(model.term(done.effect))
    if covers_zero:
        reasons.append("its strength cannot be told from zero: another grid or start changes it by as much")
    return replace(done, impossible=tuple(reasons), covers_zero=covers_zero)


def with_free_places(state: SearchState, fitted: ModelFit) -> ModelFit:
    """``fitted`` with what was left at a guess fitted as well, if the information criterion asks for it."""
    if not held_parameters(state.forward_model, fitted):
        return fitted
    budget = 3 * (len(fitted.values) + 1)
    try:
        free = gauss_newton_fit(
            state.forward_model, fitted.model, fitted.values, budget=budget, robust_scale=state.robust_scale
        )
    except MasivError:
        return fitted
    return rank_by_bic([fitted, free])[0]
