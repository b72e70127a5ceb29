"""The loop: rank the effects, fit the best through the rollout, accept what held-out data confirms, and again."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from masiv.errors import MasivError
from masiv.refine.add_effect import CHORD_STEPS, refit
from masiv.refine.config import RefineConfig
from masiv.refine.evidence import above_noise, excess, foretelling, objections
from masiv.refine.grids import weighed, with_grid_errors
from masiv.refine.naming import named
from masiv.refine.refit import Fitted, carried, full_fit, held_in, ordered, reweighted, softness, strengths_alone
from masiv.refine.rounds import TELLS_APART, Round, Trial, confusable
from masiv.refine.score import Candidate, score
from masiv.refine.second_look import second_look
from masiv.refine.simulated import Simulated
from masiv.refine.tasks import ranked, side_by_side
from masiv.workers import Failed, Workers, demanded

Say = Callable[[str, int, int, str], None]
STOP_GAP = "smooth_force"
SOFT = 5.0
"""Sizes of the noise from which a weighted residual counts as wild, at the least."""
ESCAPE = 0.5
"""Share of a model's cost from which one with an effect more may have got out of a minimum that is none."""
MISJUDGED = 1.5
"""By how much a ranking, which is linear, may have judged a cause too small."""


@dataclass
class Outcome:
    """before: the best model without effects. after: with what was accepted, ``before`` itself where nothing was.
    gap: ``after`` with a smooth force for what is still unexplained, None where there is no need or no use."""

    before: Fitted
    after: Fitted
    rounds: list[Round]
    gap: Fitted | None = None


def close_loop(
    simulation: Simulated, baselines: Sequence[Fitted], config: RefineConfig, say: Say, workers: Workers | None = None
) -> Outcome:
    """Add effects to the best of ``baselines`` (one a law, without effects) until none is confirmed, or the residual is
    near the noise. Gives the experiments of ``simulation`` their sigma, and ``workers`` what need not wait."""
    workers = workers or Workers()
    observation = [e.sigma for e in simulation.experiments]
    rivals, soft = _weighed_baselines(simulation, baselines, observation, config, say, workers)
    before = current = rivals[0]
    rounds: list[Round] = []
    while len(rounds) < config.max_effects and above_noise(current, simulation.experiments, config):
        done = _round(simulation, current, rivals, soft, config, say, workers)
        rounds.append(done)
        if done.accepted is None:
            current = done.base
            break
        current = done.accepted.fitted
        look = config.second_look and len(rounds) < config.max_effects
        if excess(current, simulation.experiments) < config.unexplained and not look:
            break
        # With the effect the body may touch what it did not, earlier than before: what a finer grid changes is another.
        if weigh(simulation, current, observation):
            current = carried(simulation, current, soft)
        rivals = [current]
        if excess(current, simulation.experiments) < config.unexplained:
            if look:
                looks = second_look(simulation, current, done, soft, config, say, workers)
                rounds += looks
                current = _told_apart(current, done, looks)
            break
    experiments = simulation.experiments
    left, there_was = excess(current, experiments), excess(before, experiments)
    if current is not before and left > max(config.unexplained, there_was / 2):
        for done in rounds:  # no name for what it does not explain
            if done.accepted is not None:
                done.accepted.reasons.append(f"it leaves a residual of {left:.1f} times what noise and grid explain")
                done.accepted = None
        current = before
    gap = None
    if config.shortlist and excess(current, experiments) > config.unexplained:
        gap = stop_gap(simulation, current, soft, config, say)
    known = with_grid_errors(simulation, current, soft)
    return Outcome(known if current is before else before, known, rounds, gap)


def _weighed_baselines(
    simulation: Simulated,
    baselines: Sequence[Fitted],
    observation: Sequence[np.ndarray],
    config: RefineConfig,
    say: Say,
    workers: Workers,
) -> tuple[list[Fitted], float]:
    """The best of ``baselines``, fitted again with sigma as the first of them moves; and the size from which residuals
    are wild. That one is the simplest that foretells the motion, since a law that takes an effect over where it is
    fitted is found out there; the others are ordered by the information criterion."""
    first = min(baselines, key=lambda f: f.cost)
    rivals, soft = [first], 0.0
    for _ in range(2):  # the one that is nearest before sigma is known may not be it
        weigh(simulation, first, observation)
        soft = max(softness(simulation.residual(first.model, first.values)), SOFT * simulation.experiments[0].noise)
        say("refine: weigh", 0, 1, "")
        again = side_by_side(workers, simulation, reweighted, [(base, CHORD_STEPS, soft) for base in baselines])
        rivals = ordered([demanded(fitted) for fitted in again])[: config.families]
        say("refine: weigh", 1, 1, "")
        best = foretelling(rivals, simulation.experiments)
        rivals.sort(key=lambda f, best=best: f is not best)
        if best.model == first.model:
            break
        first = best
    return rivals, soft


