"""Places: their parameters, a bump around one, and a few that cover a cloud of points."""

from __future__ import annotations

import torch

from masiv.effects.effect import EffectParameter

NEWTON_STEPS = 8
FLAT = 0.02
"""Variance, over radius^2, below which a distribution counts as flat against a surface."""
BEYOND = 4.0
PLACE = tuple(EffectParameter(axis, "m", -100.0, 100.0, 0.02) for axis in "xyz")


def square_distance(points: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
    """(N,) [m^2] of points (N, 3) from a place (3,)."""
    return (points - place).square().sum(1)


def shares(points: torch.Tensor, place: torch.Tensor, radius: float) -> torch.Tensor:
    """(N,) that sum up to 1, of something that is spread as exp(-|X - c|^2 / (2 radius^2)) over the points (N, 3).

    c is such that its mean is the ``place`` (3,) (Newton's method on the dual of the distribution of greatest entropy
    with that mean), but no farther from it than BEYOND: at the face of a body it is in the outermost points, and over
    the radius along them. Differentiable.
    """
    points, place = points.double(), place.double()
    tilt, eye = torch.zeros_like(place), torch.eye(3, dtype=points.dtype)

    def share() -> torch.Tensor:
        centre = place + tilt / torch.sqrt(1 + (tilt / (BEYOND * radius)).square().sum())
        return torch.softmax(-0.5 * square_distance(points, centre) / radius**2, 0)

    for _ in range(NEWTON_STEPS):
        now = share()
        mean = (now[:, None] * points).sum(0)
        off = points - mean
        wide = (now[:, None, None] * off[:, :, None] * off[:, None, :]).sum(0) / radius**2
        tilt = tilt + torch.linalg.solve(wide + FLAT * eye, place - mean)
    return share()


def faces(points: torch.Tensor) -> torch.Tensor:
    """Middles (6, 3) of the outermost points (N, 3) along each axis, either way."""
    low, high = points.min(0).values, points.max(0).values
    out = []
    for axis in range(3):
        reach = 0.02 * (high - low)[axis] + 1e-9
        out += [points[points[:, axis] <= low[axis] + reach].mean(0)]
        out += [points[points[:, axis] >= high[axis] - reach].mean(0)]
    return torch.stack(out)


def spread(points: torch.Tensor, count: int) -> torch.Tensor:
    """At most ``count`` of the points (N, 3), each as far from the others as can be; the first is farthest out."""
    chosen = [points[square_distance(points, points.mean(0)).argmax()]]
    nearest = square_distance(points, chosen[0])
    while len(chosen) < count and nearest.max() > 0:
        chosen.append(points[nearest.argmax()])
        nearest = torch.minimum(nearest, square_distance(points, chosen[-1]))
    return torch.stack(chosen)


def cover(points: torch.Tensor, count: int, rounds: int = 10) -> torch.Tensor:
    """Middles (K, 3), K at most ``count``, of compact parts into which the points (N, 3) fall (Lloyd's algorithm)."""
    middles = spread(points, count)
    for _ in range(rounds):
        part = torch.cdist(points, middles).argmin(1)
        middles = torch.stack([points[part == k].mean(0) for k in range(len(middles)) if (part == k).any()])
    return middles


def as_guesses(places: torch.Tensor, *more: float) -> list[tuple[float, ...]]:
    """Places (K, 3) as values of parameters, each followed by ``more``."""
    return [(*place, *more) for place in places.double().tolist()]
