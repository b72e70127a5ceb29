"""Least squares over a few parameters of a simulation. Derivatives are finite differences: no adjoint is needed.

Two algorithms for two prices. ``gauss_newton`` takes fresh derivatives at each step, one evaluation of the residual a
parameter (trust region of SciPy's ``least_squares``, Branch, Coleman & Li 1999). ``broyden`` keeps a Jacobian that is
known and updates it (Broyden 1965; damping as of Levenberg and Marquardt): one evaluation a step. They share bounds,
scales of parameters and the robust loss (``masiv.inference.robust``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
from scipy.optimize import least_squares

from masiv.errors import MasivError, NonFiniteError
from masiv.inference.robust import NORMAL_MAD, soft_l1_mean_square, soft_l1_sum, soft_l1_weight
from masiv.models.parameters import Parameter

Residual = Callable[[dict[str, float]], np.ndarray]
"""Values by name -> residual (M,). Raises NonFiniteError if the simulation diverges."""


@runtime_checkable
class HeldResidual(Protocol):
    """A residual that jumps at some values, such as those at which a simulation takes more substeps."""

    def __call__(self, values: dict[str, float]) -> np.ndarray: ...

    def held_at(self, values: Mapping[str, float]) -> Residual:
        """The same residual at ``values``, and smooth about them: for finite differences."""
        ...


@runtime_checkable
class BatchResidual(Protocol):
    """A residual that several processes can work out at several values at once."""

    def batch(self, points: Sequence[dict[str, float]]) -> list[np.ndarray | None]:
        """The residual (M,) at each of ``points``; None where the simulation diverges."""
        ...


FIRST_STEP = 10.0
"""Radius of the first trust region, and longest step of ``broyden``, in finite-difference steps."""
STEP_TOLERANCE = 1e-3
"""A fit ends if its steps are shorter than this part of a finite-difference step."""
MIN_DECREASE = 1e-3
"""A fit ends if a step lowers the cost by less than this part of it."""
FIRST_DAMPING, MIN_DAMPING, MAX_DAMPING = 1e-3, 1e-6, 1e6
"""Levenberg-Marquardt damping over the diagonal of the normal equations."""
MAX_LOG_JUMP = 0.7
"""Longest step of ``gauss_newton_jump`` in the logarithm of a parameter."""


def with_start_values(parameters: Sequence[Parameter], values: Mapping[str, float]) -> tuple[Parameter, ...]:
    """Parameters that start at ``values`` (at their own start if not given), within their bounds."""
    return tuple(replace(p, start=float(np.clip(values.get(p.name, p.start), p.lower, p.upper))) for p in parameters)


def clipped_step(parameters: Sequence[Parameter], values: Mapping[str, float], step: np.ndarray) -> dict[str, float]:
    """``values`` after a ``step`` (P,) in the fitted scales, each part at most ``FIRST_STEP`` finite-difference steps
    long, within the bounds."""
    out = dict(values)
    for p, delta in zip(parameters, step, strict=True):
        limit = FIRST_STEP * p.step
        out[p.name] = p.value(p.fitted(values[p.name]) + float(np.clip(delta, -limit, limit)))
    return out


def free_parameters(parameters: Sequence[Parameter], values: Mapping[str, float], descent: np.ndarray) -> np.ndarray:
    """Indices of parameters that are not at a bound which the ``descent`` direction (P,) would cross."""
    out = []
    for k, p in enumerate(parameters):
        here = values[p.name]
        if not ((here <= p.lower and descent[k] < 0) or (here >= p.upper and descent[k] > 0)):
            out.append(k)
    return np.array(out, dtype=int)


def derivatives(
    residual: Residual, values: Mapping[str, float], here: np.ndarray, parameters: Sequence[Parameter]
) -> list[np.ndarray]:
    """Derivatives (M,) of the residual, which is ``here`` (M,) at ``values``, with respect to ``parameters`` in their
    fitted scales: finite differences within the bounds. Raises NonFiniteError if the simulation diverges on both sides
    of a value."""
    near = _held_at(residual, values)
    out: dict[str, np.ndarray] = {}
    for side in (0, 1):
        todo = [p for p in parameters if p.name not in out]
        points = [_shifted(p, values, side) for p in todo]
        for p, point, found in zip(todo, points, evaluated(near, points), strict=True):
            actual = p.fitted(point[p.name]) - p.fitted(values[p.name])
            if found is not None and actual != 0:
                out[p.name] = (found - here) / actual
    for p in parameters:
        if p.name not in out:
            detail = f"the simulation diverges on both sides of {p.name} = {values[p.name]:.4g}"
            raise NonFiniteError(0, 0, detail)
    return [out[p.name] for p in parameters]


def _shifted(p: Parameter, values: Mapping[str, float], side: int) -> dict[str, float]:
    """``values`` with ``p`` a finite-difference step away: upwards if the bounds allow it (side 0), the other way (side
    1)."""
    centre = p.fitted(values[p.name])
    up = centre + p.step <= p.fitted(p.upper)
    return {**values, p.name: p.value(centre + (p.step if up == (side == 0) else -p.step))}


def derivative(residual: Residual, values: Mapping[str, float], here: np.ndarray, p: Parameter) -> np.ndarray:
    """See ``derivatives``."""
    return derivatives(residual, values, here, [p])[0]


def evaluated(residual: Residual, points: Sequence[dict[str, float]]) -> list[np.ndarray | None]:
    """The residual (M,) at each of ``points``; None where the simulation diverges."""
    if isinstance(residual, BatchResidual):
        return residual.batch(points)
    out: list[np.ndarray | None] = []
    for point in points:
        try:
            out.append(residual(point))
        except NonFiniteError:
            out.append(None)
    return out


def _held_at(residual: Residual, values: Mapping[str, float]) -> Residual:
    return residual.held_at(values) if isinstance(residual, HeldResidual) else residual


# -- Gauss-Newton with fresh derivatives -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Estimate:
    """Result of ``gauss_newton``.

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
        """Standard errors in each parameter's own unit, if the M residuals are worth ``effective_samples`` independent
        ones: exact if each is repeated M / effective_samples times. Infinite if those are no more than the parameters,
        and if the data does not depend on a parameter."""
        size, count = self.jacobian.shape
        if effective_samples <= count:
            return {p.name: math.inf for p in self.parameters}
        inflation = max(size - count, 1) / (effective_samples - count)
        return standard_errors(self.parameters, self.values, np.diag(self.covariance) * inflation)


