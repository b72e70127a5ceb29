"""Values at frames without a picture, from those of the other frames."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline


def interpolated(frames: Sequence[int], values: np.ndarray, count: int) -> np.ndarray:
    """values (K, ...) at ascending ``frames`` (K,) -> (count, ...) at all frames 0 … count-1; the known ones are kept.

    The natural cubic spline between them. Before and after them the values continue in a straight line.
    """
    known = np.asarray(frames)
    if len(known) == count:
        return values
    if len(known) == 1:
        return np.repeat(values, count, axis=0)
    wanted = np.arange(count)
    spline = CubicSpline(known, values, axis=0, bc_type="natural")
    inside = np.clip(wanted, known[0], known[-1])
    beyond = (wanted - inside).reshape(-1, *[1] * (values.ndim - 1))
    found = spline(inside) + beyond * spline(inside, 1)
    found[known] = values
    return found
