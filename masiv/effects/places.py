"""Places in a body: their parameters, weights around one, and a few that cover a cloud of points."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import cKDTree

from masiv.effects.context import EffectParameter

NEWTON_STEPS = 8
MIN_VARIANCE = 0.02
"""Added to the variances, over radius^2: keeps Newton's step finite if the weights are flat against a surface."""
MAX_DISTANCE = 4.0
"""Largest distance, in radii, of the Gaussian's centre from its mean."""
PLACE = tuple(EffectParameter(axis, "m", -100.0, 100.0, 0.02) for axis in "xyz")


def square_distance(points: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
    """Square distances (N,) [m^2] of points (N, 3) from a place (3,)."""
    return (points - place).square().sum(1)


def weights_around(points: torch.Tensor, place: torch.Tensor, radius: float) -> torch.Tensor:
    r"""Weights (N,), $w_p \propto e^{-|x_p - c|^2 / (2 r^2)}$ with sum 1 and mean ``place``; differentiable.

    points (N, 3) [m]; place (3,) [m]; radius r [m]. The centre c is solved for by Newton's method on the dual of the
    maximum-entropy problem with that mean. It stays within ``MAX_DISTANCE`` radii of the place: for a place at the face
    of a body the weights lie in its outermost points.
    """
    points, place = points.double(), place.double()
    tilt, eye = torch.zeros_like(place), torch.eye(3, dtype=points.dtype)

    def weights() -> torch.Tensor:
        centre = place + tilt / torch.sqrt(1 + (tilt / (MAX_DISTANCE * radius)).square().sum())
        return torch.softmax(-0.5 * square_distance(points, centre) / radius**2, 0)

    for _ in range(NEWTON_STEPS):
        now = weights()
        mean = (now[:, None] * points).sum(0)
        off = points - mean
        wide = (now[:, None, None] * off[:, :, None] * off[:, None, :]).sum(0) / radius**2
        tilt = tilt + torch.linalg.solve(wide + MIN_VARIANCE * eye, place - mean)
    return weights()


def tied_weights(points: torch.Tensor, place: torch.Tensor, radius: float) -> torch.Tensor:
    r"""Weights (N,), of either sign, with sum 1 and mean ``place``, also at a face: ``weights_around`` times
    $1 + (x_p - m) \cdot A^{-1} (c - m)$, with its mean m and covariance A.

    A force that is shared out by them has the moment of one at ``place``, and their mean motion is that of ``place``
    if the body deforms uniformly there (moving least squares, Lancaster & Salkauskas 1981). points (N, 3) [m]; place c
    (3,) [m]; radius [m].
    """
    points, place = points.double(), place.double()
    weights = weights_around(points, place, radius)
    mean = (weights[:, None] * points).sum(0)
    off = points - mean
    covariance = (weights[:, None, None] * off[:, :, None] * off[:, None, :]).sum(0)
    flat = 1e-9 * radius**2 * torch.eye(3, dtype=points.dtype)  # all points in a plane
    return weights * (1 + off @ torch.linalg.solve(covariance + flat, place - mean))


def spacing_of(points: torch.Tensor) -> float:
    """Distance [m] from a point of (N, 3) to the nearest other one, median."""
    known = points.double().numpy()
    return float(np.median(cKDTree(known).query(known, k=2)[0][:, 1]))


def face_centres(points: torch.Tensor) -> torch.Tensor:
    """Means (6, 3) of the outermost points of (N, 3) at either end of each axis."""
    low, high = points.min(0).values, points.max(0).values
    out = []
    for axis in range(3):
        reach = 0.02 * (high - low)[axis] + 1e-9
        out += [points[points[:, axis] <= low[axis] + reach].mean(0)]
        out += [points[points[:, axis] >= high[axis] - reach].mean(0)]
    return torch.stack(out)


def farthest_points(points: torch.Tensor, count: int) -> torch.Tensor:
    """At most ``count`` of the points (N, 3) by farthest-point sampling; the first is farthest from their mean."""
    chosen = [points[square_distance(points, points.mean(0)).argmax()]]
    nearest = square_distance(points, chosen[0])
    while len(chosen) < count and nearest.max() > 0:
        chosen.append(points[nearest.argmax()])
        nearest = torch.minimum(nearest, square_distance(points, chosen[-1]))
    return torch.stack(chosen)


def cluster_centres(points: torch.Tensor, count: int, rounds: int = 10) -> torch.Tensor:
    """Means (K, 3), K at most ``count``, of clusters of the points (N, 3) (k-means by Lloyd's algorithm)."""
    middles = farthest_points(points, count)
    for _ in range(rounds):
        part = torch.cdist(points, middles).argmin(1)
        middles = torch.stack([points[part == k].mean(0) for k in range(len(middles)) if (part == k).any()])
    return middles


def as_guesses(places: torch.Tensor, *more: float) -> list[tuple[float, ...]]:
    """Places (K, 3) as values of parameters, each followed by ``more``."""
    return [(*place, *more) for place in places.double().tolist()]
