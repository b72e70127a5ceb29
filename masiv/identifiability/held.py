"""Whether something that a scene does not declare holds or supports a body: its path against what gravity and the
medium allow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import chi2
from scipy.stats import t as student

from masiv.identifiability.fall import MAX_FACTOR
from masiv.identifiability.verdict import mm

FALSE_ALARM = 1e-3
"""Probability, at most, that a body which only gravity and the medium move is said to be held, for each recording and
independent noise (``tests/test_held.py`` counts it)."""
SLACK = 1 - 1 / MAX_FACTOR
"""Part of the weight that a wrong frame rate or unit may seem to carry: ``masiv.identifiability.fall`` names these."""
SHORTEST = 5
"""Frames of a window: a parabola and two degrees of freedom."""
VALUES_A_DEGREE = 6
"""Values of a path for a degree of freedom of its noise: a median of third differences is worth about a sixth of
independent residuals (its efficiency is 0.37, and neighbours are correlated)."""
MISFIT = 1e-3
"""Probability below which distances from a pivot are not constant."""
MAX_RADIUS_ERROR = 0.1
"""Relative standard error of a thread's length above which no pivot is named. Chosen."""


@dataclass(frozen=True)
class MediumForce:
    """The largest force per mass [m/s²] of a medium at rest on a body of speed u [m/s]: ``buoyancy`` [m/s²] +
    ``linear`` [1/s] u + ``quadratic`` [1/m] u²."""

    buoyancy: float
    linear: float
    quadratic: float

    def most(self, speed: float) -> float:
        """[m/s²] at ``speed`` [m/s]."""
        return self.buoyancy + self.linear * speed + self.quadratic * speed**2


@dataclass(frozen=True)
class Pivot:
    """A point (3,) [m] from which the body keeps the distance ``radius`` [m], with its standard error [m]."""

    place: np.ndarray
    radius: float
    radius_std: float


@dataclass(frozen=True)
class Held:
    """From ``start`` to ``stop`` [s] something carries the part ``carried`` of the weight on average, with the standard
    error ``carried_std``. pivot: None if the distance from no point stays the same."""

    start: float
    stop: float
    carried: float
    carried_std: float
    pivot: Pivot | None

    def sentence(self) -> str:
        """What was found, and what to do."""
        found = (
            f"from {self.start:.3g} to {self.stop:.3g} s it is held or supported by something that is not declared, "
            f"which carries {100 * self.carried:.0f} ± {max(100 * self.carried_std, 0.5):.0f} % of its weight"
        )
        if self.pivot is not None:
            x, y, z = self.pivot.place
            found += (
                f": it keeps {self.pivot.radius:.4g} m ± {mm(self.pivot.radius_std)} from ({x:.3g}, {y:.3g}, {z:.3g}) "
                "m, as on a thread or a pivot"
            )
        return f"{found}; no force that is found in this motion is one of the surroundings: declare what holds it " \
            "(clamp, ground), or leave these frames out (rest_frames, time)"  # fmt: skip


def held(
    times: np.ndarray, points: np.ndarray, std: float, usable: np.ndarray, gravity: np.ndarray, medium: MediumForce
) -> Held | None:
    """Whether the motion contradicts that only gravity and the medium act, while ``usable``.

    times (T,) [s]; points (T, M, 3) [m], known to ``std`` [m] an axis, whose convex hull contains the centre of mass;
    usable (T,) bool: no declared contact; gravity (3,) [m/s²].

    A least-squares parabola over a window gives a mean of the acceleration with weights that are positive (its Peano
    kernel is), so without support the upward part is −g and what the medium adds at the largest speed, at most. The
    point that falls fastest bounds the centre of mass. Windows of 5, 10, 20, … frames, each moved by half of its
    length, share ``FALSE_ALARM`` (Bonferroni).
    """
    strength = float(np.linalg.norm(gravity))
    windows = [w for first, stop in _stretches(usable) for w in _windows(first, stop)]
    if strength == 0 or not windows:
        return None
    freedom = max(points[:, 0].size / VALUES_A_DEGREE, 3.0)
    limit = float(student.isf(FALSE_ALARM / len(windows), freedom))
    up = -gravity / strength
    found: list[tuple[float, slice]] = []
    for window in windows:
        fall, error, speed = _upward(times[window], points[window], std, up, limit)
        excess = fall + strength * (1 - SLACK) - medium.most(speed)
        if excess > limit * error:
            found.append((excess / error, window))
    if not found:
        return None
    stretch = _joined(found)
    fall, error, _ = _upward(times[stretch], points[stretch], std, up, limit)
    where = _pivot(points[stretch].mean(axis=1), std / np.sqrt(points.shape[1]), up)
    start, stop = float(times[stretch][0]), float(times[stretch][-1])
    return Held(start, stop, (fall + strength) / strength, error / strength, where)


