"""The loop: rank the effects, fit the best through the rollout, accept what held-out data confirms, and again."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from masiv.errors import MasivError
from masiv.inference.discretization import with_grid_errors, with_residual_std
from masiv.inference.model_fit import (
    ModelFit,
    gauss_newton_fit,
    held_in,
    ordered,
    refit_whitened,
    robust_scale_of,
    strengths_alone,
    warm_started_fit,
)
from masiv.models.base import ForwardModel
from masiv.progress import Progress
from masiv.refine.add_effect import CHORD_STEPS, refit
from masiv.refine.candidates import Candidate, score
from masiv.refine.config import RefineConfig
from masiv.refine.evidence import above_noise, objections, reduced_chi, select_by_validation
from masiv.refine.rounds import TELLS_APART, Round, Trial, confusable
from masiv.refine.second_effect import search_second_effect
from masiv.refine.selection import named
from masiv.refine.tasks import map_tasks, ranked
from masiv.workers import TaskError, Workers, unwrap

DISCREPANCY_FORCE = "smooth_force"
SOFT = 5.0
"""Sizes of the noise from which a weighted residual counts as wild, at the least."""
ESCAPE = 0.5
"""Share of a model's cost from which one with an effect more may have got out of a minimum that is none."""
MISJUDGED = 1.5
"""By how much a ranking, which is linear, may have judged a cause too small."""


@dataclass
class SearchResult:
    """before: the best model without effects. after: with what was accepted, ``before`` itself where nothing was.
    gap: ``after`` with a smooth force for what is still unexplained, None where there is no need or no use."""

    before: ModelFit
    after: ModelFit
    rounds: list[Round]
    gap: ModelFit | None = None


def search_effects(
    simulation: ForwardModel,
    baselines: Sequence[ModelFit],
    config: RefineConfig,
    progress: Progress,
    workers: Workers | None = None,
) -> SearchResult:
    """Add effects to the best of ``baselines`` (one a law, without effects) until none is confirmed, or the residual is
    near the noise. Gives the experiments of ``simulation`` their sigma, and ``workers`` what need not wait."""
    workers = workers or Workers()
    observation_std = [e.residual_std for e in simulation.observations]
    rivals, robust_scale = _weighed_baselines(simulation, baselines, observation_std, config, progress, workers)
    before = current = rivals[0]
    rounds: list[Round] = []
    while len(rounds) < config.max_effects and above_noise(current, simulation.observations, config):
        done = _round(simulation, current, rivals, robust_scale, config, progress, workers)
        rounds.append(done)
        if done.accepted is None:
            current = done.base
            break
        current = done.accepted.fitted
        look = config.search_second_effect and len(rounds) < config.max_effects
        if reduced_chi(current, simulation.observations) < config.unexplained and not look:
            break
        # With the effect the body may touch what it did not, earlier than before: what a finer grid changes is another.
        if update_residual_std(simulation, current, observation_std):
            current = warm_started_fit(simulation, current, robust_scale)
        rivals = [current]
        if reduced_chi(current, simulation.observations) < config.unexplained:
            if look:
                looks = search_second_effect(simulation, current, done, robust_scale, config, progress, workers)
                rounds += looks
                current = _merge_second_search(current, done, looks)
            break
    observations = simulation.observations
    left, there_was = reduced_chi(current, observations), reduced_chi(before, observations)
    if current is not before and left > max(config.unexplained, there_was / 2):
        for done in rounds:  # no name for what it does not explain
            if done.accepted is not None:
                done.accepted.reasons.append(f"it leaves a residual of {left:.1f} times what noise and grid explain")
                done.accepted = None
        current = before
    gap = None
    if config.shortlist and reduced_chi(current, observations) > config.unexplained:
        gap = discrepancy_force(simulation, current, robust_scale, config, progress)
    known = with_grid_errors(simulation, current, robust_scale)
    return SearchResult(known if current is before else before, known, rounds, gap)


