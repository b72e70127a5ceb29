"""Fit a model's parameters jointly: chord steps from known derivatives, then a full fit for standard errors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from masiv.errors import NonFiniteError
from masiv.inference.correlation import effective_samples
from masiv.inference.least_squares import FIRST_STEP, covariance, fit_parameters, robust_weight
from masiv.models.base import ForwardModel, Observation
from masiv.models.free_body import Model
from masiv.models.parameters import Parameter

LEAST_GAIN = 1e-3
MULTIPLES = (0.25, 1.0, 4.0)
"""Of a strength that the linear model promised, which are tried where it misled."""
LOG_LEAP = 0.7
"""By how much the logarithm of a parameter may change at once."""


@dataclass(frozen=True)
class ModelFit:
    """A model with its parameters. residual (M,) [m] of the fitted instants, weighted; jacobian (M, P) of it.

    cost [m^2]: robust mean square; samples: independent residuals. fit_mm and held_out_mm: root mean square distance,
    not weighted; held_out_mm is None where nothing is held out. fields: of each experiment, simulated less observed
    (K, N, A) [m] at all instants. stderr: of each of the values.
    """

    model: Model
    values: dict[str, float]
    parameters: tuple[Parameter, ...]
    residual: np.ndarray
    jacobian: np.ndarray
    cost: float
    samples: int
    fit_mm: float
    held_out_mm: float | None
    fields: list[np.ndarray]
    stderr: dict[str, float]

    @property
    def squares(self) -> list[np.ndarray]:
        """Of each experiment, the mean square distance (K,) [m^2] at all instants."""
        return [(field**2).sum(2).mean(1) for field in self.fields]

    def bic(self, samples: int) -> float:
        """Bayesian information criterion of ``samples`` independent residuals. Compare models at one number of samples:
        that of the best, since what a model lacks is smooth and makes residuals look fewer than they are."""
        return samples * math.log(max(self.cost, 1e-300)) + len(self.parameters) * math.log(samples)


def ordered(fits: Sequence[ModelFit]) -> list[ModelFit]:
    """Best first by the information criterion, at the number of samples of the fit with the least cost."""
    if not fits:
        return []
    samples = min(fits, key=lambda f: f.cost).samples
    return sorted(fits, key=lambda f: f.bic(samples))


def robust_scale_of(residual: np.ndarray) -> float:
    """Size [m] from which a residual counts as wild."""
    return max(2 * 1.4826 * float(np.median(np.abs(residual))), 1e-9)


def robust_cost(residual: np.ndarray, robust_scale: float) -> float:
    """Mean of 2 s^2 (sqrt(1 + r^2 / s^2) - 1) [m^2]."""
    return float((2 * robust_scale**2 * (np.sqrt(1 + (residual / robust_scale) ** 2) - 1)).mean())


def rms_mm(fields: Sequence[np.ndarray]) -> float:
    """Root mean square distance of residual fields (K, N, 3) [m], in mm."""
    squares = np.concatenate([(f**2).sum(2).ravel() for f in fields])
    return 1e3 * float(np.sqrt(squares.mean()))


def split(fields: Sequence[np.ndarray], observations: Sequence[Observation]) -> tuple[list, list]:
    """Fitted and held-out instants of fields over all frames."""
    fit = [f[: e.fit_count] for f, e in zip(fields, observations, strict=True)]
    return fit, [f[e.fit_count :] for f, e in zip(fields, observations, strict=True) if e.holds_out]


def clipped_step(params: Sequence[Parameter], values: Mapping[str, float], step: np.ndarray) -> dict[str, float]:
    """``values`` after a step in the fitted scales, no longer than a linear model deserves, within the bounds."""
    out = dict(values)
    for p, delta in zip(params, step, strict=True):
        limit = FIRST_STEP * p.step
        out[p.name] = p.value(p.fitted(values[p.name]) + float(np.clip(delta, -limit, limit)))
    return out


def column(
    simulation: ForwardModel, model: Model, values: Mapping[str, float], residual: np.ndarray, p: Parameter
) -> np.ndarray:
    """Derivative (M,) of the residual with respect to ``p``, by a finite difference into the bounds."""
    here = p.fitted(values[p.name])
    sides = [1.0, -1.0] if here + p.step <= p.fitted(p.upper) else [-1.0, 1.0]
    for side in sides:
        nudged = {**values, p.name: p.value(here + side * p.step)}
        actual = p.fitted(nudged[p.name]) - here
        if actual == 0:
            continue
        try:
            return (simulation.residual(model, nudged) - residual) / actual
        except NonFiniteError:
            continue
    return np.zeros_like(residual)


def broyden_fit(
    simulation: ForwardModel,
    model: Model,
    params: Sequence[Parameter],
    values: Mapping[str, float],
    residual: np.ndarray,
    jacobian: np.ndarray,
    *,
    steps: int,
    robust_scale: float,
) -> tuple[dict[str, float], np.ndarray, np.ndarray]:
    """Damped Gauss-Newton with Broyden's update of a known Jacobian: one rollout a step.

    Returns values, residual and the updated Jacobian.
    """
    values = dict(values)
    scale = np.array([p.step for p in params])
    damping = 1e-3
    cost = robust_cost(residual, robust_scale)
    for _ in range(steps):
        weight = robust_weight(residual, robust_scale)
        a = (jacobian * scale) * weight[:, None]
        normal, right = a.T @ a, a.T @ (-residual * weight)
        free = free_parameters(params, values, right)
        step = np.zeros(len(params))
        inner = normal[np.ix_(free, free)]
        step[free] = np.linalg.lstsq(inner + damping * np.diag(np.diag(inner)), right[free], rcond=1e-10)[0]
        trial = clipped_step(params, values, step * scale)
        actual = np.array([p.fitted(trial[p.name]) - p.fitted(values[p.name]) for p in params])
        if not np.any(actual):
            break
        try:
            found = simulation.residual(model, trial)
        except NonFiniteError:
            damping = max(10 * damping, 0.1)
            continue
        jacobian = _updated(jacobian, found - residual, actual, scale)
        gained = cost - robust_cost(found, robust_scale)
        if gained > 0:
            done = gained < LEAST_GAIN * cost
            values, residual, cost = trial, found, cost - gained
            damping = max(damping / 5, 1e-6)
            if done:
                break
        else:
            damping = min(max(20 * damping, 0.05), 1e6)
    return values, residual, jacobian


def gauss_newton_jump(
    simulation: ForwardModel,
    model: Model,
    params: Sequence[Parameter],
    values: Mapping[str, float],
    residual: np.ndarray,
    jacobian: np.ndarray,
    *,
    robust_scale: float,
) -> tuple[dict[str, float], np.ndarray, np.ndarray]:
    """Where the linear model has its minimum, if that is better than ``values``: forces are nearly linear, and steps of
    a careful length might never get there. Returns values, residual and the Jacobian with Broyden's update."""
    weight = robust_weight(residual, robust_scale)
    scale = np.array([p.step for p in params])
    a = (jacobian * scale) * weight[:, None]
    normal = a.T @ a
    step = np.linalg.lstsq(normal + 1e-3 * np.diag(np.diag(normal)), a.T @ (-residual * weight), rcond=1e-10)[0] * scale
    trial = dict(values)
    for p, delta in zip(params, step, strict=True):
        limit = LOG_LEAP if p.log else math.inf
        trial[p.name] = p.value(p.fitted(values[p.name]) + float(np.clip(delta, -limit, limit)))
    try:
        found = simulation.residual(model, trial)
    except NonFiniteError:
        return dict(values), residual, jacobian
    if robust_cost(found, robust_scale) >= robust_cost(residual, robust_scale):
        return dict(values), residual, jacobian
    actual = np.array([p.fitted(trial[p.name]) - p.fitted(values[p.name]) for p in params])
    return trial, found, _updated(jacobian, found - residual, actual, scale)