def _told_apart(current: Fitted, first: Round, looks: Sequence[Round]) -> Fitted:
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
            first.or_else = []
        return found
    return current


def stop_gap(simulation: Simulated, current: Fitted, soft: float, config: RefineConfig, say: Say) -> Fitted | None:
    """``current`` with a smooth force that stands in for what is not known; None where held-out data does not bear it
    out."""
    label = "refine: a smooth force for the rest"
    found = score(simulation, current, soft=soft, names=[STOP_GAP], progress=lambda n, i, k: say(label, i, k, n))
    if not found:
        return None
    try:
        fitted = refit(simulation, current, found[0], soft)
    except MasivError as failed:
        say(label, 1, 1, str(failed))
        return None
    say(label, 1, 1, f"{fitted.fit_mm:.1f} mm")
    term = simulation.term(STOP_GAP)
    return None if objections(current, fitted, term, simulation.experiments, config) else fitted


def weigh(simulation: Simulated, fitted: Fitted, observation: Sequence[np.ndarray]) -> bool:
    """Give each experiment of ``simulation`` its sigma, as ``fitted`` moves; ``observation`` is its part of it. Whether
    any is another than it was."""
    was = [e.sigma for e in simulation.experiments]
    simulation.experiments = weighed(simulation, fitted, observation)
    same = all(np.array_equal(e.sigma, s) for e, s in zip(simulation.experiments, was, strict=True))
    return not same