def _stretches(usable: np.ndarray) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], usable, [False]]).astype(int)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _windows(first: int, stop: int) -> list[slice]:
    out, count = [], SHORTEST
    while count <= stop - first:
        out += [slice(k, k + count) for k in range(first, stop - count + 1, max(count // 2, 1))]
        count *= 2
    return out


def _upward(
    times: np.ndarray, points: np.ndarray, std: float, up: np.ndarray, limit: float
) -> tuple[float, float, float]:
    """Least mean acceleration upwards [m/s²] of the points, its standard error, and their largest speed [m/s] with
    ``limit`` standard errors."""
    t = times - times.mean()
    basis = np.stack([np.ones_like(t), t, 0.5 * t**2], axis=1)
    inverse = np.linalg.inv(basis.T @ basis)
    flat = points.reshape(len(t), -1)
    fitted = inverse @ basis.T @ flat
    left = flat - basis @ fitted
    # A smooth error is larger than it looks from frame to frame.
    spread = max(std, float(np.sqrt((left**2).sum() / ((len(t) - 3) * max(np.any(left, axis=0).sum(), 1)))))
    fall = (fitted[2].reshape(-1, 3) @ up).min()
    ends = [np.linalg.norm((fitted[1] + fitted[2] * s).reshape(-1, 3), axis=1).max() for s in (t[0], t[-1])]
    stride = max(len(t) // 4, 1)
    ways = np.linalg.norm(points[stride:] - points[:-stride], axis=2).max(axis=1)
    chords = (ways / (times[stride:] - times[:-stride])).max()
    slope = float(np.sqrt(inverse[1, 1])) * std
    return float(fall), float(np.sqrt(inverse[2, 2])) * spread, float(max(*ends, chords)) + limit * slope


def _joined(found: list[tuple[float, slice]]) -> slice:
    """The overlapping windows about the clearest one."""
    first, stop = max(found, key=lambda pair: pair[0])[1].start, max(found, key=lambda pair: pair[0])[1].stop
    grown = True
    while grown:
        near = [w for _, w in found if w.start <= stop and w.stop >= first]
        low, high = min(w.start for w in near), max(w.stop for w in near)
        grown = (low, high) != (first, stop)
        first, stop = low, high
    return slice(first, stop)


def _pivot(path: np.ndarray, std: float, up: np.ndarray) -> Pivot | None:
    """The point from which ``path`` (T, 3) [m], known to ``std`` [m], keeps its distance within the noise, above it. In
    the plane of the path if it has one."""
    middle = path.mean(axis=0)
    _, sizes, axes = np.linalg.svd(path - middle, full_matrices=False)
    # Noise alone leaves std sqrt(T) of a direction, with a relative scatter of 1/sqrt(2 T).
    dimensions = int((sizes > std * np.sqrt(len(path)) * (1 + 4 / np.sqrt(2 * len(path)))).sum())
    if dimensions < 2:
        return None
    flat = (path - middle) @ axes[:dimensions].T
    linear = np.concatenate([2 * flat, np.ones((len(flat), 1))], axis=1)
    start = np.linalg.lstsq(linear, (flat**2).sum(axis=1), rcond=None)[0]
    radius = float(np.sqrt(max(start[-1] + (start[:-1] ** 2).sum(), 0.0)))

    def off(values: np.ndarray) -> np.ndarray:
        return (np.linalg.norm(flat - values[:-1], axis=1) - values[-1]) / std

    best = least_squares(off, [*start[:-1], radius])
    freedom = len(flat) - len(best.x)
    if freedom < 1 or chi2.sf(float((best.fun**2).sum()), freedom) < MISFIT:
        return None
    normal = best.jac.T @ best.jac
    if np.linalg.matrix_rank(normal) < len(normal):
        return None
    error, radius = float(np.sqrt(np.linalg.inv(normal)[-1, -1])), float(best.x[-1])
    place = middle + best.x[:-1] @ axes[:dimensions]
    if error > MAX_RADIUS_ERROR * radius or (place - middle) @ up <= 0:
        return None
    return Pivot(place, radius, error)