def _weighed_baselines(
    simulation: ForwardModel,
    baselines: Sequence[ModelFit],
    observation_std: Sequence[np.ndarray],
    config: RefineConfig,
    progress: Progress,
    workers: Workers,
) -> tuple[list[ModelFit], float]:
    """The best of ``baselines``, fitted again with sigma as the first of them moves; and the size from which residuals
    are wild. That one is the simplest that foretells the motion, since a law that takes an effect over where it is
    fitted is found out there; the others are ordered by the information criterion."""
    first = min(baselines, key=lambda f: f.cost)
    rivals, robust_scale = [first], 0.0
    for _ in range(2):  # the one that is nearest before sigma is known may not be it
        update_residual_std(simulation, first, observation_std)
        robust_scale = max(
            robust_scale_of(simulation.residual(first.model, first.values)), SOFT * simulation.observations[0].noise_std
        )
        progress("refine: weigh", 0, 1, "")
        again = map_tasks(
            workers, simulation, refit_whitened, [(base, CHORD_STEPS, robust_scale) for base in baselines]
        )
        rivals = ordered([unwrap(fitted) for fitted in again])[: config.families]
        progress("refine: weigh", 1, 1, "")
        best = select_by_validation(rivals, simulation.observations)
        rivals.sort(key=lambda f, best=best: f is not best)
        if best.model == first.model:
            break
        first = best
    return rivals, robust_scale


def _merge_second_search(current: ModelFit, first: Round, looks: Sequence[Round]) -> ModelFit:
    """``current``, or two causes that explain more, where ``looks`` found these: ``first`` then names the one of them
    that it had tried."""
    for done in looks:
        if done.accepted is None:
            continue
        found = done.accepted.fitted
        if first.accepted is not None and done.base.model.effects != current.model.effects:
            pair = " and ".join(found.model.effects)
            first.accepted.reasons.append(f"{pair} together explain more")
            (name,) = set(done.base.model.effects) - set(first.base.model.effects)
            first.accepted = next(t for t in first.trials if t.candidate.effect == name and t.passes)
            first.indistinguishable_from = []
        return found
    return current


def discrepancy_force(
    simulation: ForwardModel, current: ModelFit, robust_scale: float, config: RefineConfig, progress: Progress
) -> ModelFit | None:
    """``current`` with a smooth force that stands in for what is not known; None where held-out data does not bear it
    out."""
    label = "refine: a smooth force for the rest"
    found = score(
        simulation,
        current,
        robust_scale=robust_scale,
        names=[DISCREPANCY_FORCE],
        progress=lambda n, i, k: progress(label, i, k, n),
    )
    if not found:
        return None
    try:
        fitted = refit(simulation, current, found[0], robust_scale)
    except MasivError as failed:
        progress(label, 1, 1, str(failed))
        return None
    progress(label, 1, 1, f"{fitted.fit_mm:.1f} mm")
    term = simulation.term(DISCREPANCY_FORCE)
    return None if objections(current, fitted, term, simulation.observations, config) else fitted


def update_residual_std(simulation: ForwardModel, fitted: ModelFit, observation_std: Sequence[np.ndarray]) -> bool:
    """Update ``residual_std`` of each observation along the motion of ``fitted``; ``observation_std``: its share
    that is measurement error. Returns whether any changed."""
    was = [e.residual_std for e in simulation.observations]
    simulation.observations = with_residual_std(simulation, fitted, observation_std)
    same = all(np.array_equal(e.residual_std, s) for e, s in zip(simulation.observations, was, strict=True))
    return not same


