"""Fit a model with one more effect through the rollout, from what the score test says of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from masiv.errors import NonFiniteError
from masiv.inference.least_squares import Linearization, broyden, derivatives, gauss_newton_jump
from masiv.inference.model_fit import (
    ModelFit,
    best_strength,
    evaluate_fit,
    gauss_newton_fit,
    held_parameters,
    rank_by_bic,
    residual_of,
)
from masiv.inference.robust import soft_l1_mean_square
from masiv.models.base import EffectTerm, ForwardModel
from masiv.models.parameters import Parameter
from masiv.refinement.candidates import Candidate

BROYDEN_STEPS = 8
"""Steps of a refit with the Jacobian of the score test."""
FINITE_FACTORS = (0.5, 0.7, 1.0, 1.4, 2.0)
"""Factors of a strength that was tried among a few far apart."""
MIN_PROMISE_KEPT = 0.5
"""Part of what the linear model promised below which a refit fell short of it: the effect is not linear about zero."""


def fit_with_effect(forward_model: ForwardModel, base: ModelFit, candidate: Candidate, robust_scale: float) -> ModelFit:
    """``base`` with the effect: strengths jointly with law and initial state; then its places or frequencies as well,
    if the information criterion asks for it. Else they are as guessed, and without a standard error. What ``base``
    itself left at a guess stays there. If that falls short of the promise, the effect is started at the candidate's
    alternatives too, and the best goes on. Raises NonFiniteError."""
    if candidate.finite:
        return _from_finite_strengths(forward_model, base, candidate, robust_scale)
    fit = _EffectFit.of(forward_model, base, candidate, robust_scale)
    if fit.falls_short:
        for alternative in candidate.alternatives:
            other = _EffectFit.of(forward_model, base, alternative, robust_scale)
            if other.cost < fit.cost:
                fit = other
    if fit.falls_short:
        again = fit.with_fresh_derivatives()
        if again is not None:
            return again
    guessed = fit.evaluated(fit.guessed_parameters, fit.here)
    if not fit.places:
        return guessed
    try:
        return rank_by_bic([guessed, fit.with_free_places()])[0]
    except NonFiniteError:  # its places cannot be varied
        return guessed


@dataclass(frozen=True)
class _EffectFit:
    """``base`` with an effect whose places are as ``candidate`` has them. here: the strengths fitted jointly with what
    ``base`` fits; guessed_parameters: these; places: values of the effect's other parameters."""

    forward_model: ForwardModel
    base: ModelFit
    candidate: Candidate
    robust_scale: float
    term: EffectTerm
    guessed_parameters: list[Parameter]
    here: Linearization

    @classmethod
    def of(cls, forward_model: ForwardModel, base: ModelFit, candidate: Candidate, robust_scale: float) -> _EffectFit:
        """Jump to the minimum of the linear model, then Broyden's steps. Raises NonFiniteError."""
        term = forward_model.term(candidate.effect)
        model = base.model.with_effect(term.name)
        residual = residual_of(forward_model, model)
        parameters = [p for p in _parameters(forward_model, base, term) if p not in term.others]
        values = {**absent(term, base.values), **{p.name: candidate.theta[p.name] for p in term.others}}
        here = residual(values) if term.replaces_parameter else base.residual
        start = Linearization(values, here, _jacobian(parameters, base, candidate, term))
        start = gauss_newton_jump(residual, parameters, start, robust_scale=robust_scale)
        reached = broyden(residual, parameters, start, steps=BROYDEN_STEPS, robust_scale=robust_scale)
        return cls(forward_model, base, candidate, robust_scale, term, parameters, reached)

    @property
    def places(self) -> dict[str, float]:
        return {p.name: self.candidate.theta[p.name] for p in self.term.others}

    @property
    def cost(self) -> float:
        """[m²]"""
        return soft_l1_mean_square(self.here.residual, self.robust_scale)

    @property
    def falls_short(self) -> bool:
        """Whether it explains much less than the ranking promised."""
        gained = self.base.cost - self.cost
        return gained < MIN_PROMISE_KEPT * self.candidate.explained * self.base.cost

    @property
    def parameters(self) -> list[Parameter]:
        return _parameters(self.forward_model, self.base, self.term)

    def evaluated(self, parameters: Sequence[Parameter], here: Linearization) -> ModelFit:
        model = self.base.model.with_effect(self.term.name)
        return evaluate_fit(
            self.forward_model, model, parameters, here.values, here.jacobian, robust_scale=self.robust_scale
        )

    def with_fresh_derivatives(self) -> ModelFit | None:
        """Gauss-Newton from the best of some strengths; or from here if the effect has no places: a narrow valley (a
        clock that is off, against the initial velocity) needs its derivatives anew. None if neither helps."""
        model = self.base.model.with_effect(self.term.name)
        start = {**absent(self.term, self.base.values), **self.places}
        start |= {p.name: start[p.name] + self.candidate.theta[p.name] for p in self.term.strengths}
        jump, cost = best_strength(self.forward_model, model, start, self.term.strengths, self.robust_scale)
        count = len(self.parameters)
        if cost < self.cost:
            values, budget = jump, 2 * count + 6
        elif not self.places:
            values, budget = self.here.values, 4 * (count + 1)
        else:
            return None
        return gauss_newton_fit(
            self.forward_model, model, values, budget=budget, robust_scale=self.robust_scale,
            held=held_parameters(self.forward_model, self.base),
        )  # fmt: skip

    def with_free_places(self) -> ModelFit:
        """Places fitted as well, their derivatives taken twice. Raises NonFiniteError."""
        residual = residual_of(self.forward_model, self.base.model.with_effect(self.term.name))
        extra = [p for p in self.parameters if p.name in self.places]
        every = [*self.guessed_parameters, *extra]
        known, here = len(self.guessed_parameters), self.here
        for _ in range(2):
            columns = derivatives(residual, here.values, here.residual, extra)
            wide = np.column_stack([here.jacobian[:, :known], *columns])
            here = broyden(
                residual, every, Linearization(here.values, here.residual, wide),
                steps=BROYDEN_STEPS - 2, robust_scale=self.robust_scale,
            )  # fmt: skip
        names = [p.name for p in every]
        order = [names.index(p.name) for p in self.parameters]
        ordered = Linearization(here.values, here.residual, here.jacobian[:, order])
        return self.evaluated(self.parameters, ordered)


