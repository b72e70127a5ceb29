"""The loop: rank the effects, fit the best through the rollout, accept what held-out data confirms, and again."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from masiv.errors import MasivError
from masiv.refine.config import RefineConfig
from masiv.refine.noise import Floor, floor_of
from masiv.refine.refit import Fitted, chord_fit, column, full_fit, softness, summarised
from masiv.refine.score import Candidate, alike, score
from masiv.refine.simulated import Simulated, Term

Say = Callable[[str, int, int, str], None]
CHORD_STEPS = 8
TELLS_APART = 6.0
"""Difference of the information criterion below which two refits explain the data equally well."""


@dataclass
class Trial:
    """An effect that was fitted through the rollout, and why it was or was not accepted."""

    candidate: Candidate
    fitted: Fitted
    reasons: list[str] = field(default_factory=list)

    @property
    def passes(self) -> bool:
        return not self.reasons


@dataclass
class Round:
    """One pass: what was tried on top of which model."""

    base: Fitted
    candidates: list[Candidate]
    trials: list[Trial]
    accepted: Trial | None
    confusable: dict[str, list[str]]


@dataclass
class Outcome:
    """before: the best model without effects. after: with what was accepted, ``before`` itself where nothing was."""

    before: Fitted
    after: Fitted
    rounds: list[Round]
    soft: float
    floor: Floor


def close_loop(
    simulation: Simulated, baselines: Sequence[Fitted], noise_mm: float, config: RefineConfig, say: Say
) -> Outcome:
    """Add effects to the best of ``baselines`` (one a law, without effects) until none is confirmed, or the residual is
    near the noise floor ``noise_mm`` of the observation."""
    soft = softness(min(baselines, key=lambda f: f.cost).residual)
    rivals = ordered([again(simulation, f, soft) for f in baselines])[: config.families]
    before = rivals[0]
    floor = floor_of(noise_mm, simulation, before)
    rounds: list[Round] = []
    current = before
    while len(rounds) < config.max_effects and current.fit_mm > config.above_noise * floor.total:
        done = _round(simulation, current, rivals, soft, floor, config, say)
        rounds.append(done)
        if done.accepted is None:
            break
        current = done.accepted.fitted
        rivals = [current]
    return Outcome(before, current, rounds, soft, floor)


def ordered(fits: Sequence[Fitted]) -> list[Fitted]:
    """Best first by the information criterion, at the number of samples of the fit with the least cost."""
    if not fits:
        return []
    samples = min(fits, key=lambda f: f.cost).samples
    return sorted(fits, key=lambda f: f.bic(samples))


def again(simulation: Simulated, fitted: Fitted, soft: float) -> Fitted:
    """``fitted`` with its cost in terms of ``soft``, so that costs compare."""
    return summarised(simulation, fitted.model, fitted.parameters, fitted.values, fitted.jacobian, soft=soft)


def _round(
    simulation: Simulated,
    current: Fitted,
    bases: Sequence[Fitted],
    soft: float,
    floor: Floor,
    config: RefineConfig,
    say: Say,
) -> Round:
    trials: list[Trial] = []
    ranking: list[Candidate] = []
    for base in bases:
        label = f"refine: rank effects, {base.model.family.kind}"
        early = simulation.early(base)
        start = base if not early else _carried(early[0], base, soft)
        candidates = score(
            early[0] if early else simulation,
            start,
            soft=soft,
            progress=lambda n, i, k, label=label: say(label, i, k, n),
        )
        say(label, 1, 1, candidates[0].effect if candidates else "none")
        if base is bases[0] or not ranking:
            ranking = candidates
        worth = [c for c in candidates if c.explained >= config.least_explained][: config.shortlist]
        for done, candidate in enumerate(worth):
            label = f"refine: fit effects, {base.model.family.kind}"
            say(label, done, len(worth), candidate.effect)
            try:
                fitted = refit(early[0] if early else simulation, start, candidate, soft)
                for longer in (*early[1:], simulation) if early else ():
                    fitted = _carried(longer, fitted, soft)
                trials.append(Trial(candidate, fitted))
            except MasivError as failed:
                say(label, done, len(worth), f"{candidate.effect}: {failed}")
        if worth:
            say(f"refine: fit effects, {base.model.family.kind}", len(worth), len(worth), "")
    rank = {id(f): k for k, f in enumerate(ordered([t.fitted for t in trials]))}
    trials.sort(key=lambda t: rank[id(t.fitted)])
    confusable = _confusable(ranking, trials, config.confusable)
    accepted = None
    for trial in trials:
        trial.reasons = _reasons(simulation, current, trial, floor, config)
    for k, trial in enumerate(t for t in trials if t.passes):
        if k > 0:
            break
        final = full_fit(
            simulation, trial.fitted.model, trial.fitted.values,
            budget=2 * len(trial.fitted.parameters) + 6, soft=soft,
        )  # fmt: skip
        trial.fitted = min(final, trial.fitted, key=lambda f: f.cost)
        trial.reasons = _reasons(simulation, current, trial, floor, config)
        accepted = trial if trial.passes else None
    return Round(current, ranking, trials, accepted, confusable)


def _carried(simulation: Simulated, fitted: Fitted, soft: float) -> Fitted:
    """``fitted`` as a start in another simulation of the same experiments."""
    budget = 2 * (len(fitted.parameters) + 1)
    return full_fit(simulation, fitted.model, fitted.values, budget=budget, soft=soft)


def refit(simulation: Simulated, base: Fitted, candidate: Candidate, soft: float) -> Fitted:
    """``base`` with the effect: strengths jointly with law and throw; then its places or frequencies as well."""
    term = simulation.term(candidate.effect)
    model = base.model.with_effect(term.name)
    params = simulation.parameters(model)
    names = [p.name for p in params]
    first = [p for p in params if p not in term.others]
    jacobian = _assembled(first, base, candidate, [p.name for p in term.strengths])
    others = {p.name: candidate.theta[p.name] for p in term.others}
    values = {**base.values, **{p.name: 0.0 for p in term.strengths}, **others}
    values, residual, jacobian = chord_fit(
        simulation, model, first, values, base.residual, jacobian, steps=CHORD_STEPS, soft=soft
    )
    for _ in range(2 if others else 0):
        extra = [p for p in params if p.name in others]
        wide = np.column_stack([jacobian, *[column(simulation, model, values, residual, p) for p in extra]])
        values, residual, wide = chord_fit(
            simulation, model, [*first, *extra], values, residual, wide, steps=CHORD_STEPS - 2, soft=soft
        )
        jacobian = wide[:, : len(first)]
    if others:
        order = [[*(p.name for p in first), *others].index(n) for n in names]
        jacobian = wide[:, order]
    return summarised(simulation, model, params, values, jacobian, soft=soft)


def _assembled(first, base: Fitted, candidate: Candidate, strengths: list[str]) -> np.ndarray:
    known = {p.name: base.jacobian[:, k] for k, p in enumerate(base.parameters)}
    known |= {name: candidate.columns[:, k] for k, name in enumerate(strengths)}
    return np.stack([known[p.name] for p in first], axis=1)


def _reasons(simulation: Simulated, before: Fitted, trial: Trial, floor: Floor, config: RefineConfig) -> list[str]:
    term = simulation.term(trial.candidate.effect)
    own = simulation.objections(before, trial.fitted, term, config)
    return [*objections(before, trial.fitted, term, floor, config), *own]


def objections(before: Fitted, after: Fitted, term: Term, floor: Floor, config: RefineConfig) -> list[str]:
    """Why ``term`` is not accepted; empty where it is."""
    out = []
    removed = math.sqrt(max(before.fit_mm**2 - after.fit_mm**2, 0.0))
    if removed < floor.fit:
        out.append(f"it explains {removed:.1f} mm, and a finer grid alone would change {floor.fit:.1f} mm")
    gain = before.bic(after.samples) - after.bic(after.samples)
    if gain < config.least_bic:
        out.append(f"the information criterion falls by {gain:.1f}, less than {config.least_bic:g}")
    if before.held_out_mm is not None and after.held_out_mm is not None:
        share = 1 - after.held_out_mm / before.held_out_mm
        removed = math.sqrt(max(before.held_out_mm**2 - after.held_out_mm**2, 0.0))
        if removed < floor.held_out:
            out.append(
                f"it explains {removed:.1f} mm held out, and a finer grid alone would change {floor.held_out:.1f} mm"
            )
        if share < config.least_gain:
            out.append(
                f"it removes {100 * share:.0f} % of the held-out error, less than {100 * config.least_gain:.0f} %"
            )
    sigmas = math.sqrt(sum((after.values[p.name] / after.stderr[p.name]) ** 2 for p in term.strengths))
    if not sigmas >= config.least_sigmas:
        out.append(f"its strength is {sigmas:.1f} standard errors from zero, less than {config.least_sigmas:g}")
    for p in term.parameters:
        if after.values[p.name] >= p.upper - 1e-9 * abs(p.upper):
            out.append(f"{p.name} runs into the bound of what is possible, {p.upper:g}")
    return out


def _confusable(ranking: list[Candidate], trials: list[Trial], least: float) -> dict[str, list[str]]:
    """Effects whose pattern in this data is nearly that of another."""
    out: dict[str, set[str]] = {c.effect: set() for c in ranking}
    for a in ranking:
        for b in ranking:
            if a.effect != b.effect and min(a.explained, b.explained) > 0.02 and alike(a, b) >= least:
                out[a.effect].add(b.effect)
    best: dict[str, float] = {}
    samples = min((t.fitted for t in trials), key=lambda f: f.cost).samples if trials else 0
    for t in trials:
        best[t.candidate.effect] = min(best.get(t.candidate.effect, math.inf), t.fitted.bic(samples))
    for a, bic_a in best.items():
        for b, bic_b in best.items():
            if a != b and abs(bic_a - bic_b) < TELLS_APART and a in out and b in out:
                out[a].add(b)
    return {name: sorted(others) for name, others in out.items()}
