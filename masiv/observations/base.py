"""What was observed of a motion, whether it was filmed or tracked by markers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Observation:
    """N points of one recording at T instants. The first ``fit_count`` are fitted. The last ``test_count`` are seen by
    no decision: errors are reported on them. Those between are for validation: with the fitted ones they decide which
    law and effects act.

    name: of the recording, different from those that it is fitted with. times (T,) [s], ascending. points (N, 3) [m]:
    where the points are at the start, in the axes of ``values``. values (T, N, A) [m]: what was measured in A axes, NaN
    if it is missing. noise_std [m]: of the measurement. residual_std (T,) [m]: by how much a model that lacks nothing
    may differ from it. observation_std (T,) [m]: the part of that which is measurement; ``residual_std`` itself if not
    given. tracking_error (T, N, A) [m]: one draw of the error of following the points, None if there is none.
    grid_corrections, each (T, N, A) [m]: what each finer grid changes along the motion of a model;
    empty if that is not known. ``dataclasses.replace`` gives an observation another noise or split.

    Raises ValueError for shapes that do not fit together.
    """

    name: str
    times: np.ndarray
    points: np.ndarray
    values: np.ndarray
    fit_count: int
    noise_std: float
    residual_std: np.ndarray
    observation_std: np.ndarray = field(default_factory=lambda: np.zeros(0))
    tracking_error: np.ndarray | None = None
    grid_corrections: tuple[np.ndarray, ...] = ()
    test_count: int = 0

    def __post_init__(self) -> None:
        if not len(self.observation_std):
            object.__setattr__(self, "observation_std", self.residual_std)
        instants, count, _ = self.values.shape
        expected = {
            "times": (self.times, (instants,)),
            "points": (self.points, (count, 3)),
            "residual_std": (self.residual_std, (instants,)),
            "observation_std": (self.observation_std, (instants,)),
            **{f"grid_corrections[{k}]": (c, self.values.shape) for k, c in enumerate(self.grid_corrections)},
            **({} if self.tracking_error is None else {"tracking_error": (self.tracking_error, self.values.shape)}),
        }
        for name, (array, shape) in expected.items():
            if array.shape != shape:
                raise ValueError(f"observation {self.name}: {name} has shape {array.shape}, it must be {shape}")
        if not 0 <= self.fit_count <= instants:
            raise ValueError(f"observation {self.name}: fit_count {self.fit_count} is not within 0 and {instants}")
        if not 0 <= self.test_count <= instants - self.fit_count:
            raise ValueError(
                f"observation {self.name}: test_count {self.test_count} is not within 0 and the "
                f"{instants - self.fit_count} instants that are not fitted"
            )

    @property
    def time_count(self) -> int:
        """T"""
        return len(self.times)

    @property
    def decided_count(self) -> int:
        """How many instants take part in decisions: those that are not for the test."""
        return self.time_count - self.test_count

    @property
    def parts(self) -> dict[str, slice]:
        """Of the instants: ``fit``, ``validation`` and ``test``, those that are not empty."""
        ends = {"fit": (0, self.fit_count), "validation": (self.fit_count, self.decided_count),
                "test": (self.decided_count, self.time_count)}  # fmt: skip
        return {name: slice(*pair) for name, pair in ends.items() if pair[0] < pair[1]}

    @property
    def extent(self) -> float:
        """How far the motion goes along the axis where it goes farthest [m], but for the test."""
        values = self.values[: self.decided_count]
        return float(np.nanmax(np.nanmax(values, (0, 1)) - np.nanmin(values, (0, 1)))) if len(values) else 0.0

    @property
    def grid_correction(self) -> np.ndarray:
        """Mean (T, N, A) [m] of ``grid_corrections``, a part of which may be added to a model."""
        return np.mean(self.grid_corrections, axis=0)

    @property
    def points_in_world(self) -> np.ndarray:
        """``points`` (N, 3) [m, world]."""
        return self.points

    @property
    def values_in_world(self) -> np.ndarray:
        """``values`` (T, N, A) [m] along axes of the world."""
        return self.values

    def places_in_world(self, elsewhere: np.ndarray) -> np.ndarray:
        """Where the points were (T, N, 3) [m, world], NaN if not seen; along axes that were not
        measured, those of ``elsewhere`` (3,) [m, world]."""
        return self.values_in_world

    def field_in_world(self, field: np.ndarray) -> np.ndarray:
        """A residual (K, N, A) [m] along axes of the world."""
        return field

    def residual(self, predicted: np.ndarray) -> np.ndarray:
        """Predicted less observed (K, N, A) [m] of the first K instants, 0 if nothing was measured. Raises ValueError
        for another shape of ``predicted`` (K, N, A)."""
        observed = self.values[: len(predicted)]
        if predicted.shape != observed.shape:
            _, count, axes = self.values.shape
            raise ValueError(
                f"observation {self.name}: a prediction has shape {predicted.shape}, it must be (K, {count}, {axes}) "
                f"with K up to {len(self.values)}"
            )
        field = predicted - observed
        return np.where(np.isnan(observed), 0.0, field) if np.isnan(observed).any() else field

    def whiten(self, field: np.ndarray) -> np.ndarray:
        """A residual (K, N, A) [m] of the first K instants in units of ``residual_std``, times ``noise_std`` [m]: it
        stays as it is while the noise is all that may differ, and counts for less if the model is less certain."""
        return field * (self.noise_std / self.residual_std[: len(field), None, None])


def rms_mm(fields: Sequence[np.ndarray]) -> float:
    """Root mean square distance [mm] of residual fields (K, N, A) [m]."""
    squares = np.concatenate([(f**2).sum(2).ravel() for f in fields])
    return 1e3 * float(np.sqrt(squares.mean()))
