"""Transformations of axes and of time. Conventions: docs/conventions.md."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from masiv.errors import InputError
from masiv.scene.scene import Ground

OPENGL_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def opengl_c2w_to_world_to_camera(camera_to_world: np.ndarray) -> np.ndarray:
    """OpenGL pose (x right, y up, looking along −z), (3, 4) or (4, 4) [m] -> OpenCV world_to_camera (4, 4) [m].

    The flip acts on the camera's side of the inverse, so t_x keeps its sign while t_y and t_z change theirs.
    Raises InputError for a pose that is not finite or whose rotation is not one.
    """
    pose = np.eye(4)
    given = np.asarray(camera_to_world, dtype=np.float64)
    if given.shape not in ((3, 4), (4, 4)):
        raise InputError(f"a camera pose has shape {given.shape}, it must be 3×4 or 4×4")
    pose[: given.shape[0]] = given
    if not np.isfinite(pose).all():
        raise InputError("a camera pose has a value that is not finite")
    rotation = pose[:3, :3]
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
        raise InputError("a camera pose's 3×3 part is not a rotation (scaled, sheared or mirrored axes)")
    inverse = np.eye(4)
    inverse[:3, :3] = rotation.T
    inverse[:3, 3] = -rotation.T @ pose[:3, 3]
    return OPENGL_TO_OPENCV @ inverse


def rotation_vector_to_world_to_camera(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """OpenCV's extrinsics, rotation vector (3,) [rad] and translation (3,) [m] -> world_to_camera (4, 4) [m]."""
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = cv2.Rodrigues(np.asarray(rotation, np.float64).reshape(3))[0]
    world_to_camera[:3, 3] = np.asarray(translation, np.float64).reshape(3)
    return world_to_camera


@dataclass(frozen=True)
class TimeGrid:
    """Frames at even times: frame k is at ``first + k step``, in the unit of the times that it was made from.

    ``fps``: frames per second. ``tolerance``: largest distance of a time from its frame [frames].
    """

    first: float
    step: float
    count: int
    fps: float
    tolerance: float

    def frame(self, time: float) -> int | None:
        """The frame at ``time``, or None if that is between two frames or outside of the grid."""
        position = (time - self.first) / self.step
        k = round(position)
        return k if 0 <= k < self.count and abs(position - k) <= self.tolerance else None

    @classmethod
    def from_times(cls, times: Sequence[float], names: Sequence[str], fps: float | None = None) -> TimeGrid:
        """The grid of ``times`` [s]; ``names`` are those of their pictures, for messages.

        Times must be even within 1 % of a frame. If ``fps`` is declared, the times can have any unit and can be rounded
        (25 % of a frame). Raises InputError that names a picture for times that are not even.
        """
        order = np.argsort(times, kind="stable")
        ordered = np.asarray(times, np.float64)[order]
        gaps: np.ndarray = np.diff(ordered)
        if not len(gaps) or gaps.max() <= 0:
            raise InputError(f"{names[0]}: all pictures have the same time, a motion needs two or more")
        # Times of one instant can differ by jitter: a new instant begins after a gap.
        starts: np.ndarray = np.concatenate([[0], 1 + np.flatnonzero(gaps > 0.025 * gaps.max())]).astype(int)
        instants = np.array([np.median(group) for group in np.split(ordered, starts[1:])])
        spacing: np.ndarray = np.diff(instants)
        usual = np.median(spacing)
        index = np.concatenate([[0], np.cumsum(np.maximum(np.round(spacing / usual), 1))]).astype(int)
        step = (instants[-1] - instants[0]) / index[-1]
        of_each = np.repeat(index, np.diff(np.append(starts, len(ordered))))
        tolerance = 0.01 if fps is None else 0.25
        first = instants[0]
        away = np.abs((ordered - first) / step - of_each)
        if away.max() > tolerance:
            uneven = np.abs(spacing / usual - 1)
            worst = starts[1 + int(uneven.argmax())] if uneven.max() > tolerance else int(away.argmax())
            raise InputError(
                f"{names[order[worst]]} has time {ordered[worst]:g}, {ordered[worst] - ordered[worst - 1]:g} after the "
                f"time before it, where {usual:g} is usual: times must be even within {tolerance:.0%} of a frame; "
                "correct them" + ("" if fps else ", or give fps in scene.yaml if they are only rounded")
            )
        if index[-1] >= len(instants):
            gap = int(np.flatnonzero(np.diff(index) > 1)[0])
            before, after = (names[int(order[k])] for k in starts[gap : gap + 2])
            raise InputError(
                f"no view has a picture at frame {index[gap] + 1}, between {before} and {after}: "
                "frames must run without gaps"
            )
        rate = fps or round_if_close(1 / step)
        return cls(float(first), float(step), len(instants), float(rate), tolerance)


