"""A model's parameters fitted to the observations of a forward model, and what is known of the fit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import lsq_linear

from masiv.errors import NonFiniteError
from masiv.inference.least_squares import (
    MIN_DECREASE,
    Linearization,
    Residual,
    broyden,
    covariance,
    gauss_newton,
    gauss_newton_jump,
    linearize,
    standard_errors,
    with_start_values,
)
from masiv.inference.noise_model import NoiseModel
from masiv.inference.robust import robust_scale_of, soft_l1_mean_square, soft_l1_weight
from masiv.models.base import ForwardModel, Model
from masiv.models.parameters import Parameter
from masiv.observations.base import Observation, rms_mm
from masiv.workers import unwrap

PARTS = ("fit", "validation", "test")
"""Of the instants, see ``Observation.parts``."""
STRENGTH_FACTORS = (0.25, 1.0, 4.0)
"""Factors of a strength that the linear model promised, which are tried if it misled."""


@dataclass(frozen=True)
class ModelFit:
    """A model with its parameters. residual (M,) [m] of the fitted instants, whitened; jacobian (M, P) of it.

    cost [m²]: robust mean square; samples: independent residuals. fit_mm, validation_mm and test_mm: root mean square
    distance over these instants (``Observation.parts``), not whitened; None if there are none. fields: of each
    observation, simulated less observed (T, N, A) [m] at all instants. stderr: by name, of the fitted parameters.
    """

    model: Model
    values: dict[str, float]
    parameters: tuple[Parameter, ...]
    residual: np.ndarray
    jacobian: np.ndarray
    cost: float
    samples: int
    fit_mm: float
    validation_mm: float | None
    test_mm: float | None
    fields: list[np.ndarray]
    stderr: dict[str, float]

    @property
    def squares(self) -> list[np.ndarray]:
        """Of each observation, the mean square distance (T,) [m²] at all instants."""
        return [(field**2).sum(2).mean(1) for field in self.fields]

    def bic(self, samples: int) -> float:
        """Bayesian information criterion of ``samples`` independent residuals. Compare models at one number of samples:
        that of the best, since what a model lacks is smooth and makes residuals look fewer than they are."""
        return samples * math.log(max(self.cost, 1e-300)) + len(self.parameters) * math.log(samples)


def common_samples(fits: Sequence[ModelFit]) -> int:
    """The number of samples at which fits are compared: that of the fit with the least cost."""
    return min(fits, key=lambda f: f.cost).samples


def rank_by_bic(fits: Sequence[ModelFit]) -> list[ModelFit]:
    """Best first by the information criterion."""
    if not fits:
        return []
    samples = common_samples(fits)
    return sorted(fits, key=lambda f: f.bic(samples))


def part_mm(fields: Sequence[np.ndarray], observations: Sequence[Observation], part: str) -> float | None:
    """Root mean square distance [mm] of fields over all instants, on a part of them (``Observation.parts``); None if
    there is none."""
    pairs = zip(fields, observations, strict=True)
    own = [f[e.parts[part]] for f, e in pairs if part in e.parts]
    return rms_mm(own) if own else None


@dataclass(frozen=True)
class ModelResidual:
    """The whitened residual (M,) [m] of ``model`` as a function of its values, but for those that are ``fixed``; or, if
    ``all_instants``, its fields at all of them, not whitened."""

    forward_model: ForwardModel
    model: Model
    fixed: Mapping[str, float] = field(default_factory=dict)
    all_instants: bool = False

    def __call__(self, values: Mapping[str, float]) -> np.ndarray:
        values = {**self.fixed, **values}
        if self.all_instants:
            fields = self.forward_model.fields(self.model, values, held_out=True)
            return np.concatenate([f.ravel() for f in fields])
        return self.forward_model.residual(self.model, values)

    def held_at(self, values: Mapping[str, float]) -> ModelResidual:
        """See ``HeldResidual``."""
        return replace(self, forward_model=self.forward_model.held_at({**self.fixed, **values}))

    def batch(self, points: Sequence[dict[str, float]]) -> list[np.ndarray | None]:
        """See ``BatchResidual``; in the processes of the forward model."""
        workers = self.forward_model.workers
        if workers.processes == 1:
            return self._each(points)[0]
        parts = [list(points[k :: workers.processes]) for k in range(min(workers.processes, len(points)))]
        out: list[np.ndarray | None] = [None] * len(points)
        results = workers.map(_residuals, [(part,) for part in parts], shared=(self,))
        for k, result in enumerate(results):
            out[k :: workers.processes], rollouts = unwrap(result)
            if len(parts) > 1:  # else they were counted here
                self.forward_model.rollouts += rollouts
        return out

    def _each(self, points: Sequence[dict[str, float]]) -> tuple[list[np.ndarray | None], int]:
        """The residual at each point, and how many rollouts that took."""
        before, out = self.forward_model.rollouts, []
        for point in points:
            try:
                out.append(self(point))
            except NonFiniteError:
                out.append(None)
        return out, self.forward_model.rollouts - before


def _residuals(residual: ModelResidual, points: list[dict[str, float]]) -> tuple[list[np.ndarray | None], int]:
    return residual._each(points)


def residual_of(forward_model: ForwardModel, model: Model) -> Residual:
    """See ``ModelResidual``."""
    return ModelResidual(forward_model, model)


def held_parameters(forward_model: ForwardModel, fitted: ModelFit) -> frozenset[str]:
    """Names of parameters of the model that have values in ``fitted`` and were not fitted."""
    own = {p.name for p in fitted.parameters}
    return frozenset(p.name for p in forward_model.parameters(fitted.model) if p.name in fitted.values) - own


def evaluate_fit(
    forward_model: ForwardModel, model: Model, parameters: Sequence[Parameter], values: Mapping[str, float],
    jacobian: np.ndarray, *, robust_scale: float,
) -> ModelFit:  # fmt: skip
    """``ModelFit`` of given values: one rollout over all instants; standard errors from ``jacobian`` (M, P)."""
    observations = forward_model.observations
    noise = NoiseModel(observations)
    fields = forward_model.fields(model, values, held_out=True)
    whitened = noise.whiten([f[: e.fit_count] for f, e in zip(fields, observations, strict=True)])
    residual = np.concatenate([f.ravel() for f in whitened])
    samples = noise.effective_samples(whitened)
    weight = soft_l1_weight(residual, robust_scale)
    variances = np.diag(covariance(jacobian * weight[:, None], residual * weight))
    inflation = max(len(residual) - len(parameters), 1) / max(samples - len(parameters), 1)
    return ModelFit(
        model, dict(values), tuple(parameters), residual, jacobian, soft_l1_mean_square(residual, robust_scale),
        samples, part_mm(fields, observations, "fit") or 0.0, part_mm(fields, observations, "validation"),
        part_mm(fields, observations, "test"), fields,
        standard_errors(parameters, values, variances * inflation),
    )  # fmt: skip


def linear_minimum(fitted: ModelFit, robust_scale: float) -> float:
    """The least cost [m²] that the derivatives of ``fitted`` promise, within the bounds of its parameters."""
    if not fitted.parameters:
        return fitted.cost
    scale = np.array([p.step for p in fitted.parameters])
    here = np.array([p.fitted(fitted.values[p.name]) for p in fitted.parameters])
    # A value at its bound may be beyond it by rounding.
    lower = np.minimum(np.array([p.fitted(p.lower) for p in fitted.parameters]) - here, -1e-9)
    upper = np.maximum(np.array([p.fitted(p.upper) for p in fitted.parameters]) - here, 1e-9)
    columns, weight = fitted.jacobian * scale, soft_l1_weight(fitted.residual, robust_scale)
    q, r = np.linalg.qr(columns * weight[:, None])
    step = lsq_linear(r, -(q.T @ (fitted.residual * weight)), (lower / scale, upper / scale)).x
    return min(soft_l1_mean_square(fitted.residual + columns @ step, robust_scale), fitted.cost)


def gauss_newton_fit(
    forward_model: ForwardModel,
    model: Model,
    values: Mapping[str, float],
    *,
    budget: int,
    robust_scale: float | None = None,
    held: frozenset[str] = frozenset(),
) -> ModelFit:
    """``model`` fitted with fresh derivatives from ``values`` (defaults if missing) in at most ``budget`` rollouts.
    held: names of parameters that stay as they are. Raises NonFiniteError and MasivError, see ``gauss_newton``."""
    parameters = with_start_values([p for p in forward_model.parameters(model) if p.name not in held], values)
    fixed = {name: values[name] for name in held}
    residual = ModelResidual(forward_model, model, fixed)
    if not parameters:
        here = residual({})
        empty = np.zeros((len(here), 0))
        scale = robust_scale or robust_scale_of(here)
        return evaluate_fit(forward_model, model, parameters, fixed, empty, robust_scale=scale)
    estimate = gauss_newton(residual, parameters, max_evaluations=budget, robust=True, tolerance=MIN_DECREASE)
    return evaluate_fit(
        forward_model, model, parameters, {**fixed, **estimate.values}, estimate.jacobian,
        robust_scale=robust_scale or robust_scale_of(estimate.residual),
    )  # fmt: skip


def warm_started_fit(forward_model: ForwardModel, fitted: ModelFit, robust_scale: float) -> ModelFit:
    """``fitted`` again from where it ended, in another forward model of the same observations."""
    budget = 8 * (len(forward_model.parameters(fitted.model)) + 1)
    held = held_parameters(forward_model, fitted)
    return gauss_newton_fit(
        forward_model, fitted.model, fitted.values, budget=budget, robust_scale=robust_scale, held=held
    )


def refit_whitened(forward_model: ForwardModel, base: ModelFit, steps: int, robust_scale: float) -> ModelFit:
    """``base`` fitted again to the residual as ``forward_model`` whitens it now; fresh derivatives before and after
    ``steps`` of Broyden's method. Raises NonFiniteError."""
    parameters = with_start_values(forward_model.parameters(base.model), base.values)
    residual = residual_of(forward_model, base.model)
    values = {**base.values, **{p.name: p.start for p in parameters}}
    here = linearize(residual, parameters, values)
    if parameters and steps:
        here = broyden(residual, parameters, here, steps=steps, robust_scale=robust_scale)
        here = linearize(residual, parameters, here.values)
    return evaluate_fit(forward_model, base.model, parameters, here.values, here.jacobian, robust_scale=robust_scale)


