"""A further cause that hides in what noise and grid explain: the first one took most of it over.

A uniform force takes over the drag that acts beside it, and quadratic drag a linear one with viscosity, so well that
what is left is hardly more than the noise. A ranking on top of the first cause still sees the other, if on top of the
right one: so it is looked for beside the accepted cause and beside the one that came closest to it. That near to the
noise only a cause of one number is added to the accepted one, since it cannot adapt to an error of any shape.
"""

from __future__ import annotations

from masiv.inference.model_fit import ModelFit, warm_started_fit
from masiv.models.base import ForwardModel
from masiv.progress import Progress
from masiv.refine.add_effect import refit
from masiv.refine.candidates import Candidate
from masiv.refine.config import RefineConfig
from masiv.refine.evidence import beyond_possible, held_out, removed_of, sigmas_from_zero
from masiv.refine.rounds import Round, Trial, confusable
from masiv.refine.selection import named
from masiv.refine.tasks import map_tasks, ranked
from masiv.workers import TaskError, Workers

MIN_SHARE = 0.05
"""Share of what is left below which a cause is not tried."""
SHORTLIST = 2


def search_second_effect(
    simulation: ForwardModel,
    current: ModelFit,
    first: Round,
    robust_scale: float,
    config: RefineConfig,
    progress: Progress,
    workers: Workers,
) -> list[Round]:
    """Rounds on top of ``current``, the model with what ``first`` accepted, and of its closest rival. In the one that
    has the best of all trials, if that passes, a cause is named as in any round; else nothing is."""
    here = current.model
    rivals = [
        t.fitted
        for t in first.trials
        if t.passes and t.fitted.model.family is here.family and t.fitted.model.effects != here.effects
    ]
    bases = [current, *(warm_started_fit(simulation, rival, robust_scale) for rival in rivals[:1])]
    rounds = [_round(simulation, base, current, robust_scale, config, progress, workers) for base in bases]
    trials = [t for r in rounds for t in r.trials]
    if trials:
        samples = min((t.fitted for t in trials), key=lambda f: f.cost).samples
        best = min(trials, key=lambda t: t.fitted.bic(samples))
        for done in rounds:
            if best.passes and best in done.trials:
                ordered = sorted(done.trials, key=lambda t: t.fitted.bic(samples))
                done.accepted, done.indistinguishable_from = named(ordered, simulation.observations, config)
    return rounds


def _round(
    simulation: ForwardModel,
    base: ModelFit,
    best: ModelFit,
    robust_scale: float,
    config: RefineConfig,
    progress: Progress,
    workers: Workers,
) -> Round:
    beside = ", ".join(base.model.effects)
    names = [n for n in simulation.candidates(base.model) if len(simulation.term(n).parameters) == 1]
    names = [n for n in names if n in config.effects or not config.effects]
    if len(simulation.term(base.model.effects[-1]).parameters) > 1:
        # A rival of many numbers with the accepted cause beside it is that cause with many numbers beside it.
        names = [n for n in names if n not in best.model.effects]
    label = f"refine: rank what may act beside {beside}"
    candidates = ranked(
        workers, simulation, base, robust_scale=robust_scale, names=names,
        progress=lambda n, i, k: progress(label, i, k, n),
    )  # fmt: skip
    progress(label, 1, 1, candidates[0].effect if candidates else "none")
    trials = []
    worth = [c for c in candidates if c.explained >= MIN_SHARE][:SHORTLIST]
    label = f"refine: fit effects beside {beside}"
    progress(label, 0, len(worth), ", ".join(c.effect for c in worth))
    fits = map_tasks(workers, simulation, _fitted, [(base, candidate, robust_scale) for candidate in worth])
    for done, (candidate, fitted) in enumerate(zip(worth, fits, strict=True)):
        if isinstance(fitted, TaskError):
            progress(label, done + 1, len(worth), f"{candidate.effect}: {fitted.reason}")
            continue
        trials.append(Trial(candidate, fitted, objections(simulation, best, fitted, config)))
        progress(label, done + 1, len(worth), f"{candidate.effect}: {fitted.fit_mm:.1f} mm")
    return Round(base, candidates, trials, None, confusable(candidates, trials, config.confusable))


def _fitted(simulation: ForwardModel, base: ModelFit, candidate: Candidate, robust_scale: float) -> ModelFit:
    return warm_started_fit(simulation, refit(simulation, base, candidate, robust_scale), robust_scale)


def objections(simulation: ForwardModel, before: ModelFit, after: ModelFit, config: RefineConfig) -> list[str]:
    """Why the effects of ``after`` are not named instead of those of ``before``, which are one fewer; empty where they
    are. Each must be there for certain, and held-out instants must confirm the two, the more so where the information
    criterion is not clear. (Noise that is smooth in space and time looks like a slightly other gravity: what fitted
    instants alone say is not enough so near to it.)"""
    out = []
    gain = before.bic(after.samples) - after.bic(after.samples)
    if gain < config.least_bic:
        out.append(f"the information criterion falls by {gain:.1f}, less than {config.least_bic:g}")
    for name in after.model.effects:
        term = simulation.term(name)
        sigmas = sigmas_from_zero(after, term)
        if not sigmas >= config.least_sigmas:
            out.append(f"{name} is {sigmas:.1f} standard errors from zero, less than {config.least_sigmas:g}")
        out += beyond_possible(after, term)
        out += simulation.objections(before, after, term, config)
    was, now = (held_out(f, simulation.observations) for f in (before, after))
    clear = gain >= config.clear_bic
    if len(was):
        removed = removed_of(was, now)
        asked = config.least_gain * (1 if clear else 2)
        if removed < asked:
            out.append(f"it removes {100 * removed:.0f} % of the held-out error (asked: {100 * asked:.0f} %)")
    elif not clear:
        out.append(f"the information criterion falls by {gain:.1f}, less than {config.clear_bic:g}")
    return out
