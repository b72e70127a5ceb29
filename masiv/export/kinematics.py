"""What follows from the positions of particles alone: their distance, velocities and deformation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from masiv.errors import InputError
from masiv.local_gradient import local_gradients

NEIGHBOURS = 12
"""Particles of a neighbourhood whose deformation is measured: as for the material (``masiv.characterization``)."""
DENSITY_NEIGHBOURS = np.arange(8, 41)
"""Numbers of neighbours over which the density of points is averaged, so that shells of a lattice do not show."""
INSIDE_PERCENTILE = 10
"""Percentile of the volume a point: points at the surface have a neighbourhood that is half empty."""


def particle_spacing(points: np.ndarray) -> float:
    """Edge [m] of the cube whose volume one of ``points`` (Q, 3) [m] stands for, from their density.

    The ball through the k-th neighbour of a point holds k + 1/2 points. On lattices, which twins are filled with, it is
    right within 2 %. Raises InputError for fewer than 8 points or points that coincide.
    """
    points = np.asarray(points, np.float64)
    if len(points) < DENSITY_NEIGHBOURS[0]:
        raise InputError(f"{len(points)} particles have no surface: at least {DENSITY_NEIGHBOURS[0]} are needed")
    counts = DENSITY_NEIGHBOURS[len(points) > DENSITY_NEIGHBOURS]
    counts = counts if len(counts) else np.array([len(points) - 1])
    distance, _ = cKDTree(points).query(points, k=int(counts.max()) + 1)
    volume = (4 / 3 * np.pi * distance[:, counts] ** 3 / (counts + 0.5)).mean(axis=1)
    spacing = float(np.cbrt(np.percentile(volume, INSIDE_PERCENTILE)))
    if spacing <= 0:
        raise InputError("particles coincide: they have no surface")
    return spacing


def velocities(positions: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Velocities (T, Q, 3) float32 [m/s] of ``positions`` (T, Q, 3) [m] at ``times`` (T,) [s].

    Second-order differences, one-sided at the ends; zero for a single frame.
    """
    if len(times) < 2:
        return np.zeros(positions.shape, np.float32)
    order = 2 if len(times) > 2 else 1
    return np.gradient(positions, times, axis=0, edge_order=order).astype(np.float32)


@dataclass(frozen=True)
class Deformation:
    """Deformation of neighbourhoods since frame 0. rest (Q, 3) [m]; index (Q, k) of the neighbours, itself included."""

    rest: np.ndarray
    index: np.ndarray

    @classmethod
    def since(cls, rest: np.ndarray) -> Deformation | None:
        """Neighbourhoods of particles ``rest`` (Q, 3) [m] at frame 0; None for particles that span no volume."""
        rest = np.asarray(rest, np.float64)
        if len(rest) <= NEIGHBOURS or np.linalg.matrix_rank(rest - rest.mean(axis=0)) < 3:
            return None
        return cls(rest, cKDTree(rest).query(rest, k=NEIGHBOURS + 1)[1])

    def gradients(self, positions: np.ndarray) -> np.ndarray:
        """Deformation gradients F (Q, 3, 3) [1] at ``positions`` (Q, 3) [m]: total, plastic flow included."""
        return local_gradients(self.rest[self.index], np.asarray(positions, np.float64)[self.index])


def volume_ratio(gradients: np.ndarray) -> np.ndarray:
    """J = det F (Q,) [1] of gradients (Q, 3, 3)."""
    return np.linalg.det(gradients)


def equivalent_strain(gradients: np.ndarray) -> np.ndarray:
    """Equivalent deviatoric Hencky strain sqrt(2/3) |dev ln V| (Q,) [1] of gradients (Q, 3, 3); NaN if F is singular.

    In a stretch at constant volume it is the axial strain.
    """
    stretches = np.linalg.svd(gradients, compute_uv=False)
    with np.errstate(divide="ignore", invalid="ignore"):
        log = np.log(stretches)
        size = np.linalg.norm(log - log.mean(axis=-1, keepdims=True), axis=-1)
    return np.where(np.isfinite(size), np.sqrt(2 / 3) * size, np.nan)
