"""Fit a model with one more effect through the rollout, from what the score test says of it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from masiv.refine.refit import (
    Fitted,
    best_strength,
    chord_fit,
    column,
    full_fit,
    leapt,
    ordered,
    robust_cost,
    summarised,
)
from masiv.refine.score import Candidate
from masiv.refine.simulated import Simulated, Term

CHORD_STEPS = 8


def refit(simulation: Simulated, base: Fitted, candidate: Candidate, soft: float) -> Fitted:
    """``base`` with the effect: strengths jointly with law and throw; then its places or frequencies as well, where
    the information criterion asks for it. Else they are as guessed, and without a standard error."""
    term = simulation.term(candidate.effect)
    model = base.model.with_effect(term.name)
    params = simulation.parameters(model)
    names = [p.name for p in params]
    first = [p for p in params if p not in term.others]
    jacobian = _assembled(first, base, candidate, [p.name for p in term.strengths])
    others = {p.name: candidate.theta[p.name] for p in term.others}
    values = {**absent(term, base.values), **others}
    residual = simulation.residual(model, values) if term.stands_for else base.residual
    values, residual, jacobian = leapt(simulation, model, first, values, residual, jacobian, soft=soft)
    values, residual, jacobian = chord_fit(
        simulation, model, first, values, residual, jacobian, steps=CHORD_STEPS, soft=soft
    )
    cost = robust_cost(residual, soft)
    if base.cost - cost < 0.5 * candidate.explained * base.cost:  # far from the promise: not linear about zero
        start = {**absent(term, base.values), **others}
        start |= {p.name: start[p.name] + candidate.theta[p.name] for p in term.strengths}
        jump, jumped = best_strength(simulation, model, start, term.strengths, soft)
        if jumped < cost:
            return full_fit(simulation, model, jump, budget=2 * len(params) + 6, soft=soft)
    if not others:
        return summarised(simulation, model, params, values, jacobian, soft=soft)
    guessed = summarised(simulation, model, first, values, jacobian, soft=soft)
    for _ in range(2):
        extra = [p for p in params if p.name in others]
        wide = np.column_stack([jacobian, *[column(simulation, model, values, residual, p) for p in extra]])
        values, residual, wide = chord_fit(
            simulation, model, [*first, *extra], values, residual, wide, steps=CHORD_STEPS - 2, soft=soft
        )
        jacobian = wide[:, : len(first)]
    order = [[*(p.name for p in first), *others].index(n) for n in names]
    placed = summarised(simulation, model, params, values, wide[:, order], soft=soft)
    return ordered([guessed, placed])[0]


def absent(term: Term, values: Mapping[str, float]) -> dict[str, float]:
    """``values`` for a model with ``term`` that moves as the one without did: no strength, or that of what it stands
    for."""
    out = {**values, **{p.name: 0.0 for p in term.strengths}}
    known = [values[name] for name in term.stands_for if name in values]
    if known:
        out[term.strengths[0].name] = sum(known) / len(known)
    return out | dict.fromkeys(term.stands_for, 0.0)


def _assembled(first, base: Fitted, candidate: Candidate, strengths: list[str]) -> np.ndarray:
    known = {p.name: base.jacobian[:, k] for k, p in enumerate(base.parameters)}
    known |= {name: candidate.columns[:, k] for k, name in enumerate(strengths)}
    return np.stack([known[p.name] for p in first], axis=1)
