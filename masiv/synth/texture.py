"""Colors as functions of a point: the same material point has the same color in every picture."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

MEAN = 0.53
"""Of the colors of a texture, about."""


def solid_color(kind: str, local: np.ndarray, seed: int, contrast: float = 1.0) -> np.ndarray:
    """Color (N, 3) in [0, 1] of points (N, 3), in units of the body's size; kinds: noise, stripes, patches.
    contrast: factor on the distance from ``MEAN``."""
    return (1 - contrast) * MEAN + contrast * _full_contrast(kind, local, seed)


def _full_contrast(kind: str, local: np.ndarray, seed: int) -> np.ndarray:
    rng = np.random.default_rng([seed, 1])
    if kind == "patches":
        seeds, colors = rng.uniform(-0.6, 0.6, (160, 3)), rng.uniform(0.12, 0.95, (160, 3))
        return colors[cKDTree(seeds).query(local)[1]]
    if kind == "stripes":
        along = local @ _directions(rng, 1, 5.0).T + 0.6 * _waves(rng, local, 6, 4.0)[:, :1]
        light, dark = rng.uniform(0.6, 0.95, 3), rng.uniform(0.1, 0.4, 3)
        share = 0.5 + 0.5 * np.tanh(3 * np.sin(2 * np.pi * along))
        return np.clip(dark + share * (light - dark) + 0.1 * _waves(rng, local, 8, 9.0), 0.05, 0.97)
    return np.clip(MEAN + 0.24 * _waves(rng, local, 6, 2.0) + 0.2 * _waves(rng, local, 10, 5.0), 0.05, 0.97)


def ground_color(points: np.ndarray, seed: int) -> np.ndarray:
    """Color (N, 3) of ground points (N, 3) [m]: grey with soft spots."""
    rng = np.random.default_rng([seed, 2])
    return 0.42 + 0.035 * _waves(rng, points, 12, 2.0).mean(axis=1, keepdims=True) + np.array([0.01, 0.0, -0.01])


def _waves(rng: np.random.Generator, points: np.ndarray, count: int, frequency: float) -> np.ndarray:
    """Sums of ``count`` plane waves of about ``frequency`` cycles a unit, one sum a color: (N, 3), of variance 1/2."""
    phases = [points @ _directions(rng, count, frequency).T + rng.uniform(size=count) for _ in range(3)]
    return np.stack([np.sin(2 * np.pi * phase).sum(axis=1) for phase in phases], axis=1) / np.sqrt(count)


def _directions(rng: np.random.Generator, count: int, frequency: float) -> np.ndarray:
    direction = rng.normal(size=(count, 3))
    return direction / np.linalg.norm(direction, axis=1, keepdims=True) * frequency * rng.uniform(0.6, 1.4, (count, 1))
