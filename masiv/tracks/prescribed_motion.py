"""The path of a clamp that is carried: a rigid motion that its markers show. Light: no torch, no taichi."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicSpline, make_smoothing_spline
from scipy.spatial.transform import Rotation, RotationSpline

from masiv.errors import InputError
from masiv.tracks.placement import best_rigid
from masiv.tracks.tracks import Clamp, Run

FEWEST_INSTANTS = 5
"""A smoothing spline needs so many."""
MIN_SPREAD = 0.05
"""Second singular value of the markers' places over the first, from which on they show a rotation: fewer than three, or
three on a line, show a displacement alone."""


@dataclass(frozen=True)
class Segment:
    """A part of a path, from ``start`` to ``stop`` [s], world axes.

    position (4, 3): of what was at the centre, the sum of position[k] (t - start)^k [m]. rotation (3, 3): from rest to
    the middle of the segment; omega (3,) [rad/s]: angular velocity there.
    """

    start: float
    stop: float
    position: np.ndarray
    rotation: np.ndarray
    omega: np.ndarray


@dataclass(frozen=True)
class PrescribedMotion:
    r"""A rigid motion $x(t) = R(t) (x_0 - c) + c + d(t)$ over time since the release, world axes; at rest at its end.

    times (K,) [s], ascending from 0; centre c (3,) [m]; displacement d (K, 3) [m] and rotation (K, 3), the rotation
    vectors of R [rad], at ``times``. In between d is a cubic spline, and R a spline of rotations with a continuous
    angular acceleration (``scipy.spatial.transform.RotationSpline``).
    """

    times: np.ndarray
    centre: np.ndarray
    displacement: np.ndarray
    rotation: np.ndarray

    @cached_property
    def _path(self) -> CubicSpline:
        return CubicSpline(self.times, self.displacement)

    @cached_property
    def _turn(self) -> RotationSpline | None:
        """None if nothing turns."""
        return RotationSpline(self.times, Rotation.from_rotvec(self.rotation)) if np.any(self.rotation) else None

    def at(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotations (T, 3, 3) and displacements (T, 3) [m] at ``times`` (T,) [s]; beyond the last one it rests."""
        t = np.clip(times, self.times[0], self.times[-1])
        turned = np.tile(np.eye(3), (len(t), 1, 1)) if self._turn is None else self._turn(t).as_matrix()
        return turned, self._path(t)

    def moved(self, points: np.ndarray, times: np.ndarray) -> np.ndarray:
        """Points (M, 3) [m] that are fixed to the clamp, at rest -> (T, M, 3) at ``times`` (T,) [s]."""
        turned, displacement = self.at(times)
        return np.einsum("tij,mj->tmi", turned, points - self.centre) + self.centre + displacement[:, None]

    def segments(self, last: float) -> tuple[Segment, ...]:
        """What covers 0 to ``last`` [s]: a segment between two of ``times``, and rest after them."""
        out = []
        for k, (start, stop) in enumerate(zip(self.times[:-1], self.times[1:], strict=True)):
            if start >= last:
                break
            position = self._path.c[::-1, k].copy()  # ascending powers
            position[0] += self.centre
            middle = np.array([0.5 * (start + stop)])
            turned = self.at(middle)[0][0]
            omega = np.zeros(3) if self._turn is None else turned @ self._turn(middle, 1)[0]  # it gives body axes
            out.append(Segment(float(start), float(stop), position, turned, omega))
        if last > self.times[-1]:
            turned, displacement = self.at(self.times[-1:])
            position = np.zeros((4, 3))
            position[0] = self.centre + displacement[0]
            out.append(Segment(float(self.times[-1]), float(last), position, turned[0], np.zeros(3)))
        return tuple(out)


def prescribed_motions(run: Run, clamps: tuple[Clamp, ...]) -> tuple[PrescribedMotion | None, ...]:
    """``prescribed_motion`` of each of ``clamps``; () if all are fixed."""
    return tuple(prescribed_motion(run, clamp) for clamp in clamps) if any(c.prescribed for c in clamps) else ()


def prescribed_motion(run: Run, clamp: Clamp) -> PrescribedMotion | None:
    """How the markers of ``clamp`` carry it in ``run``, from its release on; None for one that is fixed.

    Each coordinate of a marker is a smoothing spline (its penalty by generalised cross-validation) through the frames
    that show it; the path is the rigid motion nearest to the markers in each frame (Kabsch 1976), or their mean
    displacement if they do not show a rotation. Raises InputError if no marker shows it.
    """
    if not clamp.prescribed:
        return None
    # Frames at rest tell how the path begins.
    shown = run if run.rest is None else run.between(float(run.times[run.rest.start]), np.inf)
    times = shown.elapsed
    after = times >= 0
    chosen = [m for m, name in enumerate(run.markers) if name in clamp.markers and np.isfinite(run.at_rest[m]).all()]
    paths = []
    for m in chosen:
        seen = np.asarray(np.isfinite(shown.positions[:, m]).all(axis=1))
        if (seen & after).sum() < FEWEST_INSTANTS or not (seen[after][0] and seen[-1]):
            continue
        splines = [make_smoothing_spline(times[seen], shown.positions[seen, m, a]) for a in range(3)]
        paths.append((m, np.stack([spline(times[after]) for spline in splines], axis=1)))
    if not paths:
        raise InputError(
            f"run {run.name}: no marker of the clamp, which is said to move, is seen at rest, in the first and the "
            f"last frame of the motion and in {FEWEST_INSTANTS} frames: name one in clamp.markers, or shorten time"
        )
    rest = run.at_rest[[m for m, _ in paths]]
    markers, times = np.stack([path for _, path in paths], axis=1), times[after]
    if times[0] > 0:  # let go between two frames
        times, markers = np.insert(times, 0, 0.0), np.concatenate([rest[None], markers])
    else:  # the path begins at rest, not beside it by the noise
        markers = markers - markers[0] + rest
    centre = rest.mean(axis=0)
    spread = np.linalg.svd(rest - centre, compute_uv=False)
    rotation = np.zeros((len(times), 3))
    if len(rest) > 2 and spread[1] > MIN_SPREAD * spread[0]:
        rotation = np.stack([Rotation.from_matrix(best_rigid(rest, now).rotation).as_rotvec() for now in markers])
    return PrescribedMotion(times, centre, markers.mean(axis=1) - centre, rotation)
