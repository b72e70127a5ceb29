"""Bodies in free flight move as rigid bodies: only their initial states are fitted."""

from __future__ import annotations

from collections.abc import Mapping

from masiv.inference.model_fit import ModelFit, gauss_newton_fit
from masiv.models.base import Model
from masiv.models.point_mass import RIGID, PointMassModel


def fit_flights(
    forward_model: PointMassModel, model: Model | None = None, values: Mapping[str, float] | None = None
) -> ModelFit:
    """Free fall, of which only the initial state of each flight is fitted; or ``model``, from ``values``."""
    model = model or Model(RIGID, "none")
    budget = 12 * (len(forward_model.parameters(model)) + 1)
    return gauss_newton_fit(forward_model, model, values or {}, budget=budget)
