"""The field of the discrepancy force where the body was: what refine.json, refine.npz and the report say of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from masiv.effects.places import farthest_points
from masiv.effects.smooth_force import STRENGTHS, acceleration
from masiv.inference.model_fit import PARTS
from masiv.refinement.discrepancy import DISCREPANCY_FORCE
from masiv.refinement.result import RefineResult

MAX_POINTS = 64
"""Points of an observation at which the field is written."""


@dataclass(frozen=True)
class SampledField:
    """Of one observation: places (T, S, 3) [m, world] of S of its points at its instants times (T,) [s], NaN where
    they were not seen, and the acceleration (T, S, 3) [m/s^2, world] there. fit_count: instants that were fitted."""

    observation: str
    times: np.ndarray
    places: np.ndarray
    acceleration: np.ndarray
    fit_count: int


def sampled_fields(result: RefineResult) -> list[SampledField]:
    """Of each observation; empty if there is no such force."""
    fitted, model = result.search.discrepancy, result.forward_model
    if fitted is None:
        return []
    theta = np.array([fitted.values[p.name] for p in model.term(DISCREPANCY_FORCE).parameters])
    centre = theta[STRENGTHS + 1 :]
    out = []
    for index, e in enumerate(result.observations):
        axes = model.effect_axes(index)
        points = torch.as_tensor(np.asarray(e.points, dtype=np.float64))
        chosen = [int((points - p).square().sum(1).argmin()) for p in farthest_points(points, MAX_POINTS)]
        places = e.places_in_world(axes.points_to_world(centre))[:, chosen]
        found = acceleration(theta, axes.points_to_simulation(places), e.times)
        out.append(SampledField(e.name, e.times, places, axes.vectors_to_world(found), e.fit_count))
    return out


def rms_in_time(field: np.ndarray) -> np.ndarray:
    """Root mean square (T,) over points of the size of a field (T, S, 3); 0 where no point was seen."""
    squares = (field**2).sum(2)
    seen = np.isfinite(squares)
    return np.sqrt(np.where(seen, squares, 0.0).sum(1) / np.maximum(seen.sum(1), 1))


def peak(fields: Sequence[SampledField]) -> dict[str, Any] | None:
    """Where and when the field is strongest: the fitted instant with the largest root mean square over points, and the
    point where it is largest then. None if no instant was fitted."""
    curves = [rms_in_time(f.acceleration[: f.fit_count]) for f in fields]
    k = max(range(len(fields)), key=lambda k: float(curves[k].max(initial=-1.0)))
    if not len(curves[k]):
        return None
    field, instant = fields[k], int(curves[k].argmax())
    sizes = np.linalg.norm(field.acceleration[instant], axis=1)
    if not np.isfinite(sizes).any():
        return None
    point = int(np.nanargmax(sizes))
    size = float(sizes[point])
    direction = field.acceleration[instant, point] / max(size, 1e-300)
    return {
        "observation": field.observation,
        "time": {"value": float(field.times[instant]), "unit": "s"},
        "place": {"value": field.places[instant, point].tolist(), "unit": "m"},
        "direction": direction.tolist(),
        "acceleration": {"value": size, "unit": "m/s^2"},
    }


def share(result: RefineResult) -> dict[str, float | None]:
    """Part of the residual's sum of squares that the force removes, over the fitted, validation and test instants;
    negative if it adds to it; None if there are no such instants."""
    fitted = result.search.discrepancy
    assert fitted is not None

    def squares(fields: Sequence[np.ndarray], part: str) -> float:
        pairs = zip(fields, result.observations, strict=True)
        return sum(float((f[e.parts[part]] ** 2).sum()) for f, e in pairs if part in e.parts)

    def removed(part: str) -> float | None:
        before = squares(result.after.fields, part)
        return 1 - squares(fitted.fields, part) / before if before > 0 else None

    return {part: removed(part) for part in PARTS}
