"""A cloud of measured points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Cloud:
    """points (N, 3) float64 [m, world]; normals (N, 3) unit, outwards, or None; colours (N, 3) in [0, 1], or None."""

    points: np.ndarray
    normals: np.ndarray | None = None
    colours: np.ndarray | None = None
