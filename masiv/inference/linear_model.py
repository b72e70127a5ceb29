"""A model linearised about its fitted values, over all instants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from masiv.inference.least_squares import derivatives
from masiv.inference.model_fit import ModelResidual
from masiv.models.base import ForwardModel, Model
from masiv.models.parameters import Parameter


@dataclass(frozen=True)
class LinearModel:
    """fields: of each observation, predicted less observed (T, N, A) [m]; jacobians: of these by the fitted scales of
    ``parameters``, (T, N, A, P); nuisance: by what is fitted to that observation alone, (T, N, A, Q)."""

    model: Model
    values: dict[str, float]
    parameters: tuple[Parameter, ...]
    fields: list[np.ndarray]
    jacobians: list[np.ndarray]
    nuisance: list[np.ndarray]

    def with_parameters(self, model: Model, values: Mapping[str, float], others: LinearModel) -> LinearModel:
        """``model``, which has the parameters of both: those of ``others`` are linear about the same motion."""
        joined = [np.concatenate(pair, axis=-1) for pair in zip(self.jacobians, others.jacobians, strict=True)]
        return LinearModel(
            model, dict(values), (*self.parameters, *others.parameters), self.fields, joined, self.nuisance
        )


def linear_model(
    forward_model: ForwardModel, model: Model, values: Mapping[str, float], parameters: Sequence[Parameter],
    fields: Sequence[np.ndarray] | None = None,
) -> LinearModel:  # fmt: skip
    """``model`` about ``values``: one rollout over all instants, and one a parameter. fields: what the first would
    give, if that is known. Raises NonFiniteError."""
    here = forward_model.fields(model, values, held_out=True) if fields is None else list(fields)
    together = np.concatenate([f.ravel() for f in here])
    columns = derivatives(ModelResidual(forward_model, model, all_instants=True), values, together, parameters)
    joined = np.stack(columns, axis=1) if columns else np.zeros((len(together), 0))
    parts = np.split(joined, np.cumsum([f.size for f in here])[:-1])
    jacobians = [part.reshape(*f.shape, len(columns)) for part, f in zip(parts, here, strict=True)]
    nuisance = [forward_model.nuisance(model, values, k) for k in range(len(here))]
    return LinearModel(model, dict(values), tuple(parameters), here, jacobians, nuisance)
