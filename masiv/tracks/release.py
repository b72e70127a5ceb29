"""When a body that is held at rest is let go. Light: no torch, no taichi."""

from __future__ import annotations

import numpy as np
from scipy.optimize import nnls

SIGMAS = 6.0
"""A marker has left its rest where it is farther away than that many standard deviations of its noise …"""
SHARE = 0.02
"""… and than that share of its usual travel, since what holds a body creeps …"""
LASTING = 3
"""… in as many frames running."""
BEFORE = 12
"""Frames before that in which the release is looked for, in steps of a twentieth of a frame."""


def found_release(
    times: np.ndarray, positions: np.ndarray, rest: slice, at_rest: np.ndarray, noise: np.ndarray
) -> float | None:
    """The time [s] of the release, or None where nothing ever moves.

    times (T,) [s]; positions (T, M, 3), at_rest and noise (M, 3) [m], see ``Run``; rest: frames at rest. The distance
    of the farthest marker from its rest is 0 before the release t0 and v (t − t0) + a (t − t0)² after it, v and a not
    negative: t0 is where that fits best.
    """
    distance = np.sqrt((np.nan_to_num(positions - at_rest) ** 2).sum(axis=2))
    still = SIGMAS * np.sqrt((np.nan_to_num(noise) ** 2).sum(axis=1)) + 1e-9
    moving = (distance > np.maximum(still, SHARE * np.quantile(distance, 0.98, axis=0))).any(axis=1)
    moving[: rest.stop] = False
    lasting = np.convolve(moving, np.ones(LASTING))[LASTING - 1 :] > LASTING - 0.5
    if not lasting.any():
        return None
    first = int(np.argmax(lasting))
    near = slice(max(first - BEFORE, rest.stop - 1), first + LASTING)
    far = distance[near][:, distance[near][-1].argmax()]
    after = times[near]

    def misfit(start: float) -> float:
        since = np.maximum(after - start, 0.0) * (1 / (after[-1] - after[0]))
        return nnls(np.stack([since, since**2], axis=1), far)[1]

    starts = np.linspace(after[0], times[first], 20 * (first - near.start) + 1)
    return float(min(starts, key=misfit))
