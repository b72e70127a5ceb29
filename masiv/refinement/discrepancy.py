"""A smooth force field for what no effect explains: fitted through the rollout, with a prior.

Law, initial state and the field are fitted jointly. The field has more coefficients than a record determines, so its
coefficients have a Gaussian prior: correlated in time (Matérn 5/2), small, and of less change over the body than
acceleration of it. Size, correlation time and change are those that make the fitted instants most probable
(``masiv.inference.gaussian_prior``).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit

from masiv.effects.smooth_force import GRADIENT_SPLINES, SPLINES
from masiv.errors import MasivError, NonFiniteError
from masiv.inference.error_covariance import matern52
from masiv.inference.gaussian_prior import Choice, most_probable
from masiv.inference.least_squares import MIN_DECREASE, standard_errors
from masiv.inference.linear_model import LinearModel, linear_model
from masiv.inference.model_fit import ModelFit, evaluate_fit
from masiv.inference.robust import soft_l1_mean_square, soft_l1_weight
from masiv.models.base import EffectTerm, ForwardModel, Model
from masiv.models.parameters import Parameter
from masiv.refinement.search_state import SearchSettings, SearchState
from masiv.refinement.tasks import map_tasks
from masiv.workers import unwrap

DISCREPANCY_FORCE = "smooth_force"
"""The effect that stands in for what no effect of the library explains."""
STRENGTHS_PER_TASK = 18
"""Derivatives that one process takes before it reports."""
STEPS, HALVINGS = 6, 3
"""Steps with one set of derivatives, and how often a step that goes too far is halved."""
PASSES = 2
"""Sets of derivatives, at most: those about zero mislead where a strong force changes a contact."""
MIN_PROMISE_KEPT = 0.5
"""Part of the promised decrease below which derivatives are taken again."""
SIZES = tuple(np.geomspace(0.1, 100.0, 7))
"""Standard deviations [m/s^2] of the acceleration at the centre, to choose from."""
CORRELATION_TIMES = (0.1, 0.3, 1.0)
"""Correlation times over the record, to choose from."""
CHANGES = (0.1, 1.0)
"""Change of the acceleration from the centre to the rim of where the body was, over its size, to choose from."""
ERRORS = tuple(np.geomspace(1.0, 32.0, 6))
"""Standard deviations of the residual that is left, over what is expected with nothing missing, to choose from."""
AFFINE_MODES = 4
"""Independent modes of motion along an axis: a mean, and a linear change along three axes. Errors of points move in
such modes, so no instant counts for more values than these, however many points were observed."""


def discrepancy_force(state: SearchState, settings: SearchSettings) -> ModelFit | None:
    """``state.fit`` with a smooth force for what is not known, its standard errors those of the posterior. None if it
    is not probable either, errors up to ``ERRORS`` as large as expected taken into account, or cannot be simulated."""
    label = "refine: a smooth force for the rest"
    try:
        fitted, without = _Fit.of(state, settings, label).result()
    except MasivError as failed:
        settings.progress(label, 1, 1, str(failed))
        return None
    settings.progress(label, 1, 1, f"{fitted.fit_mm:.1f} mm")
    return fitted if without < settings.config.max_null_probability else None


@dataclass(frozen=True)
class _Fit:
    """state: without the force; term: the force; base: ``state.fit`` linearised; label: of the progress."""

    state: SearchState
    settings: SearchSettings
    term: EffectTerm
    base: LinearModel
    label: str

    @classmethod
    def of(cls, state: SearchState, settings: SearchSettings, label: str) -> _Fit:
        """Raises NonFiniteError."""
        term = state.forward_model.term(DISCREPANCY_FORCE)
        model, fit = state.forward_model, state.fit
        parameters = [p for p in model.parameters(fit.model) if p.name in fit.values]
        return cls(state, settings, term, linear_model(model, fit.model, fit.values, parameters), label)

    @property
    def forward_model(self) -> ForwardModel:
        return self.state.forward_model

    @property
    def model(self) -> Model:
        return self.state.fit.model.with_effect(self.term.name)

    def result(self) -> tuple[ModelFit, float]:
        """The fit, and the probability that there is no such force. Raises MasivError."""
        fixed = dict(zip((p.name for p in self.term.others), self.term.guesses[0], strict=True))
        values = {**self.base.values, **{p.name: 0.0 for p in self.term.strengths}, **fixed}
        line = self.base.with_parameters(self.model, values, self._strengths(values))
        reached = self._reached(line)
        for _ in range(PASSES - 1):
            if reached.kept >= MIN_PROMISE_KEPT:
                break
            line = self._linearized(reached.values, line.parameters)
            reached = self._reached(line)
        jacobian = self._fitted_part(line.jacobians)
        steps = np.array([p.step for p in line.parameters])
        fitted = evaluate_fit(
            self.forward_model, self.model, line.parameters, reached.values, jacobian,
            robust_scale=self.state.robust_scale,
        )  # fmt: skip
        chosen = self._chosen(
            fitted.residual, reached.jacobian, self._strengths_of(reached.values, line.parameters), line.parameters
        )
        errors = standard_errors(line.parameters, reached.values, np.diag(chosen.covariance) * steps**2)
        log_odds = chosen.log_evidence - self._log_evidence_without()
        return replace(fitted, stderr={**fitted.stderr, **errors}), float(expit(-log_odds))

    def _log_evidence_without(self) -> float:
        base = self.state.fit
        columns = self._fitted_part(self.base.jacobians) * np.array([p.step for p in self.base.parameters])
        weight = soft_l1_weight(base.residual, self.state.robust_scale) / self._unit
        flat = np.diag(flat_precision(self.base.parameters))
        return most_probable(
            base.residual * weight, columns * weight[:, None], self._count, [flat], ERRORS
        ).log_evidence

    def _strengths(self, values: Mapping[str, float]) -> LinearModel:
        """Derivatives by the strengths. Raises MasivError."""
        own = self.term.strengths
        parts = [own[k : k + STRENGTHS_PER_TASK] for k in range(0, len(own), STRENGTHS_PER_TASK)]
        tasks = [(self.model, values, part) for part in parts]
        self.settings.progress(self.label, 0, len(own))
        whole: LinearModel | None = None
        for found in map_tasks(self.settings.workers, self.forward_model, linear_model, tasks):
            line: LinearModel = unwrap(found)
            whole = line if whole is None else whole.with_parameters(self.model, values, line)
            self.settings.progress(self.label, len(whole.parameters), len(own))
        assert whole is not None
        return whole

    def _linearized(self, values: Mapping[str, float], parameters: Sequence[Parameter]) -> LinearModel:
        rest = [p for p in parameters if p not in self.term.strengths]
        line = linear_model(self.forward_model, self.model, values, rest)
        return line.with_parameters(self.model, values, self._strengths(values))

    def _reached(self, line: LinearModel) -> _Reached:
        """The most probable values, by damped Gauss-Newton steps with Broyden's updates. Raises NonFiniteError."""
        parameters = line.parameters
        scale = np.array([p.step for p in parameters])
        here = _Reached(dict(line.values), self._residual(line.values), self._fitted_part(line.jacobians) * scale)
        first, promised = self._cost(here.residual), 0.0
        for turn in range(STEPS):
            strengths = self._strengths_of(here.values, parameters)
            chosen = self._chosen(here.residual, here.jacobian, strengths, parameters)
            step = chosen.x - strengths
            if turn == 0:
                promised = first - self._cost(here.residual + here.jacobian @ step)
            before = self._objective(here.residual, strengths, chosen)
            here, decrease = self._stepped(here, parameters, step, chosen, before)
            if decrease < MIN_DECREASE * before:
                break
        gained = first - self._cost(here.residual)
        return replace(here, kept=gained / promised if promised > 0 else 1.0)

    def _stepped(
        self, here: _Reached, parameters: Sequence[Parameter], step: np.ndarray, chosen: Choice, before: float
    ) -> tuple[_Reached, float]:
        """After ``step`` (P,) in finite-difference steps, or the part of it that lowers the objective from ``before``;
        and by how much."""
        for halving in range(HALVINGS + 1):
            trial = dict(here.values)
            for p, d in zip(parameters, step, strict=True):
                trial[p.name] = p.value(p.fitted(here.values[p.name]) + p.step * d / 2**halving)
            try:
                residual = self._residual(trial)
            except NonFiniteError:
                continue
            moved = np.array([(p.fitted(trial[p.name]) - p.fitted(here.values[p.name])) / p.step for p in parameters])
            if not moved.any():
                break
            miss = residual - here.residual - here.jacobian @ moved
            jacobian = here.jacobian + np.outer(miss, moved / (moved @ moved))
            after = self._objective(residual, self._strengths_of(trial, parameters), chosen)
            if after < before:
                return _Reached(trial, residual, jacobian), before - after
            here = replace(here, jacobian=jacobian)
        return here, 0.0

    def _strengths_of(self, values: Mapping[str, float], parameters: Sequence[Parameter]) -> np.ndarray:
        """Of the force, in finite-difference steps (P,), 0 for all other parameters."""
        return np.array([values[p.name] / p.step if p in self.term.strengths else 0.0 for p in parameters])

    def _chosen(
        self, residual: np.ndarray, jacobian: np.ndarray, strengths: np.ndarray, parameters: Sequence[Parameter]
    ) -> Choice:
        """The most probable values, in finite-difference steps: strengths, and changes of all else."""
        weight = soft_l1_weight(residual, self.state.robust_scale) / self._unit
        at_zero = residual - jacobian @ strengths
        precisions = [
            self._precision(parameters, *sizes) for sizes in itertools.product(SIZES, CORRELATION_TIMES, CHANGES)
        ]
        return most_probable(at_zero * weight, jacobian * weight[:, None], self._count, precisions, ERRORS)

    def _precision(self, parameters: Sequence[Parameter], size: float, length: float, change: float) -> np.ndarray:
        """Of all parameters, in finite-difference steps; flat within the bounds for those that are not the force's."""
        out = np.diag(flat_precision(parameters))
        index = {p.name: k for k, p in enumerate(parameters)}
        own = [index[p.name] for p in self.term.strengths]
        steps = np.array([p.step for p in self.term.strengths])
        out[np.ix_(own, own)] = prior_precision(size, length, change / self._reach) * np.outer(steps, steps)
        return out

    def _objective(self, residual: np.ndarray, strengths: np.ndarray, chosen: Choice) -> float:
        """Minus twice the logarithm of the posterior, but for a constant."""
        data = self._count * self._cost(residual) / (self._noise * chosen.std) ** 2
        return data + float(strengths @ chosen.precision @ strengths)

    def _cost(self, residual: np.ndarray) -> float:
        """[m²]"""
        return soft_l1_mean_square(residual, self.state.robust_scale)

    def _residual(self, values: Mapping[str, float]) -> np.ndarray:
        return self.forward_model.residual(self.model, values)

    def _fitted_part(self, jacobians: Sequence[np.ndarray]) -> np.ndarray:
        """Derivatives (M, P) of the whitened residual from those over all instants."""
        rows = []
        for e, jacobian in zip(self.forward_model.observations, jacobians, strict=True):
            own = np.moveaxis(jacobian[: e.fit_count], -1, 0)
            rows.append(np.stack([e.whiten(column).ravel() for column in own], axis=1))
        return np.concatenate(rows)

    @property
    def _noise(self) -> float:
        """Standard deviation [m] of a whitened residual."""
        return self.forward_model.observations[0].noise_std

    @property
    def _count(self) -> float:
        """Independent values of the fitted instants."""
        return sum(
            e.fit_count * e.values.shape[2] * min(e.values.shape[1], AFFINE_MODES)
            for e in self.forward_model.observations
        )

    @property
    def _unit(self) -> float:
        """Divides a whitened residual such that its squares are those of ``_count`` independent values."""
        values = sum(e.fit_count * e.values.shape[1] * e.values.shape[2] for e in self.forward_model.observations)
        return self._noise * float(np.sqrt(values / self._count))

    @property
    def _reach(self) -> float:
        """Root mean square distance [m] of the observed points from their middle, over all instants."""
        spread = [
            np.nanvar(e.values.reshape(-1, e.values.shape[2]), axis=0).sum() for e in self.forward_model.observations
        ]
        return max(float(np.sqrt(np.mean(spread))), 1e-3)


