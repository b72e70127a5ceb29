"""Places: their parameters, a bump around one, and a few that cover a cloud of points."""

from __future__ import annotations

import torch

from masiv.effects.effect import EffectParameter

PLACE = tuple(EffectParameter(axis, "m", -100.0, 100.0, 0.02) for axis in "xyz")


def square_distance(points: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
    """(N,) [m^2] of points (N, 3) from a place (3,)."""
    return (points - place).square().sum(1)


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
