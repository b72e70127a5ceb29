"""One pass of the search: rank the effects, fit the best through the rollout, select one."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

from masiv.errors import MasivError
from masiv.inference.model_fit import (
    ModelFit,
    common_samples,
    gauss_newton_fit,
    held_parameters,
    linear_strengths,
    rank_by_bic,
    warm_started_fit,
)
from masiv.models.base import ForwardModel
from masiv.refinement.candidates import Candidate, Ranking
from masiv.refinement.effect_fit import fit_with_effect
from masiv.refinement.evidence import objections_to
from masiv.refinement.rounds import MIN_BIC_GAP, Failure, Round, Trial, confusable, rank_trials
from masiv.refinement.search_state import SearchSettings, SearchState
from masiv.refinement.selection import Selection, select
from masiv.refinement.tasks import map_tasks, rank
from masiv.workers import TaskError

FALSE_MINIMUM_RATIO = 0.5
"""A model with one more effect that has less than this part of its base's cost may have got out of a false minimum."""
MAX_PROMISE_ERROR = 1.5
"""Factor by which a ranking, which is linear, may have underestimated an effect."""


def run_round(state: SearchState, bases: Sequence[ModelFit], settings: SearchSettings) -> Round:
    """Add one effect to ``state.fit``. bases: fits without that effect to start from, the first to be ranked in
    full."""
    attempts = _try_effects(state, bases, settings)
    trials, current = rank_trials(attempts.trials), state.fit
    if trials:
        trials = rank_trials(_refit_simpler(state, trials, settings))
        if current.model.effects:
            current = _restart_base(state, trials[0].fitted)
    ranking = _with_inapplicable(state, attempts.ranking, settings)
    alike = confusable(ranking, trials, settings.config.confusable_correlation)
    trials = _judge(state.with_fit(current), trials, settings)
    selection = select(trials, state.noise, settings.config)
    if selection.trial is not None:
        final = _completed(state.with_fit(current), selection.trial, settings)
        trials = [final if t is selection.trial else t for t in trials]
        selection = Selection(final, selection.indistinguishable_from) if final.passes else Selection()
    return Round(
        current, ranking, tuple(trials), selection.trial, alike, selection.indistinguishable_from,
        attempts.failures,
    )  # fmt: skip


# -- ranking and fitting ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Attempts:
    """ranking: of the first base."""

    ranking: Ranking = field(default_factory=Ranking)
    trials: tuple[Trial, ...] = ()
    failures: tuple[Failure, ...] = ()

    def with_fits(self, fits: tuple[list[Trial], list[Failure]]) -> _Attempts:
        return replace(self, trials=(*self.trials, *fits[0]), failures=(*self.failures, *fits[1]))


def _try_effects(state: SearchState, bases: Sequence[ModelFit], settings: SearchSettings) -> _Attempts:
    """Of each base, the effects that explain most, fitted."""
    out = _Attempts()
    for base in bases:
        worth = [c.effect for c in out.ranking.candidates if c.explained >= settings.config.min_explained]
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
        candidates = [c for c in ranking.candidates if c.explained >= settings.config.min_explained]
        shortlist = [
            c for c in candidates[: settings.shortlist] if start.curriculum or could_improve(c, base, out.trials)
        ]
        out = out.with_fits(_fitted_trials(start, shortlist, settings))
        if first and _needs_wider_shortlist(state, out.trials, settings):
            # The ranking is linear: an effect that acts at a place may be far down in it.
            wider = candidates[settings.shortlist : 2 * settings.shortlist]
            out = out.with_fits(_fitted_trials(start, wider, settings))
    return out


def _with_inapplicable(state: SearchState, ranking: Ranking, settings: SearchSettings) -> Ranking:
    """``ranking`` with a reason for each effect that the configuration names and that cannot be added here."""
    effects = state.fit.model.effects
    known = {state.forward_model.term(n).effect for n in (*effects, *state.forward_model.candidates(state.fit.model))}
    others = {n: "it cannot act here in addition" for n in settings.config.effects if n not in known}
    return replace(ranking, not_ranked={**ranking.not_ranked, **others})


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


def _needs_wider_shortlist(state: SearchState, trials: Sequence[Trial], settings: SearchSettings) -> bool:
    """Whether the best of ``trials`` leaves more than noise and discretization explain."""
    if not trials:
        return False
    best = min((t.fitted for t in trials), key=lambda f: f.cost)
    return state.noise.reduced_chi(best.squares) > settings.config.noise_threshold


def could_improve(candidate: Candidate, base: ModelFit, trials: Sequence[Trial]) -> bool:
    """Whether ``candidate``, if it explains MAX_PROMISE_ERROR times what the ranking says, would be as good as the best
    of ``trials``: a law that explains the motion worse need not be fitted with what would not make up for that."""
    best = min((t.fitted.cost for t in trials), default=math.inf)
    return base.cost * (1 - min(MAX_PROMISE_ERROR * candidate.explained, 1.0)) <= best


# -- refits from where the best one ended ----------------------------------------------------------------------------


