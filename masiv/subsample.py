"""Few particles, or frames, that stand for many."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

T = TypeVar("T")


def evenly_spread(values: Sequence[T], count: int) -> list[T]:
    """``count`` of ``values``, at least one, in their order, with the first and the last; all if there are no more."""
    if len(values) <= count:
        return list(values)
    return [values[k] for k in np.linspace(0, len(values) - 1, max(count, 1)).round().astype(int)]


def random_subset(total: int, count: int, seed: int) -> np.ndarray:
    """Indices, ascending, of ``count`` of ``total`` particles drawn at random, of all where there are no more."""
    if count >= total:
        return np.arange(total)
    return np.sort(np.random.default_rng(seed).choice(total, count, replace=False))


def kd_tree_subset(points: np.ndarray, count: int) -> np.ndarray:
    """Indices (count,), ascending, of those of the ``points`` (N, 3) that stand for all (all where there are no more):
    the body is cut across its longest side into halves of as many points, these again, down to ``count`` parts (a k-d
    tree), and the point nearest to the mean of each is taken.

    Points that are drawn at random are another body: 800 of 4000 have their centre of mass millimetres away and
    turn about other axes, which no law or initial state makes up for.
    """
    if count >= len(points):
        return np.arange(len(points))
    chosen = []
    parts = [(np.arange(len(points)), count)]
    while parts:
        of, wanted = parts.pop()
        here = points[of]
        if wanted == 1:
            chosen.append(of[np.argmin(((here - here.mean(0)) ** 2).sum(1))])
            continue
        order = of[np.argsort(here[:, np.argmax(np.ptp(here, axis=0))], kind="stable")]
        first = wanted // 2
        cut = round(len(of) * first / wanted)
        parts += [(order[:cut], first), (order[cut:], wanted - first)]
    return np.sort(np.array(chosen))