def _updated(jacobian: np.ndarray, change: np.ndarray, step: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Broyden's update: the ``jacobian`` (M, P) that gives ``change`` (M,) for ``step`` (P,), which is not zero."""
    length = step / scale
    return jacobian + np.outer(change - jacobian @ step, length / scale) / (length @ length)


def strengths_alone(
    simulation: ForwardModel,
    model: Model,
    values: Mapping[str, float],
    strengths: Sequence[Parameter],
    robust_scale: float,
) -> dict[str, float]:
    """``values`` with the ``strengths`` that are best with all else as it is, of a linear model about none."""
    absent = {**values, **{p.name: 0.0 for p in strengths}}
    residual = simulation.residual(model, absent)
    columns = np.stack([column(simulation, model, absent, residual, p) for p in strengths], axis=1)
    return gauss_newton_jump(simulation, model, strengths, absent, residual, columns, robust_scale=robust_scale)[0]


def best_strength(
    simulation: ForwardModel, model: Model, values: Mapping[str, float], strengths: Sequence[Parameter],
    robust_scale: float, multiples: Sequence[float] = MULTIPLES,
) -> tuple[dict[str, float], float]:  # fmt: skip
    """``values`` with the ``strengths`` at the best of some ``multiples`` of theirs, all else as it is; and its cost
    [m^2]: what contact does has kinks, and derivatives about zero may not say where it begins to matter."""
    best, least = dict(values), math.inf
    for times in multiples:
        scaled = {p.name: float(np.clip(times * values[p.name], p.lower, p.upper)) for p in strengths}
        try:
            cost = robust_cost(simulation.residual(model, {**values, **scaled}), robust_scale)
        except NonFiniteError:
            continue
        if cost < least:
            best, least = {**values, **scaled}, cost
    return best, least


def refit_whitened(simulation: ForwardModel, base: ModelFit, steps: int, robust_scale: float) -> ModelFit:
    """``base`` fitted again to the residual as ``simulation`` weighs it now; fresh derivatives before and after."""
    params = with_start_values(simulation.parameters(base.model), base.values)
    values = {**base.values, **{p.name: p.start for p in params}}
    residual = simulation.residual(base.model, values)
    for take in (steps, 0) if params else (0,):
        jacobian = np.zeros((len(residual), len(params)))
        for k, p in enumerate(params):
            jacobian[:, k] = column(simulation, base.model, values, residual, p)
        if take:
            values, residual, _ = broyden_fit(
                simulation, base.model, params, values, residual, jacobian, steps=take, robust_scale=robust_scale
            )
    return evaluate_fit(simulation, base.model, params, values, jacobian, robust_scale=robust_scale)


def free_parameters(params: Sequence[Parameter], values: Mapping[str, float], downhill: np.ndarray) -> np.ndarray:
    """Indices of parameters that are not held at a bound which the descent would cross."""
    out = []
    for k, p in enumerate(params):
        here = values[p.name]
        if not ((here <= p.lower and downhill[k] < 0) or (here >= p.upper and downhill[k] > 0)):
            out.append(k)
    return np.array(out, dtype=int)


def evaluate_fit(
    simulation: ForwardModel,
    model: Model,
    params: Sequence[Parameter],
    values: Mapping[str, float],
    jacobian: np.ndarray,
    *,
    robust_scale: float,
) -> ModelFit:
    """``ModelFit`` of given values: one rollout over all frames; standard errors from ``jacobian``."""
    fields = simulation.fields(model, values, held_out=True)
    fit, rest = split(fields, simulation.observations)
    weighted = [e.whiten(f) for f, e in zip(fit, simulation.observations, strict=True)]
    residual = np.concatenate([f.ravel() for f in weighted])
    samples = sum(
        effective_samples(f, e.points) for f, e in zip(weighted, simulation.observations, strict=True) if e.fit_count
    )
    weight = robust_weight(residual, robust_scale)
    spread = np.diag(covariance(jacobian * weight[:, None], residual * weight))
    inflation = max(len(residual) - len(params), 1) / max(samples - len(params), 1)
    stderr = {
        p.name: float(math.sqrt(v * inflation) * (abs(values[p.name]) if p.log else 1.0))
        if math.isfinite(v)
        else math.inf
        for p, v in zip(params, spread, strict=True)
    }
    return ModelFit(
        model, dict(values), tuple(params), residual, jacobian, robust_cost(residual, robust_scale), samples,
        rms_mm(fit), rms_mm(rest) if rest else None, fields, stderr,
    )  # fmt: skip


def gauss_newton_fit(
    simulation: ForwardModel,
    model: Model,
    values: Mapping[str, float],
    *,
    budget: int,
    robust_scale: float | None = None,
    held: frozenset[str] = frozenset(),
) -> ModelFit:
    """Gauss-Newton with fresh derivatives from ``values`` (defaults where missing), and standard errors. held: names of
    parameters that stay as they are."""
    params = with_start_values([p for p in simulation.parameters(model) if p.name not in held], values)
    still = {name: values[name] for name in held}
    if not params:
        found = simulation.residual(model, still)
        none = np.zeros((len(found), 0))
        return evaluate_fit(simulation, model, params, still, none, robust_scale=robust_scale or robust_scale_of(found))
    estimate = fit_parameters(
        lambda v: simulation.residual(model, {**still, **v}), params,
        max_evaluations=budget, robust=True, tolerance=LEAST_GAIN,
    )  # fmt: skip
    return evaluate_fit(
        simulation, model, params, {**still, **estimate.values}, estimate.jacobian,
        robust_scale=robust_scale or robust_scale_of(estimate.residual),
    )  # fmt: skip


def held_in(simulation: ForwardModel, fitted: ModelFit) -> frozenset[str]:
    """Names of parameters of a model that have values in ``fitted``, which left them as they were."""
    own = {p.name for p in fitted.parameters}
    return frozenset(p.name for p in simulation.parameters(fitted.model) if p.name in fitted.values) - own


def warm_started_fit(simulation: ForwardModel, fitted: ModelFit, robust_scale: float) -> ModelFit:
    """``fitted`` as a start in another simulation of the same experiments."""
    budget = 8 * (len(simulation.parameters(fitted.model)) + 1)
    held = held_in(simulation, fitted)
    return gauss_newton_fit(
        simulation, fitted.model, fitted.values, budget=budget, robust_scale=robust_scale, held=held
    )


def with_start_values(params: Sequence[Parameter], values: Mapping[str, float]) -> tuple[Parameter, ...]:
    """Parameters that start at ``values``, where they are given, within their bounds."""
    from dataclasses import replace

    return tuple(replace(p, start=float(np.clip(values.get(p.name, p.start), p.lower, p.upper))) for p in params)