class _Spent(Exception):
    """No evaluations are left."""


class _Evaluator:
    """Residuals and Jacobians in units of ``FIRST_STEP`` finite-difference steps from the start."""

    def __init__(self, residual: Residual, parameters: tuple[Parameter, ...], max_evaluations: int) -> None:
        self.residual = residual
        self.parameters = parameters
        self.start = np.array([p.fitted(p.start) for p in parameters])
        self.scale = FIRST_STEP * np.array([p.step for p in parameters])
        self.max_evaluations = max_evaluations
        self.count = 0
        self.robust_scale = math.inf
        self.best: tuple[float, np.ndarray, np.ndarray] | None = None
        self.jacobian_at: tuple[np.ndarray, np.ndarray] | None = None

    def values(self, u: np.ndarray) -> dict[str, float]:
        fitted = self.start + self.scale * u
        return {p.name: p.value(x) for p, x in zip(self.parameters, fitted, strict=True)}

    def call(self, residual: Residual, u: np.ndarray) -> np.ndarray:
        self.count += 1
        out = np.asarray(residual(self.values(u)), dtype=np.float64).ravel()
        if not np.isfinite(out).all():
            raise NonFiniteError(0, 0, "a residual is not finite")
        return out

    def trial(self, u: np.ndarray) -> np.ndarray:
        """The residual, infinite if the simulation diverges: the trust region then shrinks."""
        if self.best is not None and np.array_equal(u, self.best[1]):
            return self.best[2]
        if self.best is not None and self.count + 1 + len(self.parameters) > self.max_evaluations:
            raise _Spent
        try:
            out = self.call(self.residual, u)
        except NonFiniteError:
            if self.best is None:
                raise
            return np.full(len(self.best[2]), np.inf)
        cost = soft_l1_sum(out, self.robust_scale)
        if self.best is None or cost < self.best[0]:
            self.best = cost, u.copy(), out
        return out

    def jacobian(self, u: np.ndarray) -> np.ndarray:
        """Forward differences, backward if forward leaves the bounds or diverges; (M, P) per unit of u."""
        base = self.trial(u)
        near = _held_at(self.residual, self.values(u))
        columns: dict[int, np.ndarray] = {}
        for again in (False, True):
            todo = [k for k in range(len(self.parameters)) if k not in columns]
            sides = [self.side(u, k) * (-1.0 if again else 1.0) for k in todo]
            points = [self.shifted(u, k, side) for k, side in zip(todo, sides, strict=True)]
            self.count += len(points)
            for k, side, found in zip(todo, sides, evaluated(near, points), strict=True):
                if found is not None and np.isfinite(found).all():
                    columns[k] = (np.asarray(found, dtype=np.float64).ravel() - base) * (FIRST_STEP * side)
        for k, p in enumerate(self.parameters):
            if k not in columns:
                raise MasivError(
                    f"the simulation diverges on both sides of {p.name} = {self.values(u)[p.name]:.4g}: "
                    "take shorter substeps (lower simulator.courant_number)"
                )
        self.jacobian_at = u.copy(), np.stack([columns[k] for k in range(len(columns))], axis=1)
        return self.jacobian_at[1]

    def side(self, u: np.ndarray, k: int) -> float:
        """1 if a finite-difference step up from ``u`` stays within the bounds of parameter k, else -1."""
        p = self.parameters[k]
        return 1.0 if self.start[k] + self.scale[k] * u[k] + p.step <= p.fitted(p.upper) else -1.0

    def shifted(self, u: np.ndarray, k: int, side: float) -> dict[str, float]:
        """Values a finite-difference step of parameter k away from ``u``."""
        out = u.copy()
        out[k] += side / FIRST_STEP
        return self.values(out)


