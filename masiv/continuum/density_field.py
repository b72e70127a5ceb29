"""A solid as a field of occupancy, and particles inside it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage


@dataclass(frozen=True)
class DensityField:
    """Occupancy (I, J, K) in [0, 1] at lower + spacing (i, j, k) [m]; the solid is {density > 0.5}."""

    density: np.ndarray
    lower: np.ndarray
    spacing: float

    @property
    def volume(self) -> float:
        """Volume of the solid [m³]."""
        return float((self.density > 0.5).sum()) * self.spacing**3

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Which points (N, 3) [m] are in the solid, (N,) bool."""
        coordinates = ((points - self.lower) / self.spacing).T
        return ndimage.map_coordinates(self.density, coordinates, order=1, mode="constant", cval=0.0) > 0.5


def even_points(field: DensityField, spacing: float) -> np.ndarray:
    """Points (M, 3) [m] of a body-centred cubic lattice inside ``field``, one for each spacing³ of volume.

    For a given number of points this lattice leaves smaller gaps than a simple cubic one.
    """
    cell = spacing * 2 ** (1 / 3)
    solid = np.argwhere(field.density > 0.5)
    low = field.lower + (solid.min(axis=0) - 1) * field.spacing
    high = field.lower + (solid.max(axis=0) + 1) * field.spacing
    counts = np.ceil((high - low) / cell).astype(int) + 1
    corners = low + cell * np.stack(np.meshgrid(*[np.arange(c) for c in counts], indexing="ij"), -1).reshape(-1, 3)
    lattice = np.concatenate([corners + 0.25 * cell, corners + 0.75 * cell])
    return lattice[field.inside(lattice)]
