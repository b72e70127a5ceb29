"""Positions of markers over time, as a file of motion capture has them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Table:
    """The content of a file.

    positions (T, M, 3) in ``unit`` (None: the file does not give it), NaN for a gap; times (T,) [s] or None; rate [Hz]
    or None; ignored: columns that are not positions.
    """

    markers: tuple[str, ...]
    positions: np.ndarray
    times: np.ndarray | None
    rate: float | None
    unit: str | None
    ignored: tuple[str, ...] = ()
