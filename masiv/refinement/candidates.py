"""Which effects could explain a residual: a score test at zero strength, nuisances projected out.

For each effect the sensitivity S = ∂residual/∂strength takes one more rollout a strength. What initial state, ground
and law could have absorbed is projected out of residual and sensitivity. The part of the remaining residual along S is
the explained share R², the least-squares coefficient the strength (Rao's score or Lagrange-multiplier test).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from masiv.errors import NonFiniteError
from masiv.inference.least_squares import basis_of, free_parameters
from masiv.inference.model_fit import ModelFit
from masiv.inference.robust import soft_l1_mean_square, soft_l1_weight
from masiv.models.base import EffectTerm, ForwardModel
from masiv.models.parameters import Parameter
from masiv.refinement.spectrum import spectral_guesses

EXPLAINED_TIE_TOL = 0.02
"""Difference of explained shares below which two guesses explain the same."""
SECANT_STEPS = (1.0, 4.0, 16.0)
"""Strengths, in finite-difference steps, to which the change is taken of an effect that is not smooth."""
FINITE_STEPS = (4.0, 16.0, 64.0)
"""Strengths, in finite-difference steps, that are tried if derivatives at zero point nowhere."""
ALTERNATIVE_TOL = 0.1
"""Difference of explained shares that a refit may reverse: shares are of a linear model."""
MAX_ALTERNATIVES = 2
"""Other guesses that a candidate keeps."""


@dataclass(frozen=True)
class Candidate:
    """An effect as the ranking sees it. explained: share of the residual, 0 to 1. theta: all its parameters; columns
    (M, strengths): sensitivities at ``theta``'s places; pattern (M,): what it explains, unit length, weighted.
    alternatives: the same effect at other guesses that promise nearly as much, best first. finite: ``explained`` is no
    promise of a linear model, but what ``theta`` did explain through the rollout; there are no columns then."""

    effect: str
    explained: float
    theta: dict[str, float]
    stderr: dict[str, float]
    columns: np.ndarray
    pattern: np.ndarray
    alternatives: tuple[Candidate, ...] = ()
    finite: bool = False

    def correlation(self, other: Candidate) -> float:
        """|correlation| of what two effects explain."""
        return abs(float(self.pattern @ other.pattern))


@dataclass(frozen=True)
class Ranking:
    """Candidates, best explained first, and the effects that could not be ranked with the reason."""

    candidates: tuple[Candidate, ...] = ()
    not_ranked: dict[str, str] = field(default_factory=dict)


def score(
    forward_model: ForwardModel,
    base: ModelFit,
    names: Sequence[str],
    *,
    robust_scale: float,
    progress: Callable[[str, int, int], None] | None = None,
) -> Ranking:
    """The effects ``names``, but for those that ``base`` has.

    If ``base`` is out of phase with what was observed, a derivative says nothing of a strength that would bring it into
    phase: some finite strengths of each guess are rolled out instead."""
    test = ScoreTest.of(forward_model, base, robust_scale)
    finite = forward_model.is_out_of_phase(base.fields)
    candidates, not_ranked = [], {}
    todo = [n for n in names if n not in base.model.effects]
    for done, name in enumerate(todo):
        if progress is not None:
            progress(name, done, len(todo))
        try:
            candidates.append(test.candidate(forward_model.term(name), finite=finite))
        except NonFiniteError as error:
            not_ranked[name] = error.detail
    return Ranking(tuple(sorted(candidates, key=lambda c: -c.explained)), not_ranked)


@dataclass(frozen=True)
class ScoreTest:
    """Score tests of one fit. weight (M,): of the robust loss; nuisance (M, B): basis of what the fit's parameters can
    absorb; left (M,): the weighted residual without that."""

    forward_model: ForwardModel
    base: ModelFit
    robust_scale: float
    weight: np.ndarray
    nuisance: np.ndarray
    left: np.ndarray

    @classmethod
    def of(cls, forward_model: ForwardModel, base: ModelFit, robust_scale: float) -> ScoreTest:
        weight = soft_l1_weight(base.residual, robust_scale)
        weighted = base.jacobian * weight[:, None]
        # A parameter at a bound that the descent would cross absorbs nothing more.
        free = free_parameters(base.parameters, base.values, -weighted.T @ (base.residual * weight))
        nuisance = basis_of(weighted[:, free])
        left = _without(nuisance, base.residual * weight)
        return cls(forward_model, base, robust_scale, weight, nuisance, left)

    def candidate(self, term: EffectTerm, *, finite: bool) -> Candidate:
        """The best of the guesses of ``term``. Raises NonFiniteError if the rollouts of all diverge."""
        tried, failed = [], None
        for guess in self._guesses(term):
            for size in SECANT_STEPS if term.nonsmooth and not finite else SECANT_STEPS[:1]:
                try:
                    if finite:
                        direction = self._direction(term, guess)
                        if direction:
                            tried.append(self.finite(term, guess, direction))
                    else:
                        tried.append(self.linear(term, guess, size))
                except NonFiniteError as error:
                    failed = error
        if not tried:
            raise failed or NonFiniteError(0, 0, "no direction in which its strengths would act is known")
        return _smallest(tried, term)

    def _guesses(self, term: EffectTerm) -> Sequence[tuple[float, ...]]:
        """Those of ``term``, and for a frequency those at which the residual oscillates."""
        if [term.units.get(p.name) for p in term.others] != ["Hz"]:
            return term.guesses
        (p,) = term.others
        peaks = spectral_guesses(self.forward_model.observations, self.base.fields)
        return [*term.guesses, *((f,) for f in peaks if p.lower <= f <= p.upper)]

    def linear(self, term: EffectTerm, guess: tuple[float, ...], size: float) -> Candidate:
        """The effect with its places, frequencies… at ``guess``, linear from zero to ``size`` steps of its strengths.
        Raises NonFiniteError."""
        model = self.base.model.with_effect(term.name)
        strengths = term.strengths
        fixed = {p.name: value for p, value in zip(term.others, guess, strict=True)}
        absent = {**self.base.values, **{p.name: 0.0 for p in strengths}, **fixed}
        near = self.forward_model.held_at(absent)
        columns = []
        for p in strengths:
            far = min(size * p.step, p.upper)
            reached = near.residual(model, {**absent, p.name: far})
            columns.append((reached - self.base.residual) / far)
        s = np.stack(columns, axis=1)
        s_left = _without(self.nuisance, s * self.weight[:, None])
        theta, pattern = _within_bounds(s_left, self.left, strengths)
        total = float(self.left @ self.left)
        explained = 1 - float((self.left + pattern) @ (self.left + pattern)) / max(total, 1e-300)
        length = float(np.linalg.norm(pattern))
        samples = self.base.samples
        per_sample = total / max(samples - len(self.base.parameters) - len(strengths), 1)
        share = len(self.left) / max(samples, 1)
        spread = np.linalg.pinv(s_left.T @ s_left) * per_sample * share * samples / len(self.left)
        return Candidate(
            term.name,
            max(explained, 0.0),
            {**{p.name: float(t) for p, t in zip(strengths, theta, strict=True)}, **fixed},
            {p.name: float(np.sqrt(max(v, 0.0))) for p, v in zip(strengths, np.diag(spread), strict=True)},
            s,
            pattern / length if length > 0 else pattern,
        )

    def finite(self, term: EffectTerm, guess: tuple[float, ...], directions: Sequence[np.ndarray]) -> Candidate:
        """The best of some strengths along ``directions`` (strengths,), rolled out. Raises NonFiniteError if all
        diverge."""
        model = self.base.model.with_effect(term.name)
        fixed = {p.name: value for p, value in zip(term.others, guess, strict=True)}
        best: tuple[float, dict[str, float], np.ndarray] | None = None
        failed = NonFiniteError(0, 0, "no strength was tried")
        for steps, direction in ((steps, direction) for steps in FINITE_STEPS for direction in directions):
            strengths = {
                p.name: float(np.clip(steps * p.step * d, p.lower, p.upper))
                for p, d in zip(term.strengths, direction, strict=True)
            }
            try:
                residual = self.forward_model.residual(model, {**self.base.values, **strengths, **fixed})
            except NonFiniteError as error:
                failed = error
                continue
            cost = soft_l1_mean_square(residual, self.robust_scale)
            if best is None or cost < best[0]:
                best = cost, {**strengths, **fixed}, residual
        if best is None:
            raise failed
        cost, theta, residual = best
        change = (residual - self.base.residual) * self.weight
        return Candidate(
            term.name, max(1 - cost / max(self.base.cost, 1e-300), 0.0), theta,
            {p.name: np.inf for p in term.strengths}, np.zeros((len(residual), 0)),
            change / max(float(np.linalg.norm(change)), 1e-300), finite=True,
        )  # fmt: skip

    def _direction(self, term: EffectTerm, guess: tuple[float, ...]) -> list[np.ndarray]:
        """Directions (strengths,) of unit steps in which finite strengths are tried: both signs of one strength, that
        of the linear model of several. None if the linear model sees no effect."""
        if len(term.strengths) == 1:
            signs = [np.ones(1)]
            return [*signs, -np.ones(1)] if term.strengths[0].lower < 0 else signs
        linear = self.linear(term, guess, SECANT_STEPS[0])
        direction = np.array([linear.theta[p.name] / p.step for p in term.strengths])
        return [direction / np.abs(direction).max()] if direction.any() else []


def _smallest(tried: list[Candidate], term: EffectTerm) -> Candidate:
    """Of guesses that explain as much as the best one, the one with the smallest strength: much far in may look like
    little far out, and then the data bounds a strength from below alone."""
    best = max(c.explained for c in tried)
    smallest = min(
        (c for c in tried if c.explained >= best - EXPLAINED_TIE_TOL),
        key=lambda c: sum((c.theta[p.name] / p.step) ** 2 for p in term.strengths),
    )
    # Of strengths that were tried, the best of a guess may lie between two: no share of these says that it is worse.
    near = [c for c in tried if c is not smallest and (c.finite or c.explained >= best - ALTERNATIVE_TOL)]
    others = sorted(near, key=lambda c: -c.explained)
    return replace(smallest, alternatives=tuple(others[:MAX_ALTERNATIVES]))


def _within_bounds(s: np.ndarray, left: np.ndarray, strengths: Sequence[Parameter]) -> tuple[np.ndarray, np.ndarray]:
    """Strengths (S,) that minimise |left + s θ|, none of an impossible sign; and s θ."""
    from scipy.optimize import lsq_linear

    scale = np.array([p.step for p in strengths])
    lower = np.array([p.lower for p in strengths]) / scale
    upper = np.array([p.upper for p in strengths]) / scale
    # The normal equations are small and well scaled in units of steps.
    q, r = np.linalg.qr(s * scale)
    theta = lsq_linear(r, -(q.T @ left), (lower, upper)).x * scale
    return theta, s @ theta


def _without(basis: np.ndarray, a: np.ndarray) -> np.ndarray:
    return a - basis @ (basis.T @ a)