def gauss_newton(
    residual: Residual,
    parameters: Sequence[Parameter],
    *,
    max_evaluations: int,
    robust: bool = False,
    tolerance: float = 1e-5,
) -> Estimate:
    """The values with the least sum of squares of ``residual`` (M,), from ``Parameter.start``, within the bounds.

    A NonFiniteError of the residual refuses the step. max_evaluations: calls of the residual in all; at least one
    residual and one Jacobian are taken. robust: least ``soft_l1_sum``, its scale the standard deviation that the median
    at the start gives; the covariance is then that of the reweighted problem. tolerance: the fit also ends if a step
    lowers the cost by less than this part of it.
    Raises NonFiniteError if the start itself diverges, MasivError if the simulation diverges all around a point.
    """
    evaluator = _Evaluator(residual, tuple(parameters), max_evaluations)
    origin = np.zeros(len(evaluator.parameters))
    first = evaluator.trial(origin)
    scale = max(NORMAL_MAD * float(np.median(np.abs(first))), 1e-12)
    if robust:
        evaluator.robust_scale = scale
        evaluator.best = soft_l1_sum(first, scale), origin, first
    lower = [(p.fitted(p.lower) - x) / s for p, x, s in zip(parameters, evaluator.start, evaluator.scale, strict=True)]
    upper = [(p.fitted(p.upper) - x) / s for p, x, s in zip(parameters, evaluator.start, evaluator.scale, strict=True)]
    try:
        result = least_squares(
            evaluator.trial, origin, cast(Any, evaluator.jacobian), (lower, upper), "trf",
            xtol=STEP_TOLERANCE / FIRST_STEP, ftol=tolerance, gtol=cast(Any, None),
            loss="soft_l1" if robust else "linear", f_scale=scale, max_nfev=max(max_evaluations, 1),
        )  # fmt: skip
        u, last = result.x, result.fun
    except _Spent:
        assert evaluator.best is not None
        _, u, last = evaluator.best
    if evaluator.jacobian_at is None or not np.array_equal(evaluator.jacobian_at[0], u):
        evaluator.jacobian(u)
    assert evaluator.jacobian_at is not None
    jacobian = evaluator.jacobian_at[1] / evaluator.scale
    weight = soft_l1_weight(last, scale) if robust else np.ones(len(last))
    return Estimate(
        evaluator.values(u),
        covariance(jacobian * weight[:, None], last * weight),
        jacobian,
        last,
        evaluator.count,
        evaluator.parameters,
    )


# -- steps with a Jacobian that is known -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Linearization:
    """A residual (M,) at ``values`` and its jacobian (M, P) by the fitted scales of P parameters."""

    values: dict[str, float]
    residual: np.ndarray
    jacobian: np.ndarray


def linearize(residual: Residual, parameters: Sequence[Parameter], values: Mapping[str, float]) -> Linearization:
    """Residual and derivatives at ``values``. Raises NonFiniteError."""
    here = residual(dict(values))
    columns = derivatives(residual, values, here, parameters)
    return Linearization(dict(values), here, np.stack(columns, axis=1) if columns else np.zeros((len(here), 0)))


def broyden(
    residual: Residual, parameters: Sequence[Parameter], start: Linearization, *, steps: int, robust_scale: float
) -> Linearization:
    """Damped Gauss-Newton ``steps`` from ``start``, whose Jacobian is updated by what each step changed: one evaluation
    a step, which a NonFiniteError refuses."""
    here = start
    scale = np.array([p.step for p in parameters])
    damping = FIRST_DAMPING
    cost = soft_l1_mean_square(here.residual, robust_scale)
    for _ in range(steps):
        normal, right = _normal_equations(here, scale, robust_scale)
        free = free_parameters(parameters, here.values, right)
        step = np.zeros(len(parameters))
        step[free] = _damped_solution(normal[np.ix_(free, free)], right[free], damping)
        trial = clipped_step(parameters, here.values, step * scale)
        actual = _difference(parameters, here.values, trial)
        if not np.any(actual):
            break
        try:
            reached = residual(trial)
        except NonFiniteError:
            damping = max(10 * damping, 0.1)
            continue
        jacobian = _updated(here.jacobian, reached - here.residual, actual, scale)
        decrease = cost - soft_l1_mean_square(reached, robust_scale)
        if decrease > 0:
            done = decrease < MIN_DECREASE * cost
            here, cost = Linearization(trial, reached, jacobian), cost - decrease
            damping = max(damping / 5, MIN_DAMPING)
            if done:
                break
        else:
            here = replace(here, jacobian=jacobian)
            damping = min(max(20 * damping, 0.05), MAX_DAMPING)
    return here


