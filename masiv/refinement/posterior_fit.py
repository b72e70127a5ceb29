"""The most probable values of a model under the errors that its evidence has.

The fits of a search weigh all residuals as independent. Errors that are smooth in time or over the body are not: the
mean of the posterior (generalised least squares) is nearer to the truth. Gauss-Newton steps lead there, as a model is
not linear.
"""

from __future__ import annotations

from masiv.errors import NonFiniteError
from masiv.inference.model_fit import ModelFit, evaluate_fit
from masiv.models.base import ForwardModel
from masiv.refinement.hypotheses import Hypothesis, linearized, weighed

STEPS = 3
CLOSE = 0.1
"""Distance from the posterior mean, in its standard deviations, that is no longer worth a step."""


def posterior_fit(forward_model: ForwardModel, fitted: ModelFit, robust_scale: float) -> ModelFit:
    """``fitted`` moved to the mean of its posterior, with the standard errors of the posterior. A step is not taken if
    it leads farther from the mean, as seen from where it ends, or if instants for validation are farther off then: the
    errors of a simulation are known less well than those of an observation. Raises NonFiniteError if ``fitted`` cannot
    be linearised."""
    here = _hypothesis(forward_model, fitted)
    for _ in range(STEPS):
        if here.distance_from_mean <= CLOSE:
            break
        try:
            there = _hypothesis(forward_model, _moved(forward_model, here, robust_scale))
        except NonFiniteError:
            break
        if there.distance_from_mean >= here.distance_from_mean or _validation(there) > _validation(here):
            break
        here = there
    return here.with_posterior()


def _hypothesis(forward_model: ForwardModel, fitted: ModelFit) -> Hypothesis:
    return weighed(forward_model, [fitted], [linearized(forward_model, fitted)])[0]


def _validation(hypothesis: Hypothesis) -> float:
    """[mm]; 0 without instants for validation."""
    return hypothesis.fitted.validation_mm or 0.0


def _moved(forward_model: ForwardModel, here: Hypothesis, robust_scale: float) -> ModelFit:
    """The fit at the mean of the posterior, within the bounds of its parameters."""
    fitted, values = here.fitted, dict(here.fitted.values)
    for p, change in zip(here.linear.parameters, here.marginal.mean, strict=False):
        if p.name in values:
            values[p.name] = p.value(p.fitted(values[p.name]) + float(change))
    return evaluate_fit(
        forward_model, fitted.model, fitted.parameters, values, fitted.jacobian, robust_scale=robust_scale
    )
