"""When a body that is held at rest is let go. Light: no torch, no taichi."""

from __future__ import annotations

import numpy as np

SIGMAS = 6.0
"""A marker moves where it is farther from its rest than that many standard deviations of its noise."""
LASTING = 3
"""… in as many frames running."""


def found_release(times: np.ndarray, positions: np.ndarray, rest: slice) -> float | None:
    """The time [s] of the release, or None where nothing ever moves.

    times (T,) [s]; positions (T, M, 3) [m]; rest: frames at rest. The farthest marker from its rest decides. From rest,
    distance grows as ½ a (t − t0)², so its square root is a line in time: t0 is where that of the first two moving
    frames is zero, kept within the frame before the first of them.
    """
    at_rest = positions[rest]
    known = np.isfinite(at_rest)
    count = np.maximum(known.sum(0), 1)
    middle = np.where(known, at_rest, 0.0).sum(0) / count
    off = np.where(known, at_rest - middle, 0.0)
    noise = np.sqrt((off**2).sum(0) / np.maximum(count - 1, 1))
    distance = np.where(np.isfinite(positions), np.abs(positions - middle), 0.0)
    threshold = np.maximum(SIGMAS * noise, 1e-9 + 0.02 * distance.max(axis=0))
    moving = (distance > threshold).any(axis=(1, 2))
    moving[: rest.stop] = False
    lasting = np.convolve(moving, np.ones(LASTING), mode="full")[LASTING - 1 :] == LASTING
    if not lasting.any():
        return None
    first = int(np.argmax(lasting))
    whole = np.sqrt((distance**2).sum(axis=2)).max(axis=1)
    roots = np.sqrt(whole[first : first + 2])
    slope = (roots[1] - roots[0]) / (times[first + 1] - times[first])
    guess = times[first] - roots[0] / slope if slope > 0 else times[first - 1]
    return float(np.clip(guess, times[first - 1], times[first]))
