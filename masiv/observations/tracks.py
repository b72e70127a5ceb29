"""Measured points of one run: markers on a body, or the middle of a body in flight. World axes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from masiv.errors import InputError
from masiv.observations.base import Observation
from masiv.tracks.tracks import MIN_SEEN_FRAMES, Run, Tracks

MIN_NOISE = 1e-6
"""[m], about what single precision leaves of a position."""
FLIGHT_DEGREE = 6
"""Degree of the polynomial that any smooth flight is taken for."""


@dataclass(frozen=True, kw_only=True)
class TracksObservation(Observation):
    """A run from its release (or first frame) on: all of it is fitted, or is for validation, or for the test.

    body, condition: as in the scene. axes: which of x, y, z were measured. skipped [s]: time after the release that is
    left out. held_straight: the body has its rest shape before the release.
    """

    body: str
    condition: str
    axes: tuple[int, ...]
    skipped: float = 0.0
    held_straight: bool = True

    @property
    def fitted(self) -> bool:
        """Whether the run is fitted, not held out."""
        return self.fit_count > 0

    def places_in_world(self, elsewhere: np.ndarray) -> np.ndarray:
        """See ``Observation``."""
        out = np.tile(np.asarray(elsewhere, dtype=np.float64), (*self.values.shape[:2], 1))
        out[..., list(self.axes)] = self.values
        return out

    @property
    def purpose(self) -> str:
        """As a scene declares it: fit, hold_out or test."""
        return "fit" if self.fitted else "test" if self.test_count else "hold_out"

    def shortened(self, duration: float) -> TracksObservation:
        """The first ``duration`` [s] of what is compared."""
        kept = self.times <= self.skipped + duration
        count = int(kept.sum())
        return replace(
            self, times=self.times[kept], values=self.values[kept], residual_std=self.residual_std[kept],
            observation_std=self.observation_std[kept], **_counts(self.purpose, count),
        )  # fmt: skip


def _counts(purpose: str, count: int) -> dict[str, Any]:
    """How many of ``count`` instants of a run are fitted, and how many are for the test."""
    return {"fit_count": count if purpose == "fit" else 0, "test_count": count if purpose == "test" else 0}


def marker_observation(
    run: Run, markers: Sequence[int], points: np.ndarray, duration: float, skipped: float = 0.0
) -> TracksObservation:
    """``run`` from ``skipped`` to ``duration`` [s] after its release: its ``markers`` (indices), which are at
    ``points`` (M, 3) [m, world] at rest, in the frames that show them all. Raises InputError."""
    times, positions, _ = run.released(markers, skipped, duration)
    noise = MIN_NOISE
    if run.noise_std is not None:
        noise = max(float(np.sqrt((run.noise_std[list(markers)] ** 2).sum(1).mean())), MIN_NOISE)
    return TracksObservation(
        name=run.name, times=times, points=points, values=positions,
        noise_std=noise, residual_std=np.full(len(times), noise), body=run.body, condition=run.condition,
        axes=(0, 1, 2), skipped=skipped, held_straight=run.held_straight, **_counts(run.purpose, len(times)),
    )  # fmt: skip


def flight_observations(tracks: Tracks, group: str) -> tuple[TracksObservation, ...]:
    """The flights of the bodies of ``group``, one point each. Raises InputError if a body cannot be taken for a point,
    or no run is fitted."""
    bodies = tracks.groups().get(group)
    if bodies is None:
        raise InputError(f"{tracks.path} has no group '{group}': it has {', '.join(tracks.groups())}")
    names = {b.name for b in bodies}
    out = tuple(_flight(tracks, run) for run in tracks.runs if run.body in names)
    if not any(run.fitted for run in out):
        raise InputError(f"{tracks.path}: no run of group {group} may be fitted: give one `use: fit`")
    return out


def _flight(tracks: Tracks, run: Run) -> TracksObservation:
    if len(run.markers) != 1 or tracks.bodies[run.body].clamps:
        raise InputError(
            f"{tracks.path}: run {run.name}: a body of a group flies free and has one marker, its middle: "
            "choose it with markers, and leave out the clamp"
        )
    moving = run.moving()
    axes = tuple(int(a) for a in np.flatnonzero(moving.axes[0]))
    seen = moving.seen[:, 0]
    if seen.sum() < MIN_SEEN_FRAMES:
        raise InputError(
            f"{tracks.path}: run {run.name} has {int(seen.sum())} frames in flight: it needs {MIN_SEEN_FRAMES} or more"
        )
    times = moving.times[seen]
    times = times - times[0]
    places = moving.positions[seen][:, 0, list(axes)]
    noise = flight_noise(times, places)
    return TracksObservation(
        name=run.name, times=times, points=np.zeros((1, 3)), values=places[:, None],
        noise_std=noise, residual_std=np.full(len(times), noise), body=run.body, condition=run.condition, axes=axes,
        **_counts(run.purpose, len(times)),
    )  # fmt: skip


def flight_noise(times: np.ndarray, places: np.ndarray) -> float:
    """Root mean square distance [m] of a flight (K, A) at ``times`` (K,) [s] from the nearest polynomial: what no
    smooth motion explains, a lower bound of the noise. A flight of few frames does not show it: it is ``MIN_NOISE``."""
    if len(times) <= 2 * FLIGHT_DEGREE:
        return MIN_NOISE
    basis = np.polynomial.chebyshev.chebvander(2 * times / times[-1] - 1, FLIGHT_DEGREE)
    left = places - basis @ np.linalg.lstsq(basis, places, rcond=None)[0]
    return max(math.sqrt(float((left**2).sum()) / (len(times) - FLIGHT_DEGREE - 1)), MIN_NOISE)
