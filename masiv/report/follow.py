"""Gaussians that follow simulated particles, so that a simulation can be looked at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree

from masiv.errors import InputError
from masiv.splat.gaussians import Gaussians

NEIGHBOURS = 12
SHRINK = 0.1  # pulls the local affine map towards a rotation where the neighbours do not pin it down
SIZE_CHANGE = 2.0  # a Gaussian grows or shrinks at most by this factor


@dataclass(frozen=True)
class CarriedPoints:
    """Each point moves by the local affine map of its nearest particles (moving least squares, Schaefer 2006).

    points (N, 3) [m] at frame 0. rest: particles (Q, 3) [m] at frame 0. index, weight: (N, k) neighbours and their
    weights.
    """

    points: np.ndarray
    rest: np.ndarray
    index: np.ndarray
    weight: np.ndarray

    @classmethod
    def at_rest(cls, points: np.ndarray, particles: np.ndarray, what: str = "points") -> CarriedPoints:
        """Bind ``points`` to ``particles`` (Q, 3) [m], both at frame 0. Raises InputError for less than 4 particles."""
        points = np.asarray(points, dtype=np.float64)
        rest = np.asarray(particles, dtype=np.float64)
        if len(rest) < 4:
            raise InputError(f"{len(rest)} particles cannot carry {what}: at least 4 are needed")
        distance, index = cKDTree(rest).query(points, k=min(NEIGHBOURS, len(rest)))
        width = distance[:, -1:] + 1e-9
        weight = np.exp(-2.0 * (distance / width) ** 2)
        return cls(points, rest, index, weight / weight.sum(axis=1, keepdims=True))

    def moved(self, particles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points (N, 3) [m] and linear maps (N, 3, 3) when the particles are at ``particles`` (Q, 3) [m]."""
        near_rest = self.rest[self.index]
        near_now = np.asarray(particles, dtype=np.float64)[self.index]
        centre_rest = np.einsum("nk,nkd->nd", self.weight, near_rest)
        centre_now = np.einsum("nk,nkd->nd", self.weight, near_now)
        arm_rest, arm_now = near_rest - centre_rest[:, None], near_now - centre_now[:, None]
        spread = np.einsum("nk,nki,nkj->nij", self.weight, arm_rest, arm_rest)
        across = np.einsum("nk,nki,nkj->nij", self.weight, arm_now, arm_rest)
        ridge = SHRINK * np.trace(spread, axis1=1, axis2=2)[:, None, None] / 3
        affine = (across + ridge * _rotations(across)) @ np.linalg.inv(spread + ridge * np.eye(3))
        return centre_now + np.einsum("nij,nj->ni", affine, self.points - centre_rest), affine


@dataclass(frozen=True)
class Binding:
    """Gaussians at frame 0, and their means carried by particles."""

    gaussians: Gaussians
    carried: CarriedPoints

    @classmethod
    def at_rest(cls, gaussians: Gaussians, particles: np.ndarray) -> Binding:
        """Bind ``gaussians`` to ``particles`` (Q, 3) [m], both at frame 0."""
        return cls(gaussians, CarriedPoints.at_rest(gaussians.means.detach().numpy(), particles, "Gaussians"))

    def moved(self, particles: np.ndarray) -> Gaussians:
        """The Gaussians when the particles are at ``particles`` (Q, 3) [m]."""
        now, affine = self.carried.moved(particles)
        size = np.clip(np.cbrt(np.abs(np.linalg.det(affine))), 1 / SIZE_CHANGE, SIZE_CHANGE)
        like = self.gaussians.means
        return Gaussians(
            torch.from_numpy(now).to(like),
            self.gaussians.scales * torch.from_numpy(size).to(like),
            self.gaussians.opacities,
            self.gaussians.colours,
        )


def _rotations(across: np.ndarray) -> np.ndarray:
    """The rotation nearest to each 3×3 matrix of (N, 3, 3) (Kabsch)."""
    u, _, vt = np.linalg.svd(across)
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    return u @ vt
