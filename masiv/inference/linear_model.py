"""A model linearised about its fitted values, over all instants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from masiv.errors import NonFiniteError
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
    forward_model: ForwardModel, model: Model, values: Mapping[str, float], parameters: Sequence[Parameter]
) -> LinearModel:
    """``model`` about ``values``: one rollout over all instants, and one a parameter. Raises NonFiniteError."""
    here = forward_model.fields(model, values, held_out=True)
    columns = [_derivative(forward_model, model, values, here, p) for p in parameters]
    jacobians = [
        np.stack([c[k] for c in columns], axis=-1) if columns else np.zeros((*f.shape, 0)) for k, f in enumerate(here)
    ]
    nuisance = [forward_model.nuisance(model, values, k) for k in range(len(here))]
    return LinearModel(model, dict(values), tuple(parameters), here, jacobians, nuisance)


def _derivative(
    forward_model: ForwardModel, model: Model, values: Mapping[str, float], here: list[np.ndarray], p: Parameter
) -> list[np.ndarray]:
    centre = p.fitted(values[p.name])
    sides = [1.0, -1.0] if centre + p.step <= p.fitted(p.upper) else [-1.0, 1.0]
    for side in sides:
        shifted = {**values, p.name: p.value(centre + side * p.step)}
        actual = p.fitted(shifted[p.name]) - centre
        if actual == 0:
            continue
        try:
            there = forward_model.fields(model, shifted, held_out=True)
        except NonFiniteError:
            continue
        return [(a - b) / actual for a, b in zip(there, here, strict=True)]
    raise NonFiniteError(0, 0, f"the simulation diverges on both sides of {p.name} = {values[p.name]:.4g}")
