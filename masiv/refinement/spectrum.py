"""Frequencies at which a force that oscillates would explain the mean residual: guesses for the ranking."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from masiv.observations.base import Observation

COUNT = 2
"""Peaks of the spectrum that are tried."""
OVERSAMPLING = 4
"""Frequencies over the reciprocal of the record's length."""


def spectral_guesses(observations: Sequence[Observation], fields: Sequence[np.ndarray]) -> list[float]:
    r"""The highest peaks [Hz], highest first, of the part of the mean motion's residual that a force
    :math:`A \cos 2\pi f t + B \sin 2\pi f t` on a free body explains, place and velocity at the start apart (a
    least-squares spectrum; Lomb, Astrophys. Space Sci. 39, 1976). fields (T, N, A) [m]: residuals, of which the fitted
    instants count. From one period in the longest record to two instants a period; empty if there are no such
    frequencies."""
    pairs = zip(observations, fields, strict=True)
    means = [(e.times[: e.fit_count], f[: e.fit_count].mean(1)) for e, f in pairs if e.fit_count > 3]
    if not means:
        return []
    duration = max(float(times[-1]) for times, _ in means)
    interval = min(float(np.median(np.diff(times))) for times, _ in means)
    frequencies = np.arange(1 / duration, 0.5 / interval, 1 / (OVERSAMPLING * duration))
    if not len(frequencies):
        return []
    power = np.array([sum(_explained(times, mean, f) for times, mean in means) for f in frequencies])
    padded = np.concatenate([[-1.0], power, [-1.0]])
    peaks = np.flatnonzero((power > padded[:-2]) & (power >= padded[2:]))
    return [float(frequencies[k]) for k in sorted(peaks, key=lambda k: -power[k])[:COUNT]]


def _explained(times: np.ndarray, mean: np.ndarray, frequency: float) -> float:
    """Sum of squares [m²] of ``mean`` (T, A) that an oscillation explains of what a free motion leaves."""
    free = np.stack([np.ones_like(times), times], axis=1)
    phase = 2 * np.pi * frequency * times
    whole = np.column_stack([free, np.cos(phase), np.sin(phase)])
    with_force, without = (np.linalg.qr(columns)[0].T @ mean for columns in (whole, free))
    return float((with_force**2).sum() - (without**2).sum())
