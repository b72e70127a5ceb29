"""What other grids would change: how much of it there is is fitted, and what differs from grid to grid is uncertain.

A rollout of few particles on a coarse grid differs from those on finer ones mostly in one way, that of a body which
bounces a little more or a little less than it should. So their mean change, worked out once as the model moves, is
added to the model with a factor that is fitted (deferred correction with a free factor), as an initial velocity is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from masiv.inference.model_fit import ModelFit
from masiv.inference.noise_model import one_more
from masiv.models.base import ForwardModel
from masiv.models.free_body import GRID_CORRECTION
from masiv.observations.base import Observation


def with_residual_std(
    forward_model: ForwardModel, fitted: ModelFit, observation_std: Sequence[np.ndarray]
) -> ForwardModel:
    """``forward_model`` with observations that know what finer grids change as ``fitted`` moves, and ``residual_std``
    (T,) [m]: the root mean square distance by which model and observation may differ at each instant with nothing
    missing. That is the error of the observation, ``observation_std`` (T,) [m], and by how much one more grid may
    differ from the others in what no fit absorbs; in free flight that is nothing.

    It does not fall as time goes on, since errors of the simulation grow. Raises MasivError.
    """
    observations = forward_model.observations
    changes = [forward_model.finer_grids(fitted.model, fitted.values, k) for k in range(len(observations))]
    if not all(changes):
        return forward_model.with_observations(
            [replace(e, residual_std=seen) for e, seen in zip(observations, observation_std, strict=True)]
        )
    mean = [np.mean(own, axis=0) for own in changes]
    kept = [_not_absorbed(observations, fitted, observation_std, each, mean) for each in zip(*changes, strict=True)]
    more = one_more(len(kept))
    out = []
    for k, (e, seen) in enumerate(zip(observations, observation_std, strict=True)):
        whole = np.sqrt(np.mean([_size(change) ** 2 for change in changes[k]], axis=0))
        grid = np.minimum(more * np.sqrt(np.mean([each[k] ** 2 for each in kept], axis=0)), whole)
        std = np.hypot(seen, np.maximum.accumulate(grid))
        out.append(replace(e, residual_std=std, grid_corrections=tuple(changes[k])))
    return forward_model.with_observations(out)


def _size(field: np.ndarray) -> np.ndarray:
    """Root mean square length (T,) of a field (T, N, A)."""
    return np.sqrt((field**2).sum(2).mean(1))


def _not_absorbed(
    observations: Sequence[Observation],
    fitted: ModelFit,
    observation_std: Sequence[np.ndarray],
    changes: Sequence[np.ndarray],
    mean: Sequence[np.ndarray],
) -> list[np.ndarray]:
    """For each observation, the root mean square (T,) [m] of what one grid ``changes`` (T, N, A) and no fit absorbs.

    A fit absorbs the change's part along the derivatives of ``fitted`` and along the ``mean`` change (T, N, A) of all
    grids. After the fitted instants, of what is not along that mean the same part as at their end is taken to be
    absorbed.
    """
    weights = [
        e.noise_std / np.hypot(seen, np.maximum.accumulate(_size(change)))
        for change, seen, e in zip(changes, observation_std, observations, strict=True)
    ]

    def flat(fields: Sequence[np.ndarray]) -> list[np.ndarray]:
        return [
            (f * w[:, None, None])[: e.fit_count].ravel() for f, w, e in zip(fields, weights, observations, strict=True)
        ]

    parts = flat(changes)
    ends = np.cumsum([len(part) for part in parts])
    shares = np.zeros((ends[-1], len(parts)))
    for k, part in enumerate(flat(mean)):
        shares[ends[k] - len(part) : ends[k], k] = part
    # The derivatives are whitened by the residual_std so far.
    again = [
        np.broadcast_to((e.residual_std / e.noise_std)[:, None, None], c.shape)
        for c, e in zip(changes, observations, strict=True)
    ]
    own = [k for k, p in enumerate(fitted.parameters) if not p.name.startswith(GRID_CORRECTION)]
    columns = np.concatenate([shares, fitted.jacobian[:, own] * np.concatenate(flat(again))[:, None]], axis=1)
    scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    change = np.concatenate(parts)
    absorbed = np.linalg.lstsq(columns / scale, change, rcond=1e-8)[0] / scale
    left = np.split(change - columns @ absorbed, ends[:-1])
    out = []
    for k, (weight, e) in enumerate(zip(weights, observations, strict=True)):
        kept = _size(left[k].reshape(e.fit_count, *changes[k].shape[1:])) / weight[: e.fit_count]
        apart = _size(changes[k] - absorbed[k] * mean[k])
        share = min(float(kept[-1] / max(apart[e.fit_count - 1], 1e-300)), 1.0)
        out.append(np.concatenate([kept, share * apart[e.fit_count :]]))
    return out
