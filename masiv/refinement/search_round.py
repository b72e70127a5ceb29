"""One pass of the search: rank the effects, fit the best through the rollout, weigh them against each other."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

from masiv.effects.catalogue import effect_named
from masiv.errors import MasivError
from masiv.inference.model_fit import (
    ModelFit,
    gauss_newton_fit,
    held_parameters,
    linear_strengths,
    rank_by_bic,
    warm_started_fit,
)
from masiv.models.base import EffectTerm, ForwardModel
from masiv.refinement.candidates import Candidate, Ranking
from masiv.refinement.effect_fit import MIN_PROMISE_KEPT, fit_with_effect
from masiv.refinement.hypotheses import (
    NEGLIGIBLE,
    Hypothesis,
    Linearized,
    Posterior,
    evidence_of,
    nearly_linearized,
    weighed,
)
from masiv.refinement.rounds import Failure, Round, Trial, rank_trials
from masiv.refinement.search_state import SearchSettings, SearchState
from masiv.refinement.tasks import map_tasks, rank
from masiv.workers import TaskError

FALSE_MINIMUM_RATIO = 0.5
"""A model with one more effect that has less than this part of its base's cost may have got out of a false minimum."""
MAX_PROMISE_ERROR = 1.5
"""Factor by which a ranking, which is linear, may have underestimated an effect."""
LONGER_BUDGET = 3
"""Derivatives that a fit may take that has not reached what the ranking promised."""
WIDER_REDUCED_CHI = 1.2
"""Residual of the best trial over its standard deviation above which twice as many effects are fitted."""


def run_round(state: SearchState, bases: Sequence[ModelFit], settings: SearchSettings) -> Round:
    """Add one effect to ``state.fit``. bases: fits without that effect to start from, the first to be ranked in
    full."""
    attempts = _try_effects(state, bases, settings)
    trials, current = rank_trials(attempts.trials), state.fit
    if trials:
        trials = rank_trials(_refit_simpler(state, trials, settings))
        trials = rank_trials(_refit_unconverged(state, trials, bases, settings))
        if current.model.effects:
            current = _restart_base(state, trials[0].fitted)
    ranking = _with_inapplicable(state, attempts.ranking, settings)
    if settings.rank_only:
        return Round(current, ranking, (), None, failures=attempts.failures)
    trials = [
        replace(t, impossible=tuple(reasons_against(state.forward_model, t)), converged=_converged(t, bases))
        for t in trials
    ]
    return _judged(state.with_fit(current), bases, trials, replace(attempts, ranking=ranking), settings)


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
        if first and _needs_wider_shortlist(state, out.trials):
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


def _needs_wider_shortlist(state: SearchState, trials: Sequence[Trial]) -> bool:
    """Whether the best of ``trials`` leaves more than noise and discretization explain."""
    if not trials:
        return False
    best = min((t.fitted for t in trials), key=lambda f: f.cost)
    return state.noise.reduced_chi(best.squares) > WIDER_REDUCED_CHI


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


def _refit_unconverged(
    state: SearchState, trials: Sequence[Trial], bases: Sequence[ModelFit], settings: SearchSettings
) -> list[Trial]:
    """Trials, best first, of which those that have not reached what the ranking promised go on with fresh derivatives:
    from where they ended, and from where the best with the same law did. Those that would not be as good as the best
    trial if they kept their promise do not."""
    own = {b.model.family.kind: b for b in reversed(bases)}
    failed = [t for t in trials if not _converged(t, bases) and could_improve(t.candidate, own[t.law], trials)]
    best = {law: next(t.fitted for t in trials if t.law == law) for law in {t.law for t in trials}}
    tasks = [(t.fitted, best[t.law], state.robust_scale) for t in failed]
    again: dict[int, ModelFit] = {}
    results = map_tasks(settings.workers, state.forward_model, _refit_longer, tasks)
    for done, (trial, fit) in enumerate(zip(failed, results, strict=True)):
        settings.progress("refine: fit again what fell short", done + 1, len(failed), trial.effect)
        if not isinstance(fit, TaskError):
            again[id(trial)] = min(fit, trial.fitted, key=lambda f: f.cost)
    return [replace(t, fitted=again.get(id(t), t.fitted)) for t in trials]