def linear_strengths(
    forward_model: ForwardModel,
    model: Model,
    values: Mapping[str, float],
    strengths: Sequence[Parameter],
    robust_scale: float,
) -> dict[str, float]:
    """``values`` with the ``strengths`` that are best with all else as it is, of a linear model about zero. Raises
    NonFiniteError."""
    residual = residual_of(forward_model, model)
    absent: Linearization = linearize(residual, strengths, {**values, **{p.name: 0.0 for p in strengths}})
    return gauss_newton_jump(residual, strengths, absent, robust_scale=robust_scale).values


def best_strength(
    forward_model: ForwardModel, model: Model, values: Mapping[str, float], strengths: Sequence[Parameter],
    robust_scale: float, factors: Sequence[float] = STRENGTH_FACTORS,
) -> tuple[dict[str, float], float]:  # fmt: skip
    """``values`` with the ``strengths`` at the best of some ``factors`` of theirs, all else as it is; and its cost
    [m²]: what contact does is not smooth, and derivatives about zero may not say where it sets in. Infinite cost if all
    diverge."""
    best, least = dict(values), math.inf
    for factor in factors:
        scaled = {p.name: float(np.clip(factor * values[p.name], p.lower, p.upper)) for p in strengths}
        try:
            cost = soft_l1_mean_square(forward_model.residual(model, {**values, **scaled}), robust_scale)
        except NonFiniteError:
            continue
        if cost < least:
            best, least = {**values, **scaled}, cost
    return best, least
