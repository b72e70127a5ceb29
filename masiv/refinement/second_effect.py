"""A further effect that hides in what noise and discretization explain: the first one took most of it over.

A uniform force takes over the drag that acts in addition, and quadratic drag a linear one with viscosity, so well that
the residual is hardly above the noise. A ranking on top of the first effect still sees the other, if on top of the
right one: so it is looked for in addition to the accepted effect, and in addition to the one that came closest to it.
That near to the noise only an effect of one parameter is added, since it cannot adapt to an error of any shape.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from masiv.inference.model_fit import ModelFit, common_samples, warm_started_fit
from masiv.inference.noise_model import NoiseModel
from masiv.models.base import ForwardModel
from masiv.refinement.candidates import Candidate
from masiv.refinement.config import RefineConfig
from masiv.refinement.effect_fit import fit_with_effect
from masiv.refinement.evidence import parameters_at_bounds, rms_reduction, strength_z
from masiv.refinement.rounds import Round, confusable, rank_trials
from masiv.refinement.search_round import trials_of
from masiv.refinement.search_state import SearchSettings, SearchState
from masiv.refinement.selection import Selection, select
from masiv.refinement.tasks import map_tasks, rank

MIN_SHARE = 0.05
"""Share of the residual below which an effect is not tried."""
SHORTLIST = 2
"""Effects that are fitted in addition to one base."""


@dataclass(frozen=True)
class SecondSearch:
    """fit: the model with what was accepted in the end; first: the round before, which names the effect of that model
    that it had tried; rounds: what was tried in addition."""

    fit: ModelFit
    first: Round
    rounds: tuple[Round, ...] = ()


def search_second_effect(state: SearchState, first: Round, settings: SearchSettings) -> SecondSearch:
    """Rounds on top of ``state.fit``, the model with what ``first`` accepted, and on top of its closest rival. In the
    one that has the best of all trials, if that passes, an effect is named as in any round."""
    here = state.fit.model
    rivals = [
        t.fitted
        for t in first.trials
        if t.passes and t.fitted.model.family is here.family and t.fitted.model.effects != here.effects
    ]
    bases = [state.fit, *(warm_started_fit(state.forward_model, r, state.robust_scale) for r in rivals[:1])]
    rounds = [_round(state, base, settings) for base in bases]
    trials = [t for r in rounds for t in r.trials]
    best = rank_trials(trials)[0] if trials else None
    for k, done in enumerate(rounds):
        if best is not None and best.passes and any(t is best for t in done.trials):
            samples = common_samples([t.fitted for t in trials])
            ordered = sorted(done.trials, key=lambda t: t.fitted.bic(samples))
            selection = select(ordered, state.noise, settings.config)
            rounds[k] = _accepting(done, selection)
    return _merged(state, first, tuple(rounds))


def _accepting(done: Round, selection: Selection) -> Round:
    return replace(done, accepted=selection.trial, indistinguishable_from=selection.indistinguishable_from)


def _merged(state: SearchState, first: Round, rounds: tuple[Round, ...]) -> SecondSearch:
    """With the two effects that explain more, if ``rounds`` accepted any."""
    accepting = next((r for r in rounds if r.accepted is not None), None)
    if accepting is None or accepting.accepted is None:
        return SecondSearch(state.fit, first, rounds)
    fit = accepting.accepted.fitted
    if first.accepted is not None and accepting.base.model.effects != state.fit.model.effects:
        (name,) = set(accepting.base.model.effects) - set(first.base.model.effects)
        why = f"{' and '.join(fit.model.effects)} together explain more"
        was = first.accepted
        trials = [replace(t, objections=(*t.objections, why)) if t is was else t for t in first.trials]
        named = next(t for t in trials if t.effect == name and t.passes)
        first = replace(first, trials=tuple(trials), accepted=named, indistinguishable_from=())
    return SecondSearch(fit, first, rounds)


def _round(state: SearchState, base: ModelFit, settings: SearchSettings) -> Round:
    """What may act in addition to the effects of ``base``."""
    model = state.forward_model
    names = [n for n in settings.considered(model, base.model) if len(model.term(n).parameters) == 1]
    if len(model.term(base.model.effects[-1]).parameters) > 1:
        # A rival of several parameters, to which the accepted effect is added, is that effect with several in addition.
        names = [n for n in names if n not in state.fit.model.effects]
    existing = ", ".join(base.model.effects)
    label = f"refine: rank what may act in addition to {existing}"
    ranking = rank(
        settings.workers, model, base, names, robust_scale=state.robust_scale,
        progress=lambda n, i, k: settings.progress(label, i, k, n),
    )  # fmt: skip
    settings.progress(label, 1, 1, ranking.candidates[0].effect if ranking.candidates else "none")
    shortlist = [c for c in ranking.candidates if c.explained >= MIN_SHARE][:SHORTLIST]
    tasks = [(base, candidate, state.robust_scale) for candidate in shortlist]
    fits = map_tasks(settings.workers, model, _fit_in_addition, tasks)
    label = f"refine: fit effects in addition to {existing}"
    trials, failures = trials_of(label, base.model.family.kind, shortlist, fits, settings)
    with_objections = [
        replace(t, objections=tuple(objections_to_pair(model, state.fit, t.fitted, settings.config))) for t in trials
    ]
    alike = confusable(ranking, with_objections, settings.config.confusable_correlation)
    return Round(base, ranking, tuple(with_objections), None, alike, failures=tuple(failures))


def _fit_in_addition(
    forward_model: ForwardModel, base: ModelFit, candidate: Candidate, robust_scale: float
) -> ModelFit:
    fitted = fit_with_effect(forward_model, base, candidate, robust_scale)
    return warm_started_fit(forward_model, fitted, robust_scale)


def objections_to_pair(
    forward_model: ForwardModel, before: ModelFit, after: ModelFit, config: RefineConfig
) -> list[str]:
    """Why the effects of ``after`` are not named instead of those of ``before``, which are one fewer; empty if they
    are. Each must be significant, and held-out instants must confirm the two, the more so if the information criterion
    is not clear. (Noise that is smooth in space and time looks like a slightly other gravity: what fitted instants
    alone say is not enough so near to it.)"""
    out = []
    gain = after.bic_gain(before)
    if gain < config.min_bic_gain:
        out.append(f"the information criterion falls by {gain:.1f}, less than {config.min_bic_gain:g}")
    for name in after.model.effects:
        term = forward_model.term(name)
        z = strength_z(after, term)
        if not z >= config.min_strength_z:
            out.append(f"{name} is {z:.1f} standard errors from zero, less than {config.min_strength_z:g}")
        out += parameters_at_bounds(after, term)
        out += forward_model.objections(before, after, term, config.min_gain)
    noise = NoiseModel(forward_model.observations)
    was, now = (noise.held_out(f.squares) for f in (before, after))
    clear = gain >= config.clear_bic_gain
    if len(was):
        removed = rms_reduction(was, now)
        asked = config.min_gain * (1 if clear else 2)
        if removed < asked:
            out.append(f"it removes {100 * removed:.0f} % of the held-out error (asked: {100 * asked:.0f} %)")
    elif not clear:
        out.append(f"the information criterion falls by {gain:.1f}, less than {config.clear_bic_gain:g}")
    return out
