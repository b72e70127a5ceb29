"""Frames at even times that all cameras share, and which picture of each camera is nearest to each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from masiv.bounds import FPS
from masiv.errors import InputError

MISSING = -1
SAME_RATE = 1e-2
"""Relative difference of rates below which the phase of a camera against the frames is nearly constant."""
LARGEST_SHARE = 0.75
"""Of a camera's interval: a nearest picture farther off than this is one that replaces a dropped picture. Without
dropped pictures it is half an interval away at most, plus the jitter of the stamps. Chosen."""


@dataclass(frozen=True)
class CommonFrames:
    """Frame k is at ``first + k / fps`` [s, common time].

    chosen (V, T): index of each camera's picture, MISSING where it has none. late (V, T) [s]: by how much that picture
    was taken after its frame; NaN where there is none.
    """

    first: float
    fps: float
    chosen: np.ndarray
    late: np.ndarray

    @property
    def count(self) -> int:
        """Number of frames."""
        return self.chosen.shape[1]


def common_frames(
    names: Sequence[str],
    times: Sequence[np.ndarray],
    *,
    fps: float | None = None,
    start: float | None = None,
    end: float | None = None,
    every: int = 1,
) -> CommonFrames:
    """Frames of the stretch of time that all cameras filmed, or of the part of it from ``start`` to ``end`` [s].

    times: of the pictures of each camera [s, common time], ascending. fps: default, the slowest camera's rate. every:
    of so many frames, one is kept. The instant of frame 0 is the one for which pictures are nearest to their frames
    (the middle of their largest and smallest distances). Raises InputError if there is no such stretch, for fewer than
    two frames, for an fps that a camera does not reach, and for a frame of which no camera has a picture.
    """
    rates = [rate_of(t, name) for t, name in zip(times, names, strict=True)]
    slowest = int(np.argmin(rates))
    rate = rates[slowest] if fps is None else fps
    FPS.check(rate, "--fps" if fps is not None else f"rate of {names[slowest]}")
    if rate > rates[slowest] * (1 + 1e-3):
        raise InputError(
            f"--fps {rate:g}: {names[slowest]} took {rates[slowest]:.6g} pictures a second: give at most that many"
        )
    if every < 1:
        raise InputError(f"--every {every}: give 1 or more")
    low, high = _stretch(names, times, start, end)
    step = every / rate
    # Half a picture beyond the ends, so that cameras that are out of phase keep their first and last pictures.
    margin = 0.5 / rate
    alike = [t for t, r in zip(times, rates, strict=True) if abs(r / rate - 1) < SAME_RATE]
    phase = _phase(alike, low, 1 / rate) if alike else 0.0
    first = low + phase - math.floor((phase + margin) * rate) / rate
    count = math.floor((high + margin - first) / step * (1 + 1e-9)) + 1
    if count < 2:
        raise InputError(
            f"from {low:.3f} to {high:.3f} s there are fewer than two frames at {1 / step:.6g} fps: give a longer "
            "stretch, or a higher --fps"
        )
    chosen, late = _nearest(times, first + step * np.arange(count))
    empty = (chosen == MISSING).all(axis=0)
    if empty.any():
        k = int(empty.argmax())
        raise InputError(
            f"no camera has a picture near {first + k * step:.3f} s (frame {k}): give --start and --end around a "
            "stretch without gaps, or a lower --fps"
        )
    return CommonFrames(first, 1 / step, chosen, late)


def rate_of(times: np.ndarray, name: str) -> float:
    """Pictures a second, by the median interval, which dropped pictures do not change. A whole number if it is within
    rounding of one."""
    if len(times) < 2:
        raise InputError(f"{name} has one picture only: a motion needs two or more")
    gaps = np.diff(times)
    usual = float(np.median(gaps))
    # Stamps are often rounded to milliseconds: the mean over usual intervals is closer than their median.
    rate = 1 / float(gaps[np.abs(gaps / usual - 1) < 0.5].mean())
    return float(round(rate)) if abs(rate - round(rate)) < 1e-4 * rate else rate


def _stretch(
    names: Sequence[str], times: Sequence[np.ndarray], start: float | None, end: float | None
) -> tuple[float, float]:
    low, high = max(float(t[0]) for t in times), min(float(t[-1]) for t in times)
    if low > high:
        late, early = int(np.argmax([t[0] for t in times])), int(np.argmin([t[-1] for t in times]))
        raise InputError(
            f"{names[late]} begins {low - high:.3f} s after {names[early]} ends: the recordings have no time in "
            "common; correct --sync or --offset"
        )
    slack = 1e-6 * (high - low)
    for option, value in (("--start", start), ("--end", end)):
        if value is not None and not low - slack <= value <= high + slack:
            raise InputError(f"{option} {value:g} is not in what all cameras filmed, {low:.3f} to {high:.3f} s")
    low, high = low if start is None else start, high if end is None else end
    if low >= high:
        raise InputError(f"--start {low:g} is not before --end {high:g}")
    return low, high


def _phase(times: Sequence[np.ndarray], low: float, step: float) -> float:
    """Where the frames should lie, in [0, ``step``) after ``low``: circular midrange of the cameras' phases."""
    phases = [float(np.angle(np.exp(2j * np.pi * (t - low) / step).mean())) / (2 * np.pi) for t in times]
    around = np.sort(np.mod(phases, 1.0))
    gaps = np.diff(np.append(around, around[0] + 1))
    widest = int(gaps.argmax())  # the phases lie in the rest of the circle
    after = around[(widest + 1) % len(around)]
    return float((after + 0.5 * (1 - gaps[widest])) % 1.0) * step


def _nearest(times: Sequence[np.ndarray], instants: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    chosen = np.full((len(times), len(instants)), MISSING)
    late = np.full(chosen.shape, np.nan)
    for view, own in enumerate(times):
        after = np.clip(np.searchsorted(own, instants), 1, len(own) - 1)
        index = np.where(instants - own[after - 1] <= own[after] - instants, after - 1, after)
        apart = own[index] - instants
        fits = np.abs(apart) <= LARGEST_SHARE * float(np.median(np.diff(own)))
        # One picture shows one instant: the nearest frame has it.
        for k in np.flatnonzero(np.diff(index) == 0):
            fits[k if abs(apart[k]) > abs(apart[k + 1]) else k + 1] = False
        chosen[view, fits], late[view, fits] = index[fits], apart[fits]
    return chosen, late
