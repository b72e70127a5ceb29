"""The search: rank the effects, fit the best through the rollout, accept what held-out data confirms, and again."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from masiv.errors import MasivError
from masiv.inference.discretization import with_grid_errors, with_residual_std
from masiv.inference.model_fit import ModelFit, rank_by_bic, refit_whitened
from masiv.inference.robust import robust_scale_of
from masiv.models.base import ForwardModel
from masiv.refinement.candidates import score
from masiv.refinement.effect_fit import BROYDEN_STEPS, fit_with_effect
from masiv.refinement.evidence import above_noise, select_by_validation, statistical_objections
from masiv.refinement.rounds import Round, SearchResult
from masiv.refinement.search_round import run_round
from masiv.refinement.search_state import SearchSettings, SearchState
from masiv.refinement.second_effect import search_second_effect
from masiv.refinement.tasks import map_tasks
from masiv.workers import TaskError

DISCREPANCY_FORCE = "smooth_force"
"""The effect that stands in for what no effect of the library explains."""
MIN_ROBUST_SCALE = 5.0
"""Robust scale of the search over the noise of the first observation, at the least."""
WHITENING_PASSES = 2
"""How often the best law is chosen: the one that is best before ``residual_std`` is known may not be it."""


def search_effects(
    forward_model: ForwardModel, baselines: Sequence[ModelFit], settings: SearchSettings
) -> SearchResult:
    """Add effects to the best of ``baselines`` (one a law, without effects) until none is confirmed, or the residual is
    near the noise. Raises MasivError if no baseline can be simulated."""
    start, laws = whitened_start(forward_model, baselines, settings)
    state, rounds = _add_effects(start, laws, settings)
    state, rounds = _reject_unexplained(start, state, rounds, settings)
    discrepancy = None
    wanted = settings.discrepancy_force and not settings.rank_only
    if wanted and state.reduced_chi > settings.config.max_reduced_chi:
        discrepancy = discrepancy_force(state, settings)
    after = with_grid_errors(state.forward_model.observations, state.fit, state.robust_scale)
    before = after if state.fit is start.fit else start.fit
    return SearchResult(state.forward_model, before, after, tuple(rounds), discrepancy)


def whitened_start(
    forward_model: ForwardModel, baselines: Sequence[ModelFit], settings: SearchSettings
) -> tuple[SearchState, list[ModelFit]]:
    """The best of ``baselines``, and all of them that compete, best first, fitted again with ``residual_std`` as the
    best of them moves. That one is the simplest that predicts the motion, since a law that takes an effect over in the
    fitted instants is exposed by the others; the rest are in the order of the information criterion."""
    observation_std = [e.residual_std for e in forward_model.observations]
    first = min(baselines, key=lambda f: f.cost)
    state, laws = SearchState(forward_model, first, observation_std, 0.0), [first]
    for _ in range(WHITENING_PASSES):
        whitened = with_residual_std(state.forward_model, first, observation_std)
        scale = max(
            robust_scale_of(whitened.residual(first.model, first.values)),
            MIN_ROBUST_SCALE * whitened.observations[0].noise_std,
        )
        settings.progress("refine: fit whitened residuals", 0, 1, "")
        tasks = [(base, BROYDEN_STEPS, scale) for base in baselines]
        again = rank_by_bic(fits_of(map_tasks(settings.workers, whitened, refit_whitened, tasks)))
        settings.progress("refine: fit whitened residuals", 1, 1, "")
        laws = again[: settings.config.families]
        state = replace(state, forward_model=whitened, robust_scale=scale)
        best = select_by_validation(laws, state.noise)
        laws.sort(key=lambda f, best=best: f is not best)
        if best.model == first.model:
            break
        first = best
    return state.with_fit(laws[0]), laws


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
    config = settings.config
    bases = laws
    while len(rounds) < settings.max_effects and (settings.rank_only or above_noise(state.fit, state.noise, config)):
        done = run_round(state, bases, settings)
        rounds.append(done)
        if done.accepted is None:
            return state.with_fit(done.base), rounds
        state = state.with_fit(done.accepted.fitted)
        look = settings.search_second_effect and len(rounds) < settings.max_effects
        if state.reduced_chi < config.max_reduced_chi and not look:
            break
        state = state.whitened_again()
        bases = [state.fit]
        if state.reduced_chi < config.max_reduced_chi:
            if look:
                second = search_second_effect(state, done, settings)
                return state.with_fit(second.fit), [*rounds[:-1], second.first, *second.rounds]
            break
    return state, rounds


def _reject_unexplained(
    start: SearchState, state: SearchState, rounds: Sequence[Round], settings: SearchSettings
) -> tuple[SearchState, list[Round]]:
    """``start`` if what was accepted leaves much unexplained and less than half of the residual is gone: what it does
    not explain gets no name. The noise model is then that of ``start``, too."""
    if state.fit is start.fit:
        return state, list(rounds)
    left, there_was = state.reduced_chi, state.noise.reduced_chi(start.fit.squares)
    if left <= max(settings.config.max_reduced_chi, there_was / 2):
        return state, list(rounds)
    why = f"it leaves a residual of {left:.1f} times what noise and discretization explain"
    return start, [_rejected(r, why) for r in rounds]


def _rejected(done: Round, why: str) -> Round:
    if done.accepted is None:
        return done
    trials = [replace(t, objections=(*t.objections, why)) if t is done.accepted else t for t in done.trials]
    return replace(done, trials=tuple(trials), accepted=None, indistinguishable_from=())


def discrepancy_force(state: SearchState, settings: SearchSettings) -> ModelFit | None:
    """``state.fit`` with a smooth force for what is not known; None if held-out data does not confirm it."""
    label = "refine: a smooth force for the rest"
    model = state.forward_model
    ranking = score(
        model, state.fit, [DISCREPANCY_FORCE], robust_scale=state.robust_scale,
        progress=lambda n, i, k: settings.progress(label, i, k, n),
    )  # fmt: skip
    if not ranking.candidates:
        return None
    try:
        fitted = fit_with_effect(model, state.fit, ranking.candidates[0], state.robust_scale)
    except MasivError as failed:
        settings.progress(label, 1, 1, str(failed))
        return None
    settings.progress(label, 1, 1, f"{fitted.fit_mm:.1f} mm")
    term = model.term(DISCREPANCY_FORCE)
    objections = statistical_objections(state.fit, fitted, term, state.noise, settings.config)
    return None if objections else fitted