def _round(
    simulation: ForwardModel,
    current: ModelFit,
    bases: Sequence[ModelFit],
    robust_scale: float,
    config: RefineConfig,
    progress: Progress,
    workers: Workers,
) -> Round:
    trials: list[Trial] = []
    ranking: list[Candidate] = []
    for base in bases:
        label = f"refine: rank effects, {base.model.family.kind}"
        # What the best law's ranking leaves out is not looked at again for the next law.
        names = [c.effect for c in ranking if c.explained >= config.least_explained][: config.shortlist]
        if ranking and not names:
            break
        curriculum, start = simulation.curriculum(base), base
        if curriculum:  # what comes late in such a motion pulls a fit of all of it away from the flight, too
            start = warm_started_fit(
                curriculum[0], replace(base, values=simulation.reset_initial_conditions(base.values)), robust_scale
            )
        candidates = ranked(
            workers, curriculum[0] if curriculum else simulation, start, robust_scale=robust_scale,
            names=names or config.effects or simulation.candidates(base.model),
            progress=lambda n, i, k, label=label: progress(label, i, k, n),
        )  # fmt: skip
        progress(label, 1, 1, candidates[0].effect if candidates else "none")
        worth = [c for c in candidates if c.explained >= config.least_explained]
        within = [c for c in worth[: config.shortlist] if curriculum or could_improve(c, base, trials)]
        trials += _trials(simulation, curriculum, start, within, robust_scale, progress, workers)
        if not ranking and _needs_wider_shortlist(trials, simulation, config):
            # The ranking is linear: a cause that acts at a place may be far down in it.
            trials += _trials(
                simulation,
                curriculum,
                start,
                worth[config.shortlist : 2 * config.shortlist],
                robust_scale,
                progress,
                workers,
            )
        ranking = ranking or candidates
    _rank(trials)
    if trials:
        _refit_simpler_candidates(simulation, trials, robust_scale, progress, workers)
        _rank(trials)
        if current.model.effects:
            current = _restart_base(simulation, current, trials[0].fitted, robust_scale)
    alike = confusable(ranking, trials, config.confusable)
    accepted = None
    for trial in trials:
        trial.reasons = _reasons(simulation, current, trial, config)
    for trial, reason in [(t, _dominated_by(simulation, current, t, trials, config)) for t in trials if t.passes]:
        trial.reasons += reason
    trial, indistinguishable_from = named(trials, simulation.observations, config)
    if trial is not None:
        final = gauss_newton_fit(
            simulation, trial.fitted.model, trial.fitted.values,
            budget=2 * len(trial.fitted.parameters) + 6, robust_scale=robust_scale,
            held=held_in(simulation, trial.fitted),
        )  # fmt: skip
        trial.fitted = _refit_with_free_locations(
            simulation, min(final, trial.fitted, key=lambda f: f.cost), robust_scale
        )
        trial.reasons = _reasons(simulation, current, trial, config)
        accepted = trial if trial.passes else None
    return Round(current, ranking, trials, accepted, alike, indistinguishable_from if accepted else [])


def _trials(
    simulation: ForwardModel,
    curriculum: Sequence[ForwardModel],
    start: ModelFit,
    candidates: Sequence[Candidate],
    robust_scale: float,
    progress: Progress,
    workers: Workers,
) -> list[Trial]:
    """``start`` with each of the ``candidates``, those that cannot be simulated left out."""
    label = f"refine: fit effects, {start.model.family.kind}"
    fits = map_tasks(
        workers, simulation, _fitted, [(curriculum, start, candidate, robust_scale) for candidate in candidates]
    )
    progress(label, 0, len(candidates), ", ".join(c.effect for c in candidates))
    trials = []
    for done, (candidate, fitted) in enumerate(zip(candidates, fits, strict=True)):
        if isinstance(fitted, TaskError):
            progress(label, done + 1, len(candidates), f"{candidate.effect}: {fitted.reason}")
        else:
            trials.append(Trial(candidate, fitted))
            progress(label, done + 1, len(candidates), candidate.effect)
    return trials


def _needs_wider_shortlist(trials: Sequence[Trial], simulation: ForwardModel, config: RefineConfig) -> bool:
    """Whether the best of ``trials`` leaves more than noise and grid explain."""
    if not trials:
        return False
    best = min((t.fitted for t in trials), key=lambda f: f.cost)
    return reduced_chi(best, simulation.observations) > config.above_noise


def could_improve(candidate: Candidate, base: ModelFit, trials: Sequence[Trial]) -> bool:
    """Whether ``candidate``, should it explain MISJUDGED times what the ranking says, would be as good as the best of
    ``trials``: a law that explains the motion worse need not be fitted with what would not make up for that."""
    best = min((t.fitted.cost for t in trials), default=math.inf)
    return base.cost * (1 - min(MISJUDGED * candidate.explained, 1.0)) <= best


def _rank(trials: list[Trial]) -> None:
    rank = {id(f): k for k, f in enumerate(ordered([t.fitted for t in trials]))}
    trials.sort(key=lambda t: rank[id(t.fitted)])


def _fitted(
    simulation: ForwardModel,
    curriculum: Sequence[ForwardModel],
    start: ModelFit,
    candidate: Candidate,
    robust_scale: float,
) -> ModelFit:
    """``start`` with the candidate, through the ``curriculum`` simulations first."""
    fitted = refit(curriculum[0] if curriculum else simulation, start, candidate, robust_scale)
    for longer in (*curriculum[1:], simulation) if curriculum else ():
        fitted = warm_started_fit(longer, fitted, robust_scale)
    return fitted


