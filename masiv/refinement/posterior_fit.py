"""The most probable values of a model under the errors that its evidence has.

The fits of a search weigh all residuals as independent. Errors that are smooth in time or over the body are not: the
mean of the posterior (generalised least squares) is nearer to the truth. Gauss-Newton steps lead there, as a model is
not linear.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from masiv.errors import NonFiniteError
from masiv.inference.error_model import ErrorModel
from masiv.inference.evidence import Evidence
from masiv.inference.linear_model import LinearModel
from masiv.inference.marginal_likelihood import Marginal
from masiv.inference.model_fit import ModelFit, evaluate_fit
from masiv.models.base import ForwardModel
from masiv.refinement.hypotheses import Hypothesis, Linearizations

STEPS = 3
PROBABLE = 0.5
"""Probability of something unknown above which the errors of a model are not those that were expected."""
CLOSE = 0.1
"""Distance from the posterior mean, in its standard deviations, that is no longer worth a step."""
PARTS_OF_STEP = (1.0, 0.5, 0.25)
"""Of the way to the posterior mean, which are tried one after the other."""


def posterior_fit(
    forward_model: ForwardModel, fitted: ModelFit, robust_scale: float, linearizations: Linearizations | None = None
) -> ModelFit:
    """``fitted`` moved to the mean of its posterior, with the standard errors of the posterior. It stays if something
    unknown probably acts: errors as large as the motion tell next to nothing of it. A step is not taken if it makes
    the residual less probable, as the model is not linear, or if instants for validation are farther off then: the
    errors of a simulation are known less well than those of an observation. Raises NonFiniteError if ``fitted`` cannot
    be linearised."""
    known = linearizations or Linearizations()
    here = _Point.of(forward_model, fitted, known)
    for _ in range(STEPS):
        moved = here.stepped(forward_model, robust_scale, lambda found: not _worse(found, fitted))
        if moved is None:
            break
        try:
            here = _Point.of(forward_model, moved, known)
        except NonFiniteError:
            break
    return here.hypothesis.with_posterior()


def linearized_at_mean(
    forward_model: ForwardModel, fitted: ModelFit, evidence: Evidence, robust_scale: float,
    linearizations: Linearizations,
) -> LinearModel:  # fmt: skip
    """The model of ``fitted`` linearised about the mean of its posterior with the errors of ``evidence``, as near as
    steps lead that make its residual more probable: Laplace's method asks for it. Raises NonFiniteError if ``fitted``
    cannot be linearised."""
    here = _Point.of(forward_model, fitted, linearizations, evidence)
    for _ in range(STEPS):
        moved = here.stepped(forward_model, robust_scale)
        if moved is None:
            break
        try:
            here = _Point.of(forward_model, moved, linearizations, evidence, here.hypothesis.marginal)
        except NonFiniteError:
            break
    return here.hypothesis.linear


def _worse(moved: ModelFit, fitted: ModelFit) -> bool:
    """Whether instants for validation are farther off; False if there are none."""
    return (moved.validation_mm or 0.0) > (fitted.validation_mm or 0.0)


def _any(_: ModelFit) -> bool:
    return True


@dataclass(frozen=True)
class _Point:
    """A fit with its evidence, linearised."""

    evidence: Evidence
    hypothesis: Hypothesis

    @classmethod
    def of(
        cls, forward_model: ForwardModel, fitted: ModelFit, linearizations: Linearizations,
        evidence: Evidence | None = None, near: Marginal | None = None,
    ) -> _Point:  # fmt: skip
        """evidence: with other errors than those that ``fitted`` leaves. near: of a point nearby, with this evidence.
        Raises NonFiniteError."""
        line = linearizations.of(forward_model, fitted)
        evidence = evidence or Evidence.of(forward_model.observations, line.fields)
        terms = [forward_model.term(n) for n in fitted.model.effects]
        return cls(evidence, Hypothesis(fitted, line, evidence.marginal(line, terms, near=near)))

    def stepped(
        self, forward_model: ForwardModel, robust_scale: float, allowed: Callable[[ModelFit], bool] = _any
    ) -> ModelFit | None:
        """The fit nearer to the mean of the posterior, within the bounds of its parameters; None if it is there, if
        something unknown probably acts, or if no part of the way is ``allowed`` and makes the residual more
        probable."""
        known = self.hypothesis
        if known.distance_from_mean <= CLOSE or known.marginal.unknown > PROBABLE:
            return None
        fitted, here = known.fitted, self.log_density(known.fitted)
        for part in PARTS_OF_STEP:
            try:
                moved = evaluate_fit(
                    forward_model, fitted.model, fitted.parameters, known.mean_values(fitted.values, part),
                    fitted.jacobian, robust_scale=robust_scale,
                )  # fmt: skip
            except NonFiniteError:
                continue
            if self.log_density(moved) > here and allowed(moved):
                return moved
        return None

    def log_density(self, fitted: ModelFit) -> float:
        """Of the residual of ``fitted`` under the errors of this point; what is no value of a fit, such as the start of
        a held-out flight, is at the mean of the posterior."""
        line, marginal = self.hypothesis.linear, self.hypothesis.marginal
        free = np.ones(len(marginal.mean), dtype=bool)
        free[[k for k, p in enumerate(line.parameters) if p.name in self.hypothesis.fitted.values]] = False
        blocks = self.evidence.blocks(replace(line, fields=list(fitted.fields)))
        model = ErrorModel(tuple(blocks), marginal.logs)
        return model.logpdf([b.residual + b.jacobian @ (marginal.mean * free) for b in blocks])
