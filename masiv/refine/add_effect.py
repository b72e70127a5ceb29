"""Fit a model with one more effect through the rollout, from what the score test says of it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from masiv.errors import NonFiniteError
from masiv.inference.model_fit import (
    ModelFit,
    best_strength,
    broyden_fit,
    column,
    evaluate_fit,
    gauss_newton_fit,
    gauss_newton_jump,
    held_in,
    ordered,
    robust_cost,
)
from masiv.models.base import EffectTerm, ForwardModel
from masiv.models.parameters import Parameter
from masiv.refine.candidates import Candidate

CHORD_STEPS = 8
BETWEEN = (0.5, 0.7, 1.0, 1.4, 2.0)
"""Of a strength that was tried among a few far apart."""


SHORT = 0.5
"""Share of what the linear model promised below which a refit fell short of it: the effect is not linear about zero."""


def refit(simulation: ForwardModel, base: ModelFit, candidate: Candidate, robust_scale: float) -> ModelFit:
    """``base`` with the effect: strengths jointly with law and throw; then its places or frequencies as well, where
    the information criterion asks for it. Else they are as guessed, and without a standard error. What ``base`` itself
    left at a guess stays there.

    Where that falls short of the promise, the effect is begun at the candidate's rivals too, and the best goes on."""
    if candidate.finite:
        return _from_strengths(simulation, base, candidate, robust_scale)
    term = simulation.term(candidate.effect)
    model = base.model.with_effect(term.name)
    held = held_in(simulation, base)
    params = _fitted_beside(simulation, base, term)
    names = [p.name for p in params]
    first = [p for p in params if p not in term.others]
    cost, values, residual, jacobian = _as_guessed(simulation, base, candidate, robust_scale)
    if _falls_short(base, candidate, cost):
        for rival in candidate.rivals:
            other = _as_guessed(simulation, base, rival, robust_scale)
            if other[0] < cost:
                candidate, (cost, values, residual, jacobian) = rival, other
    others = {p.name: candidate.theta[p.name] for p in term.others}
    if _falls_short(base, candidate, cost):
        start = {**absent(term, base.values), **others}
        start |= {p.name: start[p.name] + candidate.theta[p.name] for p in term.strengths}
        jump, jumped = best_strength(simulation, model, start, term.strengths, robust_scale)
        if jumped < cost:
            return gauss_newton_fit(
                simulation, model, jump, budget=2 * len(params) + 6, robust_scale=robust_scale, held=held
            )
        if not others:  # a narrow valley (a clock that is off, against the throw) needs its derivatives anew
            return gauss_newton_fit(
                simulation, model, values, budget=4 * (len(params) + 1), robust_scale=robust_scale, held=held
            )
    if not others:
        return evaluate_fit(simulation, model, params, values, jacobian, robust_scale=robust_scale)
    guessed = evaluate_fit(simulation, model, first, values, jacobian, robust_scale=robust_scale)
    for _ in range(2):
        extra = [p for p in params if p.name in others]
        wide = np.column_stack([jacobian, *[column(simulation, model, values, residual, p) for p in extra]])
        values, residual, wide = broyden_fit(
            simulation,
            model,
            [*first, *extra],
            values,
            residual,
            wide,
            steps=CHORD_STEPS - 2,
            robust_scale=robust_scale,
        )
        jacobian = wide[:, : len(first)]
    order = [[*(p.name for p in first), *others].index(n) for n in names]
    placed = evaluate_fit(simulation, model, params, values, wide[:, order], robust_scale=robust_scale)
    return ordered([guessed, placed])[0]


def _as_guessed(
    simulation: ForwardModel, base: ModelFit, candidate: Candidate, robust_scale: float
) -> tuple[float, dict[str, float], np.ndarray, np.ndarray]:
    """Strengths fitted jointly with what ``base`` fits, places as the candidate has them: cost [m^2], values, residual,
    and jacobian of these."""
    term = simulation.term(candidate.effect)
    model = base.model.with_effect(term.name)
    first = [p for p in _fitted_beside(simulation, base, term) if p not in term.others]
    jacobian = _assembled(first, base, candidate, [p.name for p in term.strengths])
    values = {**absent(term, base.values), **{p.name: candidate.theta[p.name] for p in term.others}}
    residual = simulation.residual(model, values) if term.replaces_parameter else base.residual
    values, residual, jacobian = gauss_newton_jump(
        simulation, model, first, values, residual, jacobian, robust_scale=robust_scale
    )
    values, residual, jacobian = broyden_fit(
        simulation, model, first, values, residual, jacobian, steps=CHORD_STEPS, robust_scale=robust_scale
    )
    return robust_cost(residual, robust_scale), values, residual, jacobian


def _from_strengths(simulation: ForwardModel, base: ModelFit, candidate: Candidate, robust_scale: float) -> ModelFit:
    """The best fit from strengths of the candidate and of its rivals that were tried through the rollout, the places
    held as they have them. Raises NonFiniteError where all diverge."""
    term = simulation.term(candidate.effect)
    model = base.model.with_effect(term.name)
    held = frozenset(p.name for p in term.others) | held_in(simulation, base)
    budget = 4 * (len(simulation.parameters(model)) - len(held) + 1)
    fits, failed = [], None
    for at in (candidate, *candidate.rivals):
        try:
            start, _ = best_strength(
                simulation, model, {**base.values, **at.theta}, term.strengths, robust_scale, BETWEEN
            )
            fits.append(gauss_newton_fit(simulation, model, start, budget=budget, robust_scale=robust_scale, held=held))
        except NonFiniteError as error:
            failed = error
    if failed is not None and not fits:
        raise failed
    return min(fits, key=lambda f: f.cost)


def _fitted_beside(simulation: ForwardModel, base: ModelFit, term: EffectTerm) -> list[Parameter]:
    """The parameters of ``base`` with ``term``, but for those that ``base`` left at a guess: these stay there."""
    held = held_in(simulation, base)
    return [p for p in simulation.parameters(base.model.with_effect(term.name)) if p.name not in held]


def _falls_short(base: ModelFit, candidate: Candidate, cost: float) -> bool:
    return base.cost - cost < SHORT * candidate.explained * base.cost


def absent(term: EffectTerm, values: Mapping[str, float]) -> dict[str, float]:
    """``values`` for a model with ``term`` that moves as the one without did: no strength, or that of what it stands
    for."""
    out = {**values, **{p.name: 0.0 for p in term.strengths}}
    known = [values[name] for name in term.replaces_parameter if name in values]
    if known:
        out[term.strengths[0].name] = sum(known) / len(known)
    return out | dict.fromkeys(term.replaces_parameter, 0.0)


def _assembled(first, base: ModelFit, candidate: Candidate, strengths: list[str]) -> np.ndarray:
    known = {p.name: base.jacobian[:, k] for k, p in enumerate(base.parameters)}
    known |= {name: candidate.columns[:, k] for k, name in enumerate(strengths)}
    return np.stack([known[p.name] for p in first], axis=1)
