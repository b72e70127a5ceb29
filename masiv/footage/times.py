"""The time of each frame by its camera's clock: from the container, from a list, from file names, or from a rate."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from masiv.bounds import FPS, TIME
from masiv.errors import InputError
from masiv.files import require_file
from masiv.footage.recordings import Recording
from masiv.strict import quoted

UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
NAMES, CONTAINER = "names", "container"
LISTS = (".txt", ".csv")


def timed(recording: Recording, source: str, unit: str, fps: float | None) -> Recording:
    """``recording`` with its times.

    source: ``container``; ``names``: the last number in the name of each picture; else a folder with one list of times
    a camera, NAME.txt or NAME.csv, a frame a line. unit: of these numbers, or ``frames``. fps [1/s]: frames were
    recorded at this rate, whatever the container says. Raises InputError if nothing says the times.
    """
    if fps is not None:
        FPS.check(fps, f"--recorded-fps of {recording.name}")
    if source == CONTAINER:
        if fps is not None:
            return recording.with_times(np.arange(len(recording)) / fps)
        if recording.times is None:
            raise InputError(f"nothing says when the frames of {recording.path} were recorded: give --recorded-fps")
        return recording.with_times(recording.times)
    numbers = _in_names(recording) if source == NAMES else _in_list(Path(source), recording.name)
    if unit == "frames":
        if fps is None:
            raise InputError("--time-unit frames needs --recorded-fps: how many frames are a second")
        return recording.with_times(numbers / fps)
    if unit not in UNITS:
        raise InputError(f"--time-unit {unit}: give one of {', '.join(UNITS)}, frames")
    times = numbers * UNITS[unit]
    TIME.check(float(np.abs(times).max()), f"times of {recording.path}")
    return recording.with_times(times)


def _in_names(recording: Recording) -> np.ndarray:
    if not recording.files:
        raise InputError(f"--times names: {recording.path} is a video, its frames have no names")
    numbers = []
    for file in recording.files:
        found = re.findall(r"\d+(?:\.\d+)?", file.stem)
        if not found:
            raise InputError(f"--times names: there is no number in the name of {file}")
        numbers.append(float(found[-1]))
    return np.array(numbers)


def _in_list(folder: Path, name: str) -> np.ndarray:
    path = next((folder / f"{name}{suffix}" for suffix in LISTS if (folder / f"{name}{suffix}").is_file()), None)
    if path is None:
        raise InputError(
            f"--times {folder}: {name}.txt is missing there: give one time a frame, or names, or container"
        )
    numbers = []
    for k, line in enumerate(require_file(path).read_text(encoding="utf-8", errors="replace").splitlines()):
        first = re.split(r"[,;\s]+", line.strip())[0]
        if not first or first.startswith("#"):
            continue
        try:
            numbers.append(float(first))
        except ValueError as error:
            if k == 0:
                continue  # a heading
            raise InputError(f"{path}, line {k + 1}: {quoted(first)} is no time") from error
    return np.array(numbers)