def round_if_close(fps: float) -> float:
    """``fps``, rounded to an integer if that changes it by less than 0.1 %: files give times with few digits."""
    return float(round(fps)) if abs(fps - round(fps)) < 1e-3 * fps else float(fps)


MAX_GAP_FACTOR = 100
"""Frames without a picture are interpolated; a recording of which fewer than one frame in so many has one is none."""


def count_frames(frames: Collection[int], where: str) -> int:
    """The number of frames 0 … of a recording with pictures at ``frames``. Raises InputError if it is no motion, or if
    the numbers are no frames, for example time stamps."""
    if len(frames) < 2:
        raise InputError(f"{where} has one frame only: a motion needs two or more")
    last = max(frames)
    if last >= MAX_GAP_FACTOR * len(frames):
        raise InputError(
            f"{where}: frame numbers go up to {last}, but only {len(frames)} frames have pictures, as if they were "
            "time stamps: number the frames 0, 1, 2, …"
        )
    return last + 1


def frame_of_time(time: float, fps: float) -> int:
    """The frame at ``time`` [s], rounded: truncation is one frame early at k = 5, 7, 10 … for 24 fps in float32."""
    return round(float(time) * fps)


@dataclass(frozen=True)
class SimulationFrame:
    """The simulator's axes: +y up, ground plane at y = 0. x_simulation = rotation x_world + translation.

    rotation: (3, 3) float64, translation: (3,) float64 [m]. Methods take arrays (..., 3) and keep shape and float type.
    """

    rotation: np.ndarray
    translation: np.ndarray

    @classmethod
    def from_scene(cls, up: np.ndarray, ground: Ground | None) -> SimulationFrame:
        """The smallest rotation that maps the ground's normal (``up`` without a ground) to +y. Raises InputError."""
        axis = np.asarray(up if ground is None else ground.normal, dtype=np.float64)
        length = np.linalg.norm(axis)
        if not np.isfinite(length) or length < 1e-12:
            raise InputError(
                "the up axis or the ground's normal has no direction: give a finite vector that is not zero"
            )
        height = 0.0 if ground is None else ground.height
        return cls(_rotation_to_y(axis / length), np.array([0.0, -height, 0.0]))

    def points_to_simulation(self, points: np.ndarray) -> np.ndarray:
        """World points (..., 3) [m] -> simulation points."""
        points = np.asarray(points)
        return _as_float(points @ self.rotation.T + self.translation, points)

    def points_to_world(self, points: np.ndarray) -> np.ndarray:
        """Simulation points (..., 3) [m] -> world points."""
        points = np.asarray(points)
        return _as_float((points - self.translation) @ self.rotation, points)

    def vectors_to_simulation(self, vectors: np.ndarray) -> np.ndarray:
        """World vectors (..., 3), such as velocities, spins and gravity -> simulation vectors."""
        vectors = np.asarray(vectors)
        return _as_float(vectors @ self.rotation.T, vectors)

    def vectors_to_world(self, vectors: np.ndarray) -> np.ndarray:
        """Simulation vectors (..., 3) -> world vectors."""
        vectors = np.asarray(vectors)
        return _as_float(vectors @ self.rotation, vectors)


def _rotation_to_y(unit: np.ndarray) -> np.ndarray:
    target = np.array([0.0, 1.0, 0.0])
    cosine = float(unit @ target)
    if cosine < -1.0 + 1e-4:
        # At −y the smallest rotation is not unique, and near it ill-conditioned: first half a turn about x.
        half_turn = np.diag([1.0, -1.0, -1.0])
        return _rotation_to_y(half_turn @ unit) @ half_turn
    cross = np.cross(unit, target)
    skew = np.array([[0, -cross[2], cross[1]], [cross[2], 0, -cross[0]], [-cross[1], cross[0], 0]])
    return np.eye(3) + skew + skew @ skew / (1.0 + cosine)


def _as_float(result: np.ndarray, like: np.ndarray) -> np.ndarray:
    return result.astype(like.dtype, copy=False) if np.issubdtype(like.dtype, np.floating) else result
