"""Which effects could explain a residual: a score test at zero strength, nuisances projected out.

For each effect the sensitivity S = d residual / d strength comes from one more rollout a strength. What velocity, spin,
ground and law could have absorbed is projected out of residual and sensitivity; what then remains of the residual along
S is the explained share, the least-squares coefficient the strength (Rao's score or Lagrange-multiplier test).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from masiv.errors import NonFiniteError
from masiv.inference.least_squares import robust_weight
from masiv.inference.model_fit import ModelFit, free_parameters, robust_cost
from masiv.inference.smooth_noise import basis_of
from masiv.models.base import EffectTerm, ForwardModel

AS_MUCH = 0.02
"""Difference of explained shares that is none."""
SECANTS = (1.0, 4.0, 16.0)
"""Strengths, in steps, to which the change is taken for one with a kink."""
FINITE = (4.0, 16.0, 64.0)
"""Strengths, in steps, that are tried where derivatives at none point nowhere."""
NEARLY = 0.1
"""Difference of explained shares that a refit may reverse: shares are of a linear model."""
RIVALS = 2


@dataclass(frozen=True)
class Candidate:
    """An effect as the ranking sees it. explained: share of the residual, 0…1. theta: all its parameters; columns
    (M, strengths): sensitivities at ``theta``'s places; pattern (M,): what it explains, unit length, weighted. rivals:
    the same effect at other guesses that promise nearly as much, best first. finite: ``explained`` is no promise of a
    linear model, but what ``theta`` did explain through the rollout; there are no columns then."""

    effect: str
    explained: float
    theta: dict[str, float]
    stderr: dict[str, float]
    columns: np.ndarray
    pattern: np.ndarray
    rivals: tuple[Candidate, ...] = ()
    finite: bool = False


def score(
    simulation: ForwardModel,
    base: ModelFit,
    *,
    robust_scale: float,
    names: list[str] | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> list[Candidate]:
    """Every cause that ``base`` lacks, best explained first. names: only these, of all effects.

    Where ``base`` is out of phase with what was observed, a derivative says nothing of a strength that would bring it
    into phase: some finite strengths of each guess are rolled out instead."""
    weight = robust_weight(base.residual, robust_scale)
    weighted = base.jacobian * weight[:, None]
    # What is held at a bound that the descent would cross absorbs nothing more.
    free = free_parameters(base.parameters, base.values, -weighted.T @ (base.residual * weight))
    nuisance = basis_of(weighted[:, free])
    left = _without(nuisance, base.residual * weight)
    found, is_out_of_phase = [], simulation.is_out_of_phase(base)
    todo = [n for n in (names or simulation.candidates(base.model)) if n not in base.model.effects]
    for done, name in enumerate(todo):
        if progress is not None:
            progress(name, done, len(todo))
        term = simulation.term(name)
        sizes = SECANTS if term.nonsmooth else SECANTS[:1]
        tried = []
        for guess in term.guesses:
            linear = functools.partial(_tried, simulation, base, term, guess, weight, nuisance, left)
            if is_out_of_phase:
                way = linear(1.0) if len(term.strengths) > 1 else None
                tried.append(_finite(simulation, base, term, guess, way, robust_scale))
            else:
                tried += [linear(size) for size in sizes]
        known = [t for t in tried if t is not None]
        if known:
            found.append(_least(known, term))
    return sorted(found, key=lambda c: -c.explained)


def _least(tried: list[Candidate], term: EffectTerm) -> Candidate:
    """Of guesses that explain as much as the best one, the one that takes least: much far in may look like little far
    out, and then the data bounds a strength from below alone."""
    best = max(c.explained for c in tried)
    least = min(
        (c for c in tried if c.explained >= best - AS_MUCH),
        key=lambda c: sum((c.theta[p.name] / p.step) ** 2 for p in term.strengths),
    )
    # Of strengths that were tried, the best of a guess may lie between two: no share of these says that it is worse.
    near = [c for c in tried if c is not least and (c.finite or c.explained >= best - NEARLY)]
    others = sorted(near, key=lambda c: -c.explained)
    return replace(least, rivals=tuple(others[:RIVALS]))


def _tried(
    simulation: ForwardModel, base: ModelFit, term: EffectTerm, guess: tuple[float, ...], weight: np.ndarray,
    nuisance: np.ndarray, left: np.ndarray, size: float,
) -> Candidate | None:  # fmt: skip
    """The effect with its places, frequencies… at ``guess``, linear from none to ``size`` steps of its strengths; None
    where its rollouts diverge."""
    model = base.model.with_effect(term.name)
    strengths, others = term.strengths, term.others
    fixed = {p.name: value for p, value in zip(others, guess, strict=True)}
    absent = {**base.values, **{p.name: 0.0 for p in strengths}, **fixed}
    columns = []
    try:
        for p in strengths:
            far = min(size * p.step, p.upper)
            columns.append((simulation.residual(model, {**absent, p.name: far}) - base.residual) / far)
    except NonFiniteError:
        return None
    s = np.stack(columns, axis=1)
    s_left = _without(nuisance, s * weight[:, None])
    theta, pattern = _within_bounds(s_left, left, strengths)
    total = float(left @ left)
    explained = 1 - float((left + pattern) @ (left + pattern)) / max(total, 1e-300)
    length = float(np.linalg.norm(pattern))
    per_sample = total / max(base.samples - len(base.parameters) - len(strengths), 1)
    share = len(left) / max(base.samples, 1)
    spread = np.linalg.pinv(s_left.T @ s_left) * per_sample * share * base.samples / len(left)
    return Candidate(
        term.name,
        max(explained, 0.0),
        {**{p.name: float(t) for p, t in zip(strengths, theta, strict=True)}, **fixed},
        {p.name: float(np.sqrt(max(v, 0.0))) for p, v in zip(strengths, np.diag(spread), strict=True)},
        s,
        pattern / length if length > 0 else pattern,
    )


def _finite(
    simulation: ForwardModel,
    base: ModelFit,
    term: EffectTerm,
    guess: tuple[float, ...],
    linear: Candidate | None,
    robust_scale: float,
) -> Candidate | None:
    """The best of some strengths, in the direction that the linear model has for it where there are several; None
    where there is no direction, and where all rollouts diverge."""
    steps = np.array([p.step for p in term.strengths])
    if len(steps) == 1:
        ways = [np.ones(1), -np.ones(1)] if term.strengths[0].lower < 0 else [np.ones(1)]
    else:
        way = (
            np.zeros(len(steps)) if linear is None else np.array([linear.theta[p.name] for p in term.strengths]) / steps
        )
        ways = [way / np.abs(way).max()] if way.any() else []
    model = base.model.with_effect(term.name)
    fixed = {p.name: value for p, value in zip(term.others, guess, strict=True)}
    best: tuple[float, dict[str, float], np.ndarray] | None = None
    for times, way in ((times, way) for times in FINITE for way in ways):
        strengths = {
            p.name: float(np.clip(times * p.step * w, p.lower, p.upper))
            for p, w in zip(term.strengths, way, strict=True)
        }
        try:
            residual = simulation.residual(model, {**base.values, **strengths, **fixed})
        except NonFiniteError:
            continue
        cost = robust_cost(residual, robust_scale)
        if best is None or cost < best[0]:
            best = cost, {**strengths, **fixed}, residual
    if best is None:
        return None
    cost, theta, residual = best
    change = (residual - base.residual) * robust_weight(base.residual, robust_scale)
    return Candidate(
        term.name, max(1 - cost / max(base.cost, 1e-300), 0.0), theta,
        {p.name: np.inf for p in term.strengths}, np.zeros((len(residual), 0)),
        change / max(float(np.linalg.norm(change)), 1e-300), finite=True,
    )  # fmt: skip


def _within_bounds(s: np.ndarray, left: np.ndarray, strengths) -> tuple[np.ndarray, np.ndarray]:
    """Strengths (S,) that make left + s theta least, none of an impossible sign; and s theta."""
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


def alike(a: Candidate, b: Candidate) -> float:
    """|correlation| of what two effects explain."""
    return abs(float(a.pattern @ b.pattern))
