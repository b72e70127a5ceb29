"""One pass of the search: rank the effects, fit the best through the rollout, weigh them against each other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

from masiv.inference.model_fit import (
    ModelFit,
    common_samples,
)
from masiv.refinement.candidates import Ranking
from masiv.refinement.exchange import with_exchanges
from masiv.refinement.hypotheses import (
    NEGLIGIBLE,
    Posterior,
)
from masiv.refinement.refits import reasons_against, refit_simpler, refit_unconverged, restart_base
from masiv.refinement.round_posterior import RoundPosterior
from masiv.refinement.rounds import Round, Trial, rank_trials
from masiv.refinement.search_state import SearchSettings, SearchState
from masiv.refinement.trials import Attempts, converged, try_effects

MOST_COMPLETED = 4
"""Effects of a round that are fitted to the end before they are judged. Chosen."""
AS_GOOD = 2 * NEGLIGIBLE
"""Difference of the information criterion, twice that of log probabilities, up to which a fit is as good as another."""


def run_round(
    state: SearchState, bases: Sequence[ModelFit], settings: SearchSettings,
    places: Mapping[str, Mapping[str, float]] = MappingProxyType({}),
) -> Round:  # fmt: skip
    """Add one effect to ``state.fit``. bases: fits without that effect to start from, the first to be ranked in
    full. places: where effects are tried in exchange for those of ``state.fit``."""
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
    return _judged(state.with_fit(current), bases, trials, replace(attempts, ranking=ranking), settings, places)


def _with_inapplicable(state: SearchState, ranking: Ranking, settings: SearchSettings) -> Ranking:
    """``ranking`` with a reason for each effect that the configuration names and that cannot be added here."""
    effects = state.fit.model.effects
    known = {state.forward_model.term(n).effect for n in (*effects, *state.forward_model.candidates(state.fit.model))}
    others = {n: "it cannot act here in addition" for n in settings.config.effects if n not in known}
    return replace(ranking, not_ranked={**ranking.not_ranked, **others})


def _judged(
    state: SearchState, bases: Sequence[ModelFit], trials: Sequence[Trial], attempts: Attempts,
    settings: SearchSettings, places: Mapping[str, Mapping[str, float]],
) -> Round:  # fmt: skip
    """The round with the posterior over the models without (``bases``) and with one effect more (``trials``). What may
    act is fitted to the end before it is judged, and models are weighed at the mean of their posterior. If no effect is
    named, those that were named before are exchanged in the most probable model with one more, if that may hold."""
    without, fewer = [state.fit, *bases[1:]], len(state.fit.model.effects)
    judged = RoundPosterior.of(state, without, trials, settings)
    for _ in range(MOST_COMPLETED):
        trial = _to_be_completed(judged.posterior, judged.trials, fewer)
        if trial is None:
            break
        judged = judged.with_completed(state, without, trial, settings)
    trial = _most_probable(judged.posterior, judged.trials, fewer)
    while trial is not None and not trial.completed and _named(judged.posterior, fewer, settings):
        judged = judged.with_completed(state, without, trial, settings)
        trial = _most_probable(judged.posterior, judged.trials, fewer)
    if trial is not None and _named(judged.posterior, fewer, settings):
        judged = judged.with_restarted(state, trial, settings)
        trial = _most_probable(judged.posterior, judged.trials, fewer)
    if trial is not None and _named(judged.posterior, fewer, settings):
        settings.progress("refine: weigh on finer grids", 0, 1, trial.effect)
        judged = judged.with_other_grids(state, trial, settings)
        settings.progress("refine: weigh on finer grids", 1, 1, trial.effect)
        trial = _most_probable(judged.posterior, judged.trials, fewer)
    named, exchanges = trial is not None and _named(judged.posterior, fewer, settings), ()
    if trial is not None and not named and frozenset(trial.fitted.model.effects) in judged.posterior.credible_set():
        other, exchanges = with_exchanges(state.with_fit(trial.fitted), places, settings)
        if exchanges:
            exchanged = replace(trial, fitted=other.fit, impossible=(), completed=True)
            judged = judged.with_ended(state, without, exchanged, judged.trials, settings)
            trial = _most_probable(judged.posterior, judged.trials, fewer)
            exchanged_is_best = trial is not None and trial.fitted.values == other.fit.values
            named = exchanged_is_best and _named(judged.posterior, fewer, settings)
    current = judged.posterior.best(fewer)
    base = current.with_posterior() if current is not None else state.fit
    accepted = trial if named else None
    return Round(
        base, attempts.ranking, judged.trials, accepted, judged.posterior, attempts.failures,
        exchanges if named else (),
    )  # fmt: skip


def _named(posterior: Posterior, fewer: int, settings: SearchSettings) -> bool:
    return posterior.with_at_most(fewer) < settings.config.max_null_probability


def _to_be_completed(posterior: Posterior, trials: Sequence[Trial], fewer: int) -> Trial | None:
    """What is to be fitted to the end: the most probable effect if it may act, else the nearest fit of those that are
    as good as the best. Far from where a fit ends its evidence is wrong. None if all of them have ended."""
    first = _most_probable(posterior, trials, fewer)
    if first is not None and not first.completed and frozenset(first.fitted.model.effects) in posterior.credible_set():
        return first
    weighed = {id(t): t.log_bayes_factor for t in trials if t.log_bayes_factor is not None and not t.impossible}
    if not weighed or max(weighed.values()) < -NEGLIGIBLE:
        return None
    possible = [t for t in trials if id(t) in weighed]
    samples = common_samples([t.fitted for t in possible])
    best = min(t.fitted.bic(samples) for t in possible)
    close = [t for t in possible if not t.completed and t.fitted.bic(samples) < best + AS_GOOD]
    return min(close, key=lambda t: t.fitted.bic(samples), default=None)


def _most_probable(posterior: Posterior, trials: Sequence[Trial], fewer: int) -> Trial | None:
    """With more than ``fewer`` effects."""
    chosen = posterior.best(fewer + 1)
    return None if chosen is None else next(t for t in trials if t.fitted is chosen.fitted)
