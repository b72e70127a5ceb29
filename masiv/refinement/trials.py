"""The effects of one round, ranked and fitted through the rollout."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

from masiv.inference.model_fit import (
    ModelFit,
    warm_started_fit,
)
from masiv.models.base import ForwardModel
from masiv.refinement.candidates import Candidate, Ranking
from masiv.refinement.effect_fit import MIN_PROMISE_KEPT, fit_with_effect
from masiv.refinement.rounds import Failure, Trial
from masiv.refinement.search_state import SearchSettings, SearchState
from masiv.refinement.tasks import map_tasks, rank
from masiv.workers import TaskError

MAX_PROMISE_ERROR = 1.5
"""Factor by which a ranking, which is linear, may have underestimated an effect."""
WIDER_REDUCED_CHI = 1.2
"""Residual of the best trial over its standard deviation above which twice as many effects are fitted."""


@dataclass(frozen=True)
class Attempts:
    """ranking: of the first base."""

    ranking: Ranking = field(default_factory=Ranking)
    trials: tuple[Trial, ...] = ()
    failures: tuple[Failure, ...] = ()

    def with_fits(self, fits: tuple[list[Trial], list[Failure]]) -> Attempts:
        return replace(self, trials=(*self.trials, *fits[0]), failures=(*self.failures, *fits[1]))


def try_effects(state: SearchState, bases: Sequence[ModelFit], settings: SearchSettings) -> Attempts:
    """Of each base, the effects that explain most, fitted."""
    out = Attempts()
    for base in bases:
        worth = [c.effect for c in worth_fitting(out.ranking.candidates, settings.config.min_explained)]
        if out.ranking.candidates and not worth:
            break
        # What the first base's ranking leaves out is not looked at again for the next base.
        names = worth[: settings.shortlist] or settings.considered(state.forward_model, base.model)
        start = _Start.of(state, base)
        ranking = _ranked(start, names, settings)
        first = not out.ranking.candidates
        if first:
            out = replace(out, ranking=ranking)
        if settings.rank_only:
            break
        candidates = worth_fitting(ranking.candidates, settings.config.min_explained)
        shortlist = [
            c for c in candidates[: settings.shortlist] if start.curriculum or could_improve(c, base, out.trials)
        ]
        out = out.with_fits(_fitted_trials(start, shortlist, settings))
        if first and _needs_wider_shortlist(state, out.trials):
            # The ranking is linear: an effect that acts at a place may be far down in it.
            wider = candidates[settings.shortlist : 2 * settings.shortlist]
            out = out.with_fits(_fitted_trials(start, wider, settings))
    return out


@dataclass(frozen=True)
class _Start:
    """Where refits of one base start. curriculum: shorter forward models through which they go first, if the base is so
    far off at the end that its derivatives point nowhere; fit: the base in the first of these."""

    forward_model: ForwardModel
    curriculum: tuple[ForwardModel, ...]
    fit: ModelFit
    robust_scale: float

    @classmethod
    def of(cls, state: SearchState, base: ModelFit) -> _Start:
        model = state.forward_model
        curriculum, fit = tuple(model.curriculum(base.fields)), base
        if curriculum:  # what comes late in such a motion draws a fit of all of it away from the beginning, too
            values = model.reset_initial_conditions(base.values)
            fit = warm_started_fit(curriculum[0], replace(base, values=values), state.robust_scale)
        return cls(model, curriculum, fit, state.robust_scale)


def _ranked(start: _Start, names: Sequence[str], settings: SearchSettings) -> Ranking:
    label = f"refine: rank effects, {start.fit.model.family.kind}"
    ranking = rank(
        settings.workers, start.curriculum[0] if start.curriculum else start.forward_model, start.fit, names,
        robust_scale=start.robust_scale, progress=lambda n, i, k: settings.progress(label, i, k, n),
    )  # fmt: skip
    settings.progress(label, 1, 1, ranking.candidates[0].effect if ranking.candidates else "none")
    return ranking


def _fitted_trials(
    start: _Start, candidates: Sequence[Candidate], settings: SearchSettings
) -> tuple[list[Trial], list[Failure]]:
    """The start with each of the ``candidates``, and those that cannot be simulated."""
    law = start.fit.model.family.kind
    tasks = [(start.curriculum, start.fit, candidate, start.robust_scale) for candidate in candidates]
    fits = map_tasks(settings.workers, start.forward_model, _fit_through_curriculum, tasks)
    return trials_of(f"refine: fit effects, {law}", law, candidates, fits, settings)


def trials_of(
    label: str,
    law: str,
    candidates: Sequence[Candidate],
    fits: Iterable[ModelFit | TaskError],
    settings: SearchSettings,
) -> tuple[list[Trial], list[Failure]]:
    """Trials of ``fits`` (``ModelFit`` or ``TaskError``) of ``candidates``, and what failed; progress is told."""
    trials, failures = [], []
    settings.progress(label, 0, len(candidates), ", ".join(c.effect for c in candidates))
    for done, (candidate, fitted) in enumerate(zip(candidates, fits, strict=True)):
        note = candidate.effect
        if isinstance(fitted, TaskError):
            failures.append(Failure(candidate.effect, law, fitted.reason))
            note += f": {fitted.reason}"
        else:
            trials.append(Trial(candidate, fitted))
            note += f": {fitted.fit_mm:.1f} mm"
        settings.progress(label, done + 1, len(candidates), note)
    return trials, failures


def _fit_through_curriculum(
    forward_model: ForwardModel,
    curriculum: Sequence[ForwardModel],
    start: ModelFit,
    candidate: Candidate,
    robust_scale: float,
) -> ModelFit:
    """``start`` with the candidate, through the ``curriculum`` first."""
    fitted = fit_with_effect(curriculum[0] if curriculum else forward_model, start, candidate, robust_scale)
    for longer in (*curriculum[1:], forward_model) if curriculum else ():
        fitted = warm_started_fit(longer, fitted, robust_scale)
    return fitted


def _needs_wider_shortlist(state: SearchState, trials: Sequence[Trial]) -> bool:
    """Whether the best of ``trials`` leaves more than noise and discretization explain."""
    if not trials:
        return False
    best = min((t.fitted for t in trials), key=lambda f: f.cost)
    return state.noise.reduced_chi(best.squares) > WIDER_REDUCED_CHI


def worth_fitting(candidates: Sequence[Candidate], min_explained: float) -> list[Candidate]:
    """Those of ``candidates``, best explained first, that explain at least ``min_explained``, and, if one does, all
    that may turn out as good as the best: it is not to be named because the others were not weighed."""
    best = max((c.explained for c in candidates), default=0.0)
    least = min_explained if best < min_explained else min(min_explained, best / MAX_PROMISE_ERROR)
    return [c for c in candidates if c.explained >= least]


def could_improve(candidate: Candidate, base: ModelFit, trials: Sequence[Trial]) -> bool:
    """Whether ``candidate``, if it explains MAX_PROMISE_ERROR times what the ranking says, would be as good as the best
    of ``trials``: a law that explains the motion worse need not be fitted with what would not make up for that."""
    return could_reach(base.cost, candidate.explained, min((t.fitted.cost for t in trials), default=math.inf))


def could_reach(cost: float, explained: float, least: float) -> bool:
    """Whether a fit of ``cost`` could be as good as one of cost ``least`` if a linear model says which part of it would
    go."""
    return cost * (1 - min(MAX_PROMISE_ERROR * explained, 1.0)) <= least


def converged(trial: Trial, bases: Sequence[ModelFit]) -> bool:
    """Whether the fit explains what the ranking promised, but for half of it. The base is the best one of its law."""
    same = [b for b in bases if b.model.family.kind == trial.law] or list(bases)
    base = min(b.cost for b in same)
    return base - trial.fitted.cost >= MIN_PROMISE_KEPT * trial.candidate.explained * base
