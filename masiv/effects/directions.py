"""A direction in a body: two numbers that are regular about every axis, and a few directions to try."""

from __future__ import annotations

import math

import torch

from masiv.effects.context import EffectParameter

INCLINATION = tuple(EffectParameter(f"inclination_{axis}", "rad", -2.0, 2.0, 0.1) for axis in "xz")
"""The horizontal vector whose length is the angle from the vertical (y) to the direction, and which points the way that
it leans. A direction and its opposite mean the same to the effects that have one: an angle of pi is never needed."""
TINY = 1e-12
"""[rad^2]: keeps the derivative at the vertical finite."""
HALF = math.pi / 2
AXES = ((HALF, 0.0), (0.0, 0.0), (0.0, HALF))
"""Inclinations of the axes x, y and z."""
DIAGONALS = (
    *((sign * HALF / 2, 0.0) for sign in (-1, 1)),
    *((0.0, sign * HALF / 2) for sign in (-1, 1)),
    *((HALF / math.sqrt(2), sign * HALF / math.sqrt(2)) for sign in (-1, 1)),
)
"""Inclinations of the six directions halfway between two axes."""


def direction(inclination: torch.Tensor) -> torch.Tensor:
    """Unit vector (3,) of an ``INCLINATION`` (2,) [rad]; differentiable."""
    angle = torch.sqrt(inclination.square().sum() + TINY)
    across = torch.sin(angle) / angle * inclination
    return torch.stack([across[0], torch.cos(angle), across[1]])


def inclination_of(unit: torch.Tensor) -> tuple[float, float]:
    """The inclination [rad] of a unit vector (3,) or its opposite, whichever leans less."""
    x, y, z = (unit if unit[1] >= 0 else -unit).tolist()
    across = math.hypot(x, z)
    factor = math.atan2(across, y) / across if across > 0 else 0.0
    return factor * x, factor * z


def longest_axis(points: torch.Tensor) -> torch.Tensor:
    """Unit vector (3,) along which points (N, 3) spread most (principal axis)."""
    return torch.linalg.svd((points - points.mean(0)).double(), full_matrices=False)[2][0]
