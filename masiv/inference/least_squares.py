"""Least squares over a few parameters of a simulation, by finite differences: no adjoint is needed.

Gauss-Newton in a trust region (SciPy's ``least_squares``, Branch, Coleman & Li 1999), one residual evaluation a
parameter for the Jacobian. Standard errors are those of linear regression at the solution.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from scipy.optimize import least_squares

from masiv.errors import MasivError, NonFiniteError
from masiv.models.parameters import Parameter

FIRST_STEP = 10.0
"""The trust region begins at this many finite-difference steps: as far as a linear model deserves to be believed."""
STEP_TOLERANCE = 1e-3
"""The fit ends when its steps are this share of a finite-difference step."""


@dataclass(frozen=True)
class Estimate:
    """What a fit found.

    values: by name, in each parameter's own unit. covariance (P, P): fitted scale, of independent residuals whose
    variance is that of ``residual``. jacobian (M, P): per fitted scale, at ``values``. residual (M,).
    evaluations: calls of the residual, those of the Jacobian included. parameters: as given.
    """

    values: dict[str, float]
    covariance: np.ndarray
    jacobian: np.ndarray
    residual: np.ndarray
    evaluations: int
    parameters: tuple[Parameter, ...]

    def stderr(self, effective_samples: int) -> dict[str, float]:
        """Standard errors in each parameter's own unit, where the M residuals are worth ``effective_samples``
        independent ones: exact where each is repeated M / effective_samples times. Infinite where those are no more
        than the parameters, and where the data does not depend on a parameter."""
        size, count = self.jacobian.shape
        if effective_samples <= count:
            return {p.name: math.inf for p in self.parameters}
        inflation = max(size - count, 1) / (effective_samples - count)
        errors = np.sqrt(np.diag(self.covariance) * inflation)
        return {
            p.name: float(error * (abs(self.values[p.name]) if p.log else 1.0))
            for p, error in zip(self.parameters, errors, strict=True)
        }


class _Spent(Exception):
    """No evaluations are left."""


class _Evaluator:
    """Residuals and Jacobians in units of ``FIRST_STEP`` finite-difference steps from the start."""

    def __init__(self, residual, parameters: tuple[Parameter, ...], max_evaluations: int) -> None:
        self.residual = residual
        self.parameters = parameters
        self.start = np.array([p.fitted(p.start) for p in parameters])
        self.scale = FIRST_STEP * np.array([p.step for p in parameters])
        self.left = max_evaluations
        self.count = 0
        self.softness = math.inf  # residuals well above it are wild: none
        self.best: tuple[float, np.ndarray, np.ndarray] | None = None
        self.jacobian_at: tuple[np.ndarray, np.ndarray] | None = None

    def values(self, u: np.ndarray) -> dict[str, float]:
        fitted = self.start + self.scale * u
        return {p.name: p.value(x) for p, x in zip(self.parameters, fitted, strict=True)}

    def call(self, u: np.ndarray) -> np.ndarray:
        self.count += 1
        found = np.asarray(self.residual(self.values(u)), dtype=np.float64).ravel()
        if not np.isfinite(found).all():
            raise NonFiniteError(0, 0, "a residual is not finite")
        return found

    def cost(self, found: np.ndarray) -> float:
        return robust_cost(found, self.softness)

    def trial(self, u: np.ndarray) -> np.ndarray:
        """The residual, infinite where the simulation diverges: the trust region then shrinks."""
        if self.best is not None and np.array_equal(u, self.best[1]):
            return self.best[2]
        if self.best is not None and self.count + 1 + len(self.parameters) > self.left:
            raise _Spent
        try:
            found = self.call(u)
        except NonFiniteError:
            if self.best is None:
                raise
            return np.full(len(self.best[2]), np.inf)
        cost = self.cost(found)
        if self.best is None or cost < self.best[0]:
            self.best = cost, u.copy(), found
        return found

    def jacobian(self, u: np.ndarray) -> np.ndarray:
        """Forward differences, backward where forward leaves the bounds or diverges; (M, P) per unit of u."""
        base = self.trial(u)
        columns = []
        for k, p in enumerate(self.parameters):
            fitted = self.start[k] + self.scale[k] * u[k]
            sides = [1.0, -1.0] if fitted + p.step <= p.fitted(p.upper) else [-1.0, 1.0]
            for side in sides:
                moved = u.copy()
                moved[k] += side / FIRST_STEP
                try:
                    columns.append((self.call(moved) - base) * (FIRST_STEP * side))
                    break
                except NonFiniteError:
                    continue
            else:
                raise MasivError(
                    f"the simulation diverges on both sides of {p.name} = {self.values(u)[p.name]:.4g}: "
                    "take shorter substeps (lower simulator.courant_number)"
                )
        self.jacobian_at = u.copy(), np.stack(columns, axis=1)
        return self.jacobian_at[1]


def fit_parameters(
    residual: Callable[[dict[str, float]], np.ndarray],
    parameters: Sequence[Parameter],
    *,
    max_evaluations: int,
    robust: bool = False,
    tolerance: float = 1e-5,
) -> Estimate:
    """The values with the least sum of squares of ``residual`` (M,), from ``Parameter.start``, within the bounds.

    A NonFiniteError of the residual refuses the step. max_evaluations: calls of the residual in all; at least one
    residual and one Jacobian are taken. robust: least sum of 2 (sqrt(1 + r^2 / s^2) - 1), with s the median size at the
    start, so that a few wild residuals pull less; the covariance is then that of the reweighted problem. tolerance: the
    fit also ends where a step lowers the cost by less than this share.
    Raises NonFiniteError where the start itself diverges, MasivError where the simulation diverges all around a point.
    """
    evaluator = _Evaluator(residual, tuple(parameters), max_evaluations)
    origin = np.zeros(len(evaluator.parameters))
    first = evaluator.trial(origin)
    softness = max(1.4826 * float(np.median(np.abs(first))), 1e-12)
    if robust:
        evaluator.softness = softness
        evaluator.best = evaluator.cost(first), origin, first
    lower = [(p.fitted(p.lower) - x) / s for p, x, s in zip(parameters, evaluator.start, evaluator.scale, strict=True)]
    upper = [(p.fitted(p.upper) - x) / s for p, x, s in zip(parameters, evaluator.start, evaluator.scale, strict=True)]
    try:
        result = least_squares(
            evaluator.trial, origin, cast(Any, evaluator.jacobian), (lower, upper), "trf",
            xtol=STEP_TOLERANCE / FIRST_STEP, ftol=tolerance, gtol=cast(Any, None),
            loss="soft_l1" if robust else "linear", f_scale=softness, max_nfev=max(max_evaluations, 1),
        )  # fmt: skip
        u, found = result.x, result.fun
    except _Spent:
        assert evaluator.best is not None
        _, u, found = evaluator.best
    if evaluator.jacobian_at is None or not np.array_equal(evaluator.jacobian_at[0], u):
        evaluator.jacobian(u)
    assert evaluator.jacobian_at is not None
    jacobian = evaluator.jacobian_at[1] / evaluator.scale
    weight = robust_weight(found, softness) if robust else np.ones(len(found))
    return Estimate(
        evaluator.values(u),
        covariance(jacobian * weight[:, None], found * weight),
        jacobian,
        found,
        evaluator.count,
        evaluator.parameters,
    )


def robust_cost(residual: np.ndarray, softness: float) -> float:
    """What is made small: the sum of sqrt(1 + r^2 / s^2) - 1, or of squares where the ``softness`` s is infinite."""
    if math.isinf(softness):
        return float(residual @ residual)
    return float((np.sqrt(1 + (residual / softness) ** 2) - 1).sum())


def robust_weight(residual: np.ndarray, softness: float) -> np.ndarray:
    """Factors that make least squares of the weighted residual (M,) a step of the robust problem."""
    return (1 + (residual / softness) ** 2) ** -0.25


def covariance(jacobian: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """s^2 (J^T J)^-1, s^2 = |r|^2 / (M - P). A column of zeros has infinite variance; where columns are parallel the
    variances along the free direction are huge, not, as with a pseudo-inverse, nought."""
    size, count = jacobian.shape
    lengths = np.linalg.norm(jacobian, axis=0)
    seen = lengths > 0
    found = np.diag(np.where(seen, 0.0, np.inf))
    if seen.any():
        _, s, vh = np.linalg.svd(jacobian[:, seen] / lengths[seen], full_matrices=False)
        s = np.maximum(s, s[0] * max(size, count) * np.finfo(float).eps)
        inverse = (vh.T / s**2) @ vh / np.outer(lengths[seen], lengths[seen])
        found[np.ix_(seen, seen)] = inverse * float(residual @ residual) / max(size - count, 1)
    return found