@dataclass(frozen=True)
class _Reached:
    """residual (M,) at values, and its derivatives (M, P) by finite-difference steps of the parameters. kept: part of
    the decrease that the first linear model promised."""

    values: dict[str, float]
    residual: np.ndarray
    jacobian: np.ndarray
    kept: float = 1.0


def flat_precision(parameters: Sequence[Parameter]) -> np.ndarray:
    """Precisions (P,), in finite-difference steps, of normal densities as wide as the bounds."""
    return np.array([12 * (p.step / (p.fitted(p.upper) - p.fitted(p.lower))) ** 2 for p in parameters])


def prior_precision(size: float, length: float, gradient: float) -> np.ndarray:
    """Precision (P, P) of the strengths of ``SmoothForce``. size [m/s^2]: standard deviation of the acceleration at the
    centre; length: correlation time over the record; gradient [1/m]: standard deviation of its gradient, over size."""

    def in_time(splines: int) -> np.ndarray:
        at = (np.arange(splines) - 0.5) / (splines - 2)
        covariance = matern52(np.abs(np.subtract.outer(at, at)) / length) + 1e-6 * np.eye(splines)
        return np.linalg.inv(covariance)

    uniform = np.kron(in_time(SPLINES), np.eye(3)) / size**2
    change = np.kron(in_time(GRADIENT_SPLINES), np.eye(9)) / (size * gradient) ** 2
    out = np.zeros((len(uniform) + len(change),) * 2)
    out[: len(uniform), : len(uniform)] = uniform
    out[len(uniform) :, len(uniform) :] = change
    return out