def _refit_longer(forward_model: ForwardModel, fitted: ModelFit, best: ModelFit, robust_scale: float) -> ModelFit:
    """The better of ``fitted`` fitted on, and from what it shares with ``best``. Raises MasivError if neither start can
    be simulated."""
    own = {p.name for p in fitted.parameters}
    shared = {p.name: best.values[p.name] for p in best.parameters if p.name in own}
    starts = [fitted.values] if best is fitted else [fitted.values, {**fitted.values, **shared}]
    fits: list[ModelFit] = []
    failed: MasivError | None = None
    for values in starts:
        try:
            fits.append(
                gauss_newton_fit(
                    forward_model, fitted.model, values, budget=LONGER_BUDGET * (len(fitted.parameters) + 2),
                    robust_scale=robust_scale, held=held_parameters(forward_model, fitted),
                )
            )  # fmt: skip
        except MasivError as error:
            failed = error
    if not fits:
        assert failed is not None
        raise failed
    return min(fits, key=lambda f: f.cost)


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


def reasons_against(forward_model: ForwardModel, trial: Trial) -> list[str]:
    """Why the effect of ``trial`` cannot act as it was fitted; empty if it can."""
    term = forward_model.term(trial.effect)
    return [*forward_model.impossible(trial.fitted, term), *parameters_at_bounds(trial.fitted, term)]


def parameters_at_bounds(fitted: ModelFit, term: EffectTerm) -> list[str]:
    """Which parameters of ``term`` ran into the bound of what is possible."""
    # What acts on the matter at a place may well be at the body's face, where its place ends.
    bounded = term.strengths if effect_named(term.effect).hints.inside else term.parameters
    return [
        f"{p.name} runs into the bound of what is possible, {p.upper:g}"
        for p in bounded
        if fitted.values[p.name] >= p.upper - 1e-9 * abs(p.upper)
    ]


def _converged(trial: Trial, bases: Sequence[ModelFit]) -> bool:
    """Whether the fit explains what the ranking promised, but for half of it. The base is the best one of its law."""
    same = [b for b in bases if b.model.family.kind == trial.law] or list(bases)
    base = min(b.cost for b in same)
    return base - trial.fitted.cost >= MIN_PROMISE_KEPT * trial.candidate.explained * base


def _judged(
    state: SearchState, bases: Sequence[ModelFit], trials: Sequence[Trial], attempts: _Attempts,
    settings: SearchSettings,
) -> Round:  # fmt: skip
    """The round with the posterior over the models without (``bases``) and with one effect more (``trials``)."""
    without = [state.fit, *bases[1:]]
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
    count = len(settings.considered(state.forward_model, state.fit.model)) + len(state.fit.model.effects)
    posterior = Posterior.of(hypotheses, count)
    fewer = len(state.fit.model.effects)
    chosen = posterior.best(fewer + 1)
    accepted = None
    if chosen is not None and posterior.with_at_most(fewer) < settings.config.max_null_probability:
        trial = next(t for t in trials if t.fitted is chosen.fitted)
        final = _completed(state, trial, settings)
        trials = [final if t is trial else t for t in trials]
        accepted = final if not final.impossible else None
    current = posterior.best(fewer)
    base = current.with_posterior() if current is not None else state.fit
    return Round(base, attempts.ranking, tuple(trials), accepted, posterior, attempts.failures)


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
    best = _with_free_places(state, min(final, start, key=lambda f: f.cost))
    hypotheses, failed = _weighed(state, [best], [], settings)
    if not hypotheses:
        return replace(trial, fitted=best, impossible=(f"at its best fit, {failed[id(best)]}",))
    done = replace(trial, fitted=hypotheses[0].with_posterior())
    return replace(done, impossible=tuple(reasons_against(model, done)))


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