def gauss_newton_jump(
    residual: Residual, parameters: Sequence[Parameter], start: Linearization, *, robust_scale: float
) -> Linearization:
    """The minimum of the linear model of ``start`` if it is better than ``start``, else ``start``: forces are nearly
    linear, and steps of a careful length might never get there. One evaluation."""
    scale = np.array([p.step for p in parameters])
    normal, right = _normal_equations(start, scale, robust_scale)
    step = _damped_solution(normal, right, FIRST_DAMPING) * scale
    trial = dict(start.values)
    for p, delta in zip(parameters, step, strict=True):
        limit = MAX_LOG_JUMP if p.log else math.inf
        trial[p.name] = p.value(p.fitted(start.values[p.name]) + float(np.clip(delta, -limit, limit)))
    try:
        reached = residual(trial)
    except NonFiniteError:
        return start
    if soft_l1_mean_square(reached, robust_scale) >= soft_l1_mean_square(start.residual, robust_scale):
        return start
    actual = _difference(parameters, start.values, trial)
    return Linearization(trial, reached, _updated(start.jacobian, reached - start.residual, actual, scale))


def _normal_equations(at: Linearization, scale: np.ndarray, robust_scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Matrix (P, P) and right side (P,) of one robust Gauss-Newton step, in units of ``scale`` (P,)."""
    weight = soft_l1_weight(at.residual, robust_scale)
    a = (at.jacobian * scale) * weight[:, None]
    return a.T @ a, a.T @ (-at.residual * weight)


def _damped_solution(normal: np.ndarray, right: np.ndarray, damping: float) -> np.ndarray:
    return np.linalg.lstsq(normal + damping * np.diag(np.diag(normal)), right, rcond=1e-10)[0]


def _difference(parameters: Sequence[Parameter], before: Mapping[str, float], after: Mapping[str, float]) -> np.ndarray:
    """Step (P,) in the fitted scales."""
    return np.array([p.fitted(after[p.name]) - p.fitted(before[p.name]) for p in parameters])


def _updated(jacobian: np.ndarray, change: np.ndarray, step: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Broyden's update: the ``jacobian`` (M, P) that gives ``change`` (M,) for ``step`` (P,), which is not zero."""
    length = step / scale
    return jacobian + np.outer(change - jacobian @ step, length / scale) / (length @ length)


# -- standard errors -------------------------------------------------------------------------------------------------


def covariance(jacobian: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """s² (JᵀJ)⁻¹ (P, P) with s² = |r|² / (M - P). A column of zeros has infinite variance; if columns are parallel the
    variances along the free direction are huge, not zero as with a pseudo-inverse."""
    size, count = jacobian.shape
    lengths = np.linalg.norm(jacobian, axis=0)
    seen = lengths > 0
    out = np.diag(np.where(seen, 0.0, np.inf))
    if seen.any():
        _, s, vh = np.linalg.svd(jacobian[:, seen] / lengths[seen], full_matrices=False)
        s = np.maximum(s, s[0] * max(size, count) * np.finfo(float).eps)
        inverse = (vh.T / s**2) @ vh / np.outer(lengths[seen], lengths[seen])
        out[np.ix_(seen, seen)] = inverse * float(residual @ residual) / max(size - count, 1)
    return out


def standard_errors(
    parameters: Sequence[Parameter], values: Mapping[str, float], variances: np.ndarray
) -> dict[str, float]:
    """Of each parameter in its own unit, from ``variances`` (P,) in the fitted scales."""
    return {
        p.name: float(math.sqrt(v) * (abs(values[p.name]) if p.log else 1.0)) if math.isfinite(v) else math.inf
        for p, v in zip(parameters, variances, strict=True)
    }


def basis_of(a: np.ndarray) -> np.ndarray:
    """Orthonormal columns that span those of ``a`` (M, P)."""
    lengths = np.linalg.norm(a, axis=0)
    seen = lengths > 1e-9 * lengths.max(initial=0.0)
    u, s, _ = np.linalg.svd(a[:, seen] / lengths[seen], full_matrices=False)
    return u[:, s > 1e-6 * s[0]] if len(s) else u