def _refit_simpler(state: SearchState, trials: Sequence[Trial], settings: SearchSettings) -> list[Trial]:
    """Trials, best first, of which those that are simpler than the best one, with the same law, are fitted again from
    where that ended: a flexible effect that found the right law and initial state must not win for that alone. So too
    an effect that is not smooth and no richer: its derivatives at a law that made up for it point to next to
    nothing."""
    model, best = state.forward_model, trials[0].fitted

    def worth(trial: Trial) -> bool:
        own, its = len(trial.fitted.parameters), len(best.parameters)
        nonsmooth = model.term(trial.effect).nonsmooth
        return trial.law == best.model.family.kind and (own < its or (own == its and nonsmooth))

    simpler = [t for t in trials[1:] if worth(t)]
    tasks = [(t.fitted, t.effect, best, state.robust_scale) for t in simpler]
    again: dict[int, ModelFit] = {}
    for done, (trial, fit) in enumerate(
        zip(simpler, map_tasks(settings.workers, model, _refit_from, tasks), strict=True)
    ):
        settings.progress("refine: fit simpler effects again", done + 1, len(simpler), trial.effect)
        if not isinstance(fit, TaskError):
            again[id(trial)] = min(fit, trial.fitted, key=lambda f: f.cost)
    return [replace(t, fitted=again.get(id(t), t.fitted)) for t in trials]


def _refit_from(
    forward_model: ForwardModel, fitted: ModelFit, name: str, best: ModelFit, robust_scale: float
) -> ModelFit:
    """``fitted``, a model with the term ``name``, from where what it shares with ``best`` ended. Raises
    NonFiniteError."""
    term = forward_model.term(name)
    shared = {p.name for p in fitted.parameters} & {p.name for p in best.parameters}
    values = {**fitted.values, **{n: best.values[n] for n in shared}}
    values = linear_strengths(forward_model, fitted.model, values, term.strengths, robust_scale)
    # An effect that is not smooth starts far from where it ends: four derivatives for two.
    budget = (4 if term.nonsmooth else 2) * (len(fitted.parameters) + 2)
    return gauss_newton_fit(
        forward_model, fitted.model, values, budget=budget, robust_scale=robust_scale,
        held=held_parameters(forward_model, fitted),
    )  # fmt: skip


def _restart_base(state: SearchState, best: ModelFit) -> ModelFit:
    """``state.fit``, or that fit from what it shares with ``best``, a model with one more effect, if that is better: a
    body that meets an obstacle has false minima, and an effect that helps out of one is no cause."""
    base = state.fit
    if best.cost > FALSE_MINIMUM_RATIO * base.cost:
        return base
    values = {n: best.values.get(n, value) for n, value in base.values.items()}
    try:
        again = gauss_newton_fit(
            state.forward_model, base.model, values, budget=2 * (len(values) + 2), robust_scale=state.robust_scale,
            held=held_parameters(state.forward_model, base),
        )  # fmt: skip
    except MasivError:
        return base
    return min(base, again, key=lambda f: f.cost)


# -- judgement -------------------------------------------------------------------------------------------------------


def _judge(state: SearchState, trials: Sequence[Trial], settings: SearchSettings) -> list[Trial]:
    """``trials``, best first, with the objections to each."""
    with_objections = [replace(t, objections=tuple(_objections(state, t.fitted, t, settings))) for t in trials]
    more = {id(t): dominated_by(state, t, with_objections, settings) for t in with_objections if t.passes}
    return [replace(t, objections=(*t.objections, *more.get(id(t), ()))) for t in with_objections]


def _objections(state: SearchState, fitted: ModelFit, trial: Trial, settings: SearchSettings) -> list[str]:
    term = state.forward_model.term(trial.effect)
    return objections_to(state.forward_model, state.fit, fitted, term, settings.config)


def dominated_by(state: SearchState, trial: Trial, trials: Sequence[Trial], settings: SearchSettings) -> list[str]:
    """Why ``trial``, which passes, must not be named: an effect that is no richer explains more, and is not certain.
    (One that physics forbids does not count.)"""
    model = state.forward_model
    samples = common_samples([t.fitted for t in trials])
    for other in trials:
        if (
            not other.passes
            and other.effect != trial.effect
            and len(other.fitted.parameters) <= len(trial.fitted.parameters)
            and other.fitted.bic(samples) < trial.fitted.bic(samples) - MIN_BIC_GAP
            and not model.objections(state.fit, other.fitted, model.term(other.effect), settings.config.min_gain)
        ):
            return [f"{other.effect} explains more with no more parameters, and is not certain"]
    return []


def _completed(state: SearchState, trial: Trial, settings: SearchSettings) -> Trial:
    """``trial`` fitted to the end, its places free if that pays, and its objections again."""
    model, start = state.forward_model, trial.fitted
    final = gauss_newton_fit(
        model, start.model, start.values, budget=2 * len(start.parameters) + 6, robust_scale=state.robust_scale,
        held=held_parameters(model, start),
    )  # fmt: skip
    best = _with_free_places(state, min(final, start, key=lambda f: f.cost))
    return replace(trial, fitted=best, objections=tuple(_objections(state, best, trial, settings)))


def _with_free_places(state: SearchState, fitted: ModelFit) -> ModelFit:
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
