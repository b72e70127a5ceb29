"""Where the common time 0 is on each camera's clock: by a flash, a clap, the start, or because the clocks agree.

A flash is the frame at which the picture becomes brighter at once; a clap is the loudest sudden sound. Both must stand
out from all others of the recording. The ratios by which they must do so were chosen, not calibrated.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import minimum_filter1d

from masiv.errors import InputError
from masiv.footage import ffmpeg
from masiv.footage.recordings import Recording

METHODS = ("start", "clock", "flash", "clap")
FLASH_RATIO, SMALLEST_FLASH = 3.0, 2.0
"""The rise of a flash over the next largest one of the recording, and the smallest one [grey levels of 255]."""
FLASH_FRAMES = 2
"""Frames on each side of a flash whose rises belong to it: an exposure that contains its start is partly lit."""
CLAP_RATIO, SMALLEST_CLAP = 2.0, 0.02
"""The peak of a clap over the next loudest one, and the smallest one (1: the largest amplitude of the format)."""
CLAP_ECHO = 0.5
"""Time on each side of a clap that belongs to it [s]."""
BLOCK = ffmpeg.SOUND_RATE // 1000
"""Samples of a millisecond, in which loudness is measured."""
ONSET_SHARE, ONSET_BLOCKS = 0.3, 30
"""A clap begins at the first block that is this loud, relative to its peak, in the 30 ms before it."""


def zeros(recordings: Sequence[Recording], method: str) -> list[float]:
    """The reading [s] of each camera's clock at the common time 0.

    method: ``start``: all begin together, at 0; ``clock``: the clocks agree, 0 is when the last camera begins;
    ``flash`` and ``clap``: 0 is that event. Raises InputError for an event that does not stand out in a recording.
    """
    if method == "flash":
        return [flash(recording) for recording in recordings]
    if method == "clap":
        return [clap(recording) for recording in recordings]
    if method == "clock":
        return [max(_times(recording)[0] for recording in recordings)] * len(recordings)
    if method == "start":
        return [_times(recording)[0] for recording in recordings]
    raise InputError(f"--sync {method}: give one of {', '.join(METHODS)}")


def flash(recording: Recording) -> float:
    """Time [s] of the frame at which the picture becomes brighter at once. InputError if none stands out."""
    rises = np.diff(recording.brightness)
    times = _times(recording)
    if not len(rises):
        raise InputError(f"--sync flash: {recording.path} has one frame only")
    k = int(rises.argmax())
    near = np.abs(np.arange(len(rises)) - k) <= FLASH_FRAMES
    second = max(float(rises[~near].max(initial=0.0)), 0.0)
    if rises[k] < max(SMALLEST_FLASH, FLASH_RATIO * second):
        raise InputError(
            f"--sync flash: no flash is found in {recording.path}: the largest rise of brightness is {rises[k]:.1f} of "
            f"255 (frame {k + 1}, {times[k + 1]:.2f} s), the next {second:.1f}; it must be {FLASH_RATIO:g} times the "
            f"next and at least {SMALLEST_FLASH:g}: give --offset"
        )
    return float(times[k + 1])


def clap(recording: Recording) -> float:
    """Time [s] at which the loudest sudden sound begins. InputError without sound, or if none stands out."""
    if recording.files:
        raise InputError(f"--sync clap: {recording.path} is a folder of pictures, which has no sound: give --offset")
    peaks = _loudness(recording)
    if not len(peaks):
        raise InputError(f"--sync clap: {recording.path} has no sound: give --sync flash, or --offset")
    # What grows louder over many milliseconds is no clap: the rise over the quietest of the 30 ms before counts.
    rises = peaks - minimum_filter1d(peaks, ONSET_BLOCKS + 1, origin=ONSET_BLOCKS // 2, mode="nearest")
    k = int(rises.argmax())
    near = np.abs(np.arange(len(rises)) - k) <= 1000 * CLAP_ECHO
    second = float(rises[~near].max(initial=0.0))
    if rises[k] < max(SMALLEST_CLAP, CLAP_RATIO * second):
        raise InputError(
            f"--sync clap: no clap is found in {recording.path}: the loudest sudden sound has an amplitude of "
            f"{rises[k]:.3f} ({k / 1000:.2f} s), the next {second:.3f}; it must be {CLAP_RATIO:g} times the next and "
            f"at least {SMALLEST_CLAP:g}: give --offset"
        )
    start = max(0, k - ONSET_BLOCKS)
    return (start + int((peaks[start : k + 1] >= ONSET_SHARE * peaks[k]).argmax())) / 1000


def _loudness(recording: Recording) -> np.ndarray:
    """Largest amplitude in each millisecond from time 0 of the container, shape (N,)."""
    peaks, rest = [], np.empty(0, np.float32)
    for piece in ffmpeg.sound(recording.path):
        samples = np.concatenate([rest, piece])
        whole = len(samples) // BLOCK * BLOCK
        peaks.append(np.abs(samples[:whole]).reshape(-1, BLOCK).max(axis=1))
        rest = samples[whole:]
    return np.concatenate(peaks) if peaks else np.empty(0, np.float32)


def _times(recording: Recording) -> np.ndarray:
    assert recording.times is not None
    return recording.times