def _round(
    simulation: Simulated,
    current: Fitted,
    bases: Sequence[Fitted],
    soft: float,
    config: RefineConfig,
    say: Say,
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
        early, start = simulation.early(base), base
        if early:  # what comes late in such a motion pulls a fit of all of it away from the flight, too
            start = carried(early[0], replace(base, values=simulation.begun(base.values)), soft)
        candidates = ranked(
            workers, early[0] if early else simulation, start, soft=soft,
            names=names or config.effects or simulation.candidates(base.model),
            progress=lambda n, i, k, label=label: say(label, i, k, n),
        )  # fmt: skip
        say(label, 1, 1, candidates[0].effect if candidates else "none")
        worth = [c for c in candidates if c.explained >= config.least_explained]
        within = [c for c in worth[: config.shortlist] if early or in_reach(c, base, trials)]
        trials += _trials(simulation, early, start, within, soft, say, workers)
        if not ranking and _leaves_much(trials, simulation, config):
            # The ranking is linear: a cause that acts at a place may be far down in it.
            trials += _trials(
                simulation, early, start, worth[config.shortlist : 2 * config.shortlist], soft, say, workers
            )
        ranking = ranking or candidates
    _rank(trials)
    if trials:
        _second_chance(simulation, trials, soft, say, workers)
        _rank(trials)
        if current.model.effects:
            current = _escaped(simulation, current, trials[0].fitted, soft)
    alike = confusable(ranking, trials, config.confusable)
    accepted = None
    for trial in trials:
        trial.reasons = _reasons(simulation, current, trial, config)
    for trial, reason in [(t, _outdone(simulation, current, t, trials, config)) for t in trials if t.passes]:
        trial.reasons += reason
    trial, or_else = named(trials, simulation.experiments, config)
    if trial is not None:
        final = full_fit(
            simulation, trial.fitted.model, trial.fitted.values,
            budget=2 * len(trial.fitted.parameters) + 6, soft=soft, held=held_in(simulation, trial.fitted),
        )  # fmt: skip
        trial.fitted = _freed(simulation, min(final, trial.fitted, key=lambda f: f.cost), soft)
        trial.reasons = _reasons(simulation, current, trial, config)
        accepted = trial if trial.passes else None
    return Round(current, ranking, trials, accepted, alike, or_else if accepted else [])


def _trials(
    simulation: Simulated,
    early: Sequence[Simulated],
    start: Fitted,
    candidates: Sequence[Candidate],
    soft: float,
    say: Say,
    workers: Workers,
) -> list[Trial]:
    """``start`` with each of the ``candidates``, those that cannot be simulated left out."""
    label = f"refine: fit effects, {start.model.family.kind}"
    fits = side_by_side(workers, simulation, _fitted, [(early, start, candidate, soft) for candidate in candidates])
    say(label, 0, len(candidates), ", ".join(c.effect for c in candidates))
    trials = []
    for done, (candidate, fitted) in enumerate(zip(candidates, fits, strict=True)):
        if isinstance(fitted, Failed):
            say(label, done + 1, len(candidates), f"{candidate.effect}: {fitted.reason}")
        else:
            trials.append(Trial(candidate, fitted))
            say(label, done + 1, len(candidates), candidate.effect)
    return trials


def _leaves_much(trials: Sequence[Trial], simulation: Simulated, config: RefineConfig) -> bool:
    """Whether the best of ``trials`` leaves more than noise and grid explain."""
    if not trials:
        return False
    best = min((t.fitted for t in trials), key=lambda f: f.cost)
    return excess(best, simulation.experiments) > config.above_noise


def in_reach(candidate: Candidate, base: Fitted, trials: Sequence[Trial]) -> bool:
    """Whether ``candidate``, should it explain MISJUDGED times what the ranking says, would be as good as the best of
    ``trials``: a law that explains the motion worse need not be fitted with what would not make up for that."""
    best = min((t.fitted.cost for t in trials), default=math.inf)
    return base.cost * (1 - min(MISJUDGED * candidate.explained, 1.0)) <= best


def _rank(trials: list[Trial]) -> None:
    rank = {id(f): k for k, f in enumerate(ordered([t.fitted for t in trials]))}
    trials.sort(key=lambda t: rank[id(t.fitted)])


def _fitted(
    simulation: Simulated, early: Sequence[Simulated], start: Fitted, candidate: Candidate, soft: float
) -> Fitted:
    """``start`` with the candidate, through the ``early`` simulations first."""
    fitted = refit(early[0] if early else simulation, start, candidate, soft)
    for longer in (*early[1:], simulation) if early else ():
        fitted = carried(longer, fitted, soft)
    return fitted


def _second_chance(simulation: Simulated, trials: Sequence[Trial], soft: float, say: Say, workers: Workers) -> None:
    """Fit what is simpler than the best trial, with the same law, again from where the best one ended: a flexible cause
    that found the right law and launch must not win for that alone. So too what has a kink and is no richer: its
    derivatives at a law that made up for it point to next to nothing."""
    best = trials[0].fitted

    def worth(trial: Trial) -> bool:
        mine, its = len(trial.fitted.parameters), len(best.parameters)
        return mine < its or (mine == its and simulation.term(trial.candidate.effect).kinked)

    simpler = [t for t in trials[1:] if t.fitted.model.family.kind == best.model.family.kind and worth(t)]
    fits = side_by_side(
        workers, simulation, _fitted_from, [(t.fitted, t.candidate.effect, best, soft) for t in simpler]
    )
    for done, (trial, again) in enumerate(zip(simpler, fits, strict=True)):
        say("refine: fit simpler effects again", done + 1, len(simpler), trial.candidate.effect)
        if not isinstance(again, Failed):
            trial.fitted = min(again, trial.fitted, key=lambda f: f.cost)


def _escaped(simulation: Simulated, base: Fitted, best: Fitted, soft: float) -> Fitted:
    """``base``, or where it ends from what it shares with ``best``, a model with one more effect: where a body meets an
    obstacle there are minima that are none, and what helps out of one is no cause."""
    if best.cost > ESCAPE * base.cost:
        return base
    values = {n: best.values.get(n, value) for n, value in base.values.items()}
    try:
        again = full_fit(
            simulation, base.model, values, budget=2 * (len(values) + 2), soft=soft, held=held_in(simulation, base)
        )
    except MasivError:
        return base
    return min(base, again, key=lambda f: f.cost)


def _fitted_from(simulation: Simulated, fitted: Fitted, name: str, best: Fitted, soft: float) -> Fitted:
    """``fitted``, a model with the term ``name``, from where what it shares with ``best`` ended."""
    shared = {p.name for p in fitted.parameters} & {p.name for p in best.parameters}
    values = {**fitted.values, **{n: best.values[n] for n in shared}}
    values = strengths_alone(simulation, fitted.model, values, simulation.term(name).strengths, soft)
    # What has a kink is begun far from where it ends: four derivatives for two.
    budget = (4 if simulation.term(name).kinked else 2) * (len(fitted.parameters) + 2)
    return full_fit(simulation, fitted.model, values, budget=budget, soft=soft, held=held_in(simulation, fitted))


def _freed(simulation: Simulated, fitted: Fitted, soft: float) -> Fitted:
    """With what was left at a guess fitted as well, where the information criterion asks for it."""
    if not held_in(simulation, fitted):
        return fitted
    budget = 3 * (len(fitted.values) + 1)
    try:
        return ordered([fitted, full_fit(simulation, fitted.model, fitted.values, budget=budget, soft=soft)])[0]
    except MasivError:
        return fitted


def _reasons(simulation: Simulated, before: Fitted, trial: Trial, config: RefineConfig) -> list[str]:
    term = simulation.term(trial.candidate.effect)
    general = objections(before, trial.fitted, term, simulation.experiments, config)
    return [*general, *simulation.objections(before, trial.fitted, term, config)]


def _outdone(
    simulation: Simulated, before: Fitted, trial: Trial, trials: Sequence[Trial], config: RefineConfig
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
