"""Estimate when a body that is held at rest is released. Light: no torch, no taichi."""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

MIN_DISTANCE_SIGMAS = 6.0
"""A marker has moved if its distance from rest exceeds this many standard deviations of its noise [1] …"""
MIN_TRAVEL_FRACTION = 0.02
"""… and this fraction of its 98 % quantile [1], since a support can creep …"""
MIN_FRAMES = 3
"""… in this many consecutive frames."""
SEARCH_FRAMES = 12
"""Frames before the first motion among which the release is searched, in steps of 1/20 frame."""


def estimate_release(
    times: np.ndarray, positions: np.ndarray, rest: slice, at_rest: np.ndarray, noise: np.ndarray
) -> float | None:
    """The time [s] of the release, or None if no marker moves.

    times (T,) [s]; positions (T, M, 3), at_rest and noise (M, 3) [m], see ``Run``; rest: frames at rest. Model: the
    distance of the farthest marker from its rest position is 0 before the release t0, and v (t − t0) + a (t − t0)² with
    v, a ≥ 0 after it. t0 minimizes the squared residual.
    """
    distance = np.sqrt((np.nan_to_num(positions - at_rest) ** 2).sum(axis=2))
    still = MIN_DISTANCE_SIGMAS * np.sqrt((np.nan_to_num(noise) ** 2).sum(axis=1)) + 1e-9
    moving = (distance > np.maximum(still, MIN_TRAVEL_FRACTION * np.quantile(distance, 0.98, axis=0))).any(axis=1)
    moving[: rest.stop] = False
    lasting = np.convolve(moving, np.ones(MIN_FRAMES))[MIN_FRAMES - 1 :] > MIN_FRAMES - 0.5
    if not lasting.any():
        return None
    first = int(np.argmax(lasting))
    near = slice(max(first - SEARCH_FRAMES, rest.stop - 1), first + MIN_FRAMES)
    far = distance[near][:, distance[near][-1].argmax()]
    after = times[near]

    def residual(start: float) -> float:
        since = np.maximum(after - start, 0.0) * (1 / (after[-1] - after[0]))
        return nnls(np.stack([since, since**2], axis=1), far)[1]

    starts = np.linspace(after[0], times[first], 20 * (first - near.start) + 1)
    return float(min(starts, key=residual))
