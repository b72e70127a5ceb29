"""How much earlier or later than the others each camera took its pictures, from silhouettes alone.

The planes that touch the object turn about the baseline of two cameras while it moves, and both cameras see them at the
same angle at the same time (``frontier``). A clock that is late shows the angles of another time. Half frames are
searched; the rest follows from the adjustment of all cameras (``from_silhouettes``), in which an error of pose or focal
length competes with the clock: it is about the same at all frames, the error of a clock follows the speed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from masiv.calibration.config import CalibrationPrior
from masiv.calibration.consistency import Consistency
from masiv.calibration.from_silhouettes import MAX_FRAMES, SilhouetteFit, fit_silhouettes
from masiv.calibration.frontier import Outlines, tangent_angles
from masiv.calibration.gauge import displacement_jacobian
from masiv.calibration.outline_points import outline_points
from masiv.calibration.tangency import Outline
from masiv.scene.camera import Camera
from masiv.scene.scene import Scene

LONGEST_SHIFT = 48  # frames, and a third of the recording at most: the rest must overlap
CLEAR_GAIN = 1.3
"""By which a shift must lessen the disagreement of a camera. Chosen: one that is late by more than a frame gains a
factor of two or more by the nearest half, one that is right gains nothing."""
REFITS = 3  # a fit from the nearest frame ends within half a frame of it: more are needed if the search was off
FEWEST_FRAMES = 4  # with fewer, a clock cannot be told from a pose
MIN_Z = 5.0
"""Standard errors from which a clock is off. 280 recordings of 3 to 11 cameras with right clocks and wrong poses: the
largest of a recording was below 4.5 in 95 %, and 6.6 once, at a fifth of a pixel
(``benchmarks/inspect_calibration.py``)."""
MIN_MOVE_PX = 1.0
"""Motion of the object in the picture during an offset below which it does not matter: outlines are known no better."""
BROAD_PRIOR = CalibrationPrior(rotation_deg=2.0, translation_fraction=0.02, focal_fraction=0.03, time_frames=3.0)
"""Errors that ``inspect`` should find are larger than those that a fit corrects, of poses too: a pose that may not move
would look like a clock. How far silhouettes disagree limits all of it further (``gauge.scaled_deviations``)."""


@dataclass(frozen=True)
class Clocks:
    """Of the V cameras ``views``: offsets (V,) [s] against the median camera, positive if its pictures show a later
    time than they say; standard_errors (V,) [s]; moves_px (V,): how far the object moves in the picture during the
    offset (RMS)."""

    views: tuple[int, ...]
    offsets: np.ndarray
    standard_errors: np.ndarray
    moves_px: np.ndarray

    @property
    def z(self) -> np.ndarray:
        """Offsets (V,) in standard errors."""
        return self.offsets / self.standard_errors


def clocks(
    views: tuple[int, ...], cameras: Sequence[Camera], outlines: Sequence[Sequence[Outline | None]], fps: float
) -> Clocks | None:
    """The clocks of V ``cameras``, of which ``outlines`` has V lists over all frames of the recording.

    None if the recording is too short or the cameras never see a common tangent plane.
    """
    count = len(outlines[0]) if outlines else 0
    if count < FEWEST_FRAMES or _cameras_with_outlines(outlines) < 2:
        return None
    found = half_frames(cameras, outlines)
    fit: SilhouetteFit | None = None
    for _ in range(REFITS):
        shifts = np.round(found).astype(int)
        frames = _frames(shifts, count)
        if len(frames) < FEWEST_FRAMES:
            return None
        moved = [[row[f - shift] for f in frames] for row, shift in zip(outlines, shifts, strict=True)]
        if _cameras_with_outlines(moved) < 2:
            return None
        rest = (found - shifts) / fps
        fit = fit_silhouettes(cameras, moved, frames, fps, BROAD_PRIOR, rest)
        if fit is None:
            return None
        found = found + np.array([correction.time_offset for correction in fit.corrections]) * fps
        found -= np.median(found)
        if (np.abs(found - shifts) < 0.75).all():
            break
    assert fit is not None
    found = found / fps
    moves = _speeds_px(cameras, outlines, fps, fit) * np.abs(found)
    return Clocks(views, found, np.maximum(fit.clock_errors, 1e-12), moves)


def _cameras_with_outlines(outlines: Sequence[Sequence[Outline | None]]) -> int:
    """How many cameras have an outline at any frame: a mask that is empty, or covers the picture, has none."""
    return sum(any(outline is not None for outline in row) for row in outlines)


def late_cameras(scene: Scene, found: Clocks, agreement: Consistency) -> dict[int, str]:
    """A sentence for each view of ``scene`` whose clock is off, by index.

    If silhouettes disagree by more than twice the motion of the object during the offset, the cause is another one, and
    the offset is what a fit takes for it.
    """
    said = {}
    for view, offset, error, z, moves, disagrees in zip(
        found.views, found.offsets, found.standard_errors, found.z, found.moves_px, agreement.pixels, strict=True
    ):
        if abs(z) > MIN_Z and moves > MIN_MOVE_PX and not disagrees > 2 * moves:
            said[view] = (
                f"view {view} ({scene.cameras[view].name}): its pictures are {1e3 * abs(offset):.1f} ± "
                f"{1e3 * error:.1f} ms ({abs(offset) * scene.fps:.2f} frames) "
                f"{'later' if offset > 0 else 'earlier'} than those of the other cameras: synchronise them anew, by "
                "whole frames at least; identify corrects what is left"
            )
    return said


def half_frames(cameras: Sequence[Camera], outlines: Sequence[Sequence[Outline | None]]) -> np.ndarray:
    """Offsets (V,) [frames], multiples of 0.5, with which the outlines of V cameras agree best; their median is 0.

    The disagreement of two cameras is the median over the frames of the difference of their tangent angles, without its
    own median: a wrong pose does not matter. Its logarithm is averaged over pairs and sides, and one camera at a time
    is moved, the one that gains most.
    """
    count, size = len(outlines[0]), len(cameras)
    seen = Outlines.of(outlines, range(count))
    longest = 2 * min(LONGEST_SHIFT, count // 3)
    floor = 0.1 / np.mean([camera.intrinsics[0, 0] for camera in cameras])
    loss = np.full((size, size, 4 * longest + 1), np.nan)
    for i in range(size):
        for j in range(i + 1, size):
            mine, its = (_with_halves(angles) for angles in tangent_angles(cameras, seen, (i, j)))
            for at, shift in enumerate(range(-2 * longest, 2 * longest + 1)):
                # Camera i is later by ``shift`` more half frames than camera j.
                low, high = max(0, shift), min(len(mine), len(mine) + shift)
                # A mean of two frames has less noise than one: each difference should have one of them at most.
                loss[i, j, at] = _log_spread((mine[low - shift : high - shift] - its[low:high])[low % 2 :: 2], floor)
            loss[j, i] = loss[i, j, ::-1]
    shifts = np.zeros(size, int)
    every = np.arange(-longest, longest + 1)
    for _ in range(2 * size):
        best_gain, best = np.log(CLEAR_GAIN), None
        for k in range(size):
            others = np.delete(np.arange(size), k)
            total = np.array([_mean(loss[k, others, s - shifts[others] + 2 * longest]) for s in every])
            gain = total[shifts[k] + longest] - total
            if np.isfinite(gain).any() and np.nanmax(gain) > best_gain:
                best_gain, best = float(np.nanmax(gain)), (k, int(every[np.nanargmax(gain)]))
        if best is None:
            break
        shifts[best[0]] = best[1]
    return 0.5 * shifts - np.median(0.5 * shifts)


def _with_halves(angles: np.ndarray) -> np.ndarray:
    """Angles (F, 2) and, between two frames, their mean (2 F - 1, 2)."""
    both = np.repeat(angles, 2, axis=0)[:-1]
    both[1::2] = 0.5 * (angles[1:] + angles[:-1])
    return both


def _log_spread(difference: np.ndarray, floor: float) -> float:
    """Mean over the sides of the logarithm of the median absolute deviation of ``difference`` (F, 2); NaN if few are
    known."""
    logs = []
    for side in difference.T:
        known = side[np.isfinite(side)]
        if len(known) >= FEWEST_FRAMES:
            logs.append(np.log(max(float(np.median(np.abs(known - np.median(known)))), floor)))
    return float(np.mean(logs)) if logs else float("nan")


def _mean(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")


def _frames(shifts: np.ndarray, count: int) -> list[int]:
    """Frames that every camera has after its shift; of many, pairs of successive ones."""
    low, high = max(0, int(shifts.max())), min(count, count + int(shifts.min()))
    frames = list(range(low, high))
    if len(frames) <= MAX_FRAMES:
        return frames
    first = np.linspace(0, len(frames) - 2, MAX_FRAMES // 2).round().astype(int)
    return [frames[k] for k in np.unique([first, first + 1])]


def _speeds_px(
    cameras: Sequence[Camera], outlines: Sequence[Sequence[Outline | None]], fps: float, fit: SilhouetteFit
) -> np.ndarray:
    """RMS speed (V,) [pixels/s] of the object in each picture."""
    on = outline_points(cameras, Outlines.of(outlines, range(len(outlines[0]))), fps)
    if on is None:
        return np.zeros(len(cameras))
    jacobians = [displacement_jacobian(camera, fit.pivot, on.points, on.velocities)[..., 7] for camera in cameras]
    return np.array([float(np.sqrt((j**2).sum(axis=1).mean())) for j in jacobians])
