"""Fits of a round again, from where the best one ended or from where they fell short."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from masiv.effects.catalogue import effect_named
from masiv.errors import MasivError
from masiv.inference.least_squares import Linearization, gauss_newton_jump
from masiv.inference.model_fit import (
    ModelFit,
    gauss_newton_fit,
    held_parameters,
    linear_minimum,
    linear_strengths,
    rank_by_bic,
    residual_of,
)
from masiv.models.base import EffectTerm, ForwardModel
from masiv.refinement.rounds import Trial
from masiv.refinement.search_state import SearchSettings, SearchState
from masiv.refinement.tasks import map_tasks
from masiv.refinement.trials import converged, could_improve, could_reach
from masiv.workers import TaskError

FALSE_MINIMUM_RATIO = 0.5
"""A model with one more effect that has less than this part of its base's cost may have got out of a false minimum."""
LONGER_BUDGET = 3
"""Derivatives that a fit may take that has not reached what the ranking promised."""
MIN_GAIN_LEFT = 0.3
"""Part of the cost that a fit must be able to lose by its own derivatives to go on: less is left to the evidence, which
extrapolates. Chosen with one draw in view, a strong drag on a body in the simulator."""
MAX_PASSES = 6
"""How often a fit goes on that has not ended. Chosen as that."""


def refit_simpler(state: SearchState, trials: Sequence[Trial], settings: SearchSettings) -> list[Trial]:
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


def refit_unconverged(
    state: SearchState, trials: Sequence[Trial], bases: Sequence[ModelFit], settings: SearchSettings
) -> list[Trial]:
    """Trials, best first, of which those go on with fresh derivatives that have not reached what the ranking promised,
    and those that have not ended: from where they are, and from where the best with the same law is. Those that would
    not be as good as the best trial if they kept their promise do not."""
    own = {b.model.family.kind: b for b in reversed(bases)}
    least, scale = trials[0].fitted.cost, state.robust_scale
    failed = [
        t
        for t in trials
        if (not converged(t, bases) and could_improve(t.candidate, own[t.law], trials))
        or _goes_on(t.fitted, least, scale)
    ]
    best = {law: next(t.fitted for t in trials if t.law == law) for law in {t.law for t in trials}}
    tasks = [(t.fitted, best[t.law], least, scale) for t in failed]
    again: dict[int, ModelFit] = {}
    results = map_tasks(settings.workers, state.forward_model, _refit_longer, tasks)
    for done, (trial, fit) in enumerate(zip(failed, results, strict=True)):
        settings.progress("refine: fit again what fell short", done + 1, len(failed), trial.effect)
        if not isinstance(fit, TaskError):
            again[id(trial)] = min(fit, trial.fitted, key=lambda f: f.cost)
    return [replace(t, fitted=again.get(id(t), t.fitted)) for t in trials]


def _goes_on(fitted: ModelFit, least: float, robust_scale: float) -> bool:
    """Whether ``fitted`` has much to gain by its own derivatives, and could then be as good as a fit of cost
    ``least``."""
    gain = 1 - linear_minimum(fitted, robust_scale) / max(fitted.cost, 1e-300)
    return gain > MIN_GAIN_LEFT and could_reach(fitted.cost, gain, least)


def _refit_longer(
    forward_model: ForwardModel, fitted: ModelFit, best: ModelFit, least: float, robust_scale: float
) -> ModelFit:
    """The better of ``fitted`` fitted on, and from what it shares with ``best``; until it has ended or cannot be as
    good as a fit of cost ``least``. Raises MasivError if neither start can be simulated."""
    own = {p.name for p in fitted.parameters}
    shared = {p.name: best.values[p.name] for p in best.parameters if p.name in own}
    starts = [fitted.values] if best is fitted else [fitted.values, {**fitted.values, **shared}]
    fits: list[ModelFit] = []
    failed: MasivError | None = None
    for values in starts:
        try:
            fits.append(_fitted_on(forward_model, fitted, values, LONGER_BUDGET, robust_scale))
        except MasivError as error:
            failed = error
    if not fits:
        assert failed is not None
        raise failed
    here = min(fits, key=lambda f: f.cost)
    for _ in range(MAX_PASSES):
        if not _goes_on(here, least, robust_scale):
            break
        residual = residual_of(forward_model, here.model)
        known = Linearization(here.values, here.residual, here.jacobian)
        jump = gauss_newton_jump(residual, here.parameters, known, robust_scale=robust_scale)
        try:
            reached = _fitted_on(forward_model, here, jump.values, LONGER_BUDGET, robust_scale)
        except MasivError:  # what was reached so far counts
            break
        if reached.cost >= here.cost:
            break
        here = reached
    return here


def _fitted_on(
    forward_model: ForwardModel, fitted: ModelFit, values: Mapping[str, float], derivatives: int, robust_scale: float
) -> ModelFit:
    """The model of ``fitted`` from ``values`` with at most so many derivatives. Raises MasivError."""
    return gauss_newton_fit(
        forward_model, fitted.model, values, budget=derivatives * (len(fitted.parameters) + 2),
        robust_scale=robust_scale, held=held_parameters(forward_model, fitted),
    )  # fmt: skip


def restart_base(state: SearchState, best: ModelFit) -> ModelFit:
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


def reasons_against(forward_model: ForwardModel, fitted: ModelFit, name: str) -> list[str]:
    """Why the term ``name`` cannot act as it was fitted; empty if it can."""
    term = forward_model.term(name)
    return [*forward_model.impossible(fitted, term), *parameters_at_bounds(fitted, term)]


def parameters_at_bounds(fitted: ModelFit, term: EffectTerm) -> list[str]:
    """Which parameters of ``term`` ran into the bound of what is possible."""
    # What acts on the matter at a place may well be at the body's face, where its place ends.
    bounded = term.strengths if effect_named(term.effect).hints.inside else term.parameters
    return [
        f"{p.name} runs into the bound of what is possible, {p.upper:g}"
        for p in bounded
        if fitted.values[p.name] >= p.upper - 1e-9 * abs(p.upper)
    ]


def with_free_places(state: SearchState, fitted: ModelFit) -> ModelFit:
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