def _from_finite_strengths(
    forward_model: ForwardModel, base: ModelFit, candidate: Candidate, robust_scale: float
) -> ModelFit:
    """The best fit from strengths of the candidate and of its alternatives that were tried through the rollout, the
    places held as they have them. Raises NonFiniteError if all diverge."""
    term = forward_model.term(candidate.effect)
    model = base.model.with_effect(term.name)
    held = frozenset(p.name for p in term.others) | held_parameters(forward_model, base)
    budget = 4 * (len(forward_model.parameters(model)) - len(held) + 1)
    fits, failed = [], None
    for at in (candidate, *candidate.alternatives):
        try:
            start, _ = best_strength(
                forward_model, model, {**base.values, **at.theta}, term.strengths, robust_scale, FINITE_FACTORS
            )
            fits.append(
                gauss_newton_fit(forward_model, model, start, budget=budget, robust_scale=robust_scale, held=held)
            )
        except NonFiniteError as error:
            failed = error
    if failed is not None and not fits:
        raise failed
    return min(fits, key=lambda f: f.cost)


def _parameters(forward_model: ForwardModel, base: ModelFit, term: EffectTerm) -> list[Parameter]:
    """The parameters of ``base`` with ``term``, but for those that ``base`` left at a guess: these stay there."""
    held = held_parameters(forward_model, base)
    return [p for p in forward_model.parameters(base.model.with_effect(term.name)) if p.name not in held]


def _jacobian(parameters: Sequence[Parameter], base: ModelFit, candidate: Candidate, term: EffectTerm) -> np.ndarray:
    """(M, P) from the columns of ``base`` and of the score test."""
    known = {p.name: base.jacobian[:, k] for k, p in enumerate(base.parameters)}
    known |= {p.name: candidate.columns[:, k] for k, p in enumerate(term.strengths)}
    return np.stack([known[p.name] for p in parameters], axis=1)


def absent(term: EffectTerm, values: Mapping[str, float]) -> dict[str, float]:
    """``values`` for a model with ``term`` that moves as the one without did: strength zero, or that of the parameters
    that it replaces."""
    out = {**values, **{p.name: 0.0 for p in term.strengths}}
    known = [values[name] for name in term.replaces_parameter if name in values]
    if known:
        out[term.strengths[0].name] = sum(known) / len(known)
    return out | dict.fromkeys(term.replaces_parameter, 0.0)