def _refit_simpler_candidates(
    simulation: ForwardModel, trials: Sequence[Trial], robust_scale: float, progress: Progress, workers: Workers
) -> None:
    """Fit what is simpler than the best trial, with the same law, again from where the best one ended: a flexible cause
    that found the right law and launch must not win for that alone. So too what has a kink and is no richer: its
    derivatives at a law that made up for it point to next to nothing."""
    best = trials[0].fitted

    def worth(trial: Trial) -> bool:
        mine, its = len(trial.fitted.parameters), len(best.parameters)
        return mine < its or (mine == its and simulation.term(trial.candidate.effect).nonsmooth)

    simpler = [t for t in trials[1:] if t.fitted.model.family.kind == best.model.family.kind and worth(t)]
    fits = map_tasks(
        workers, simulation, _fitted_from, [(t.fitted, t.candidate.effect, best, robust_scale) for t in simpler]
    )
    for done, (trial, again) in enumerate(zip(simpler, fits, strict=True)):
        progress("refine: fit simpler effects again", done + 1, len(simpler), trial.candidate.effect)
        if not isinstance(again, TaskError):
            trial.fitted = min(again, trial.fitted, key=lambda f: f.cost)


def _restart_base(simulation: ForwardModel, base: ModelFit, best: ModelFit, robust_scale: float) -> ModelFit:
    """``base``, or where it ends from what it shares with ``best``, a model with one more effect: where a body meets an
    obstacle there are minima that are none, and what helps out of one is no cause."""
    if best.cost > ESCAPE * base.cost:
        return base
    values = {n: best.values.get(n, value) for n, value in base.values.items()}
    try:
        again = gauss_newton_fit(
            simulation,
            base.model,
            values,
            budget=2 * (len(values) + 2),
            robust_scale=robust_scale,
            held=held_in(simulation, base),
        )
    except MasivError:
        return base
    return min(base, again, key=lambda f: f.cost)


def _fitted_from(
    simulation: ForwardModel, fitted: ModelFit, name: str, best: ModelFit, robust_scale: float
) -> ModelFit:
    """``fitted``, a model with the term ``name``, from where what it shares with ``best`` ended."""
    shared = {p.name for p in fitted.parameters} & {p.name for p in best.parameters}
    values = {**fitted.values, **{n: best.values[n] for n in shared}}
    values = strengths_alone(simulation, fitted.model, values, simulation.term(name).strengths, robust_scale)
    # What has a kink is begun far from where it ends: four derivatives for two.
    budget = (4 if simulation.term(name).nonsmooth else 2) * (len(fitted.parameters) + 2)
    return gauss_newton_fit(
        simulation, fitted.model, values, budget=budget, robust_scale=robust_scale, held=held_in(simulation, fitted)
    )


def _refit_with_free_locations(simulation: ForwardModel, fitted: ModelFit, robust_scale: float) -> ModelFit:
    """With what was left at a guess fitted as well, where the information criterion asks for it."""
    if not held_in(simulation, fitted):
        return fitted
    budget = 3 * (len(fitted.values) + 1)
    try:
        return ordered(
            [
                fitted,
                gauss_newton_fit(simulation, fitted.model, fitted.values, budget=budget, robust_scale=robust_scale),
            ]
        )[0]
    except MasivError:
        return fitted


def _reasons(simulation: ForwardModel, before: ModelFit, trial: Trial, config: RefineConfig) -> list[str]:
    term = simulation.term(trial.candidate.effect)
    general = objections(before, trial.fitted, term, simulation.observations, config)
    return [*general, *simulation.objections(before, trial.fitted, term, config)]


def _dominated_by(
    simulation: ForwardModel, before: ModelFit, trial: Trial, trials: Sequence[Trial], config: RefineConfig
) -> list[str]:
    """Why ``trial``, which passes, must not be named: a cause that is no richer explains more, and is not certain. (One
    that physics forbids does not count.)"""
    samples = min((t.fitted for t in trials), key=lambda f: f.cost).samples
    for other in trials:
        if (
            not other.passes
            and other.candidate.effect != trial.candidate.effect
            and len(other.fitted.parameters) <= len(trial.fitted.parameters)
            and other.fitted.bic(samples) < trial.fitted.bic(samples) - TELLS_APART
            and not simulation.objections(before, other.fitted, simulation.term(other.candidate.effect), config)
        ):
            return [f"{other.candidate.effect} explains more with no more parameters, and is not certain"]
    return []
