"""How a run began, found from its own motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import CubicSpline

if TYPE_CHECKING:
    from masiv.inference.least_squares import Parameter

NEWTON_STEPS = 8
NUDGE = 5.0
"""Steps of the lift from which the motion's derivative is taken: over as much, it is nearly linear."""
LINEAR = 0.5
"""Steps of the lift over which it is linear."""
PASSES = 3


def found_start(
    starts: Sequence[Parameter],
    times: np.ndarray,
    observed: np.ndarray,
    axes: np.ndarray,
    path_at: Callable[[float], CubicSpline],
) -> tuple[np.ndarray, np.ndarray]:
    """Values (S,) of ``starts`` that bring a run nearest to its own motion, ``observed`` (K, M, 3) [m] at ``times``
    (K,) [s since the release that the reader found], by Gauss-Newton; and the markers (K, M, 3) [m] there.

    starts: how much later it was let go, how far aside along each of the first ``axes`` (A, 3), and perhaps a lift, the
    last. path_at: markers (M, 3) over time for a lift [m], a rollout each: three in all where there is a lift (none,
    a nudge, what is found), one more where the motion is not linear from there.
    """
    lifted = starts[-1].name.startswith("lift")
    axes = axes[: len(starts) - 1 - lifted]
    limits = np.array([p.upper for p in starts])
    start, here, path = np.zeros(len(starts)), 0.0, path_at(0.0)
    bend = None
    if lifted:
        nudge = -NUDGE * starts[-1].step
        bend = CubicSpline(path.x, (path_at(nudge)(path.x) - path(path.x)) / nudge)
    for _ in range(PASSES):
        start = _nearest(start, limits, times, observed, axes, path, bend, here)
        if not lifted or abs(start[-1] - here) <= LINEAR * starts[-1].step:
            break
        here = float(start[-1])
        path = path_at(here)
    return start, _moved(start, times, axes, path, bend, here)


def _moved(start, times, axes, path, bend, here) -> np.ndarray:
    at = np.clip(times - start[0], 0.0, None)
    markers = path(at) + start[1 : 1 + len(axes)] @ axes
    return markers if bend is None else markers + (start[-1] - here) * bend(at)


def _nearest(start, limits, times, observed, axes, path, bend, here) -> np.ndarray:
    """``start`` after some steps, where the motion is linear in the lift about ``here``."""
    slope = path.derivative()
    for _ in range(NEWTON_STEPS):
        at = np.clip(times - start[0], 0.0, None)
        later = -slope(at) * (times > start[0])[:, None, None]
        columns = [later, *(np.broadcast_to(axis, later.shape) for axis in axes)]
        if bend is not None:
            columns.append(bend(at))
        off = _moved(start, times, axes, path, bend, here) - observed
        step = np.linalg.lstsq(np.stack([c.ravel() for c in columns], axis=1), -off.ravel(), rcond=None)[0]
        start = np.clip(start + step, -limits, limits)
    return start
