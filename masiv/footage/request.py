"""What ``make_scene`` is asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from masiv.footage.empty_scene import Chroma

Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class ImportRequest:
    """Footage, calibration, clocks, frames, masks and world of a scene. Lengths in metres, times in seconds.

    footage: folder with one video or one folder of pictures a camera. calibration: file or folder. cameras: recordings
    by name in the calibration; empty for all of ``footage`` by their own names.

    times, time_unit: see ``times.timed``. recorded_fps: rates by name, "" for the others. sync, offsets: see
    ``clocks.zeros``. fps, start, end, every: see ``common_frames``. downscale: 2 halves both sides of a picture. jpeg:
    quality, 1 to 100; None for PNG.

    Masks, at most one of: plates (folder of empty scenes), plate_seconds (when the recording shows the empty scene),
    masks (folder of mask recordings, frame by frame those of the footage), chroma. segmenter: weights of SAM 2, boxes
    by name [pixels of the footage].

    Unit of length, at most one of: scale [m], baseline (two names, m), landmarks (file, if it has distances), board
    (folder of pictures) with board_size. up: an axis (x, -z, …) or a vector. ground: a height along up, "none", or None
    if it is not said.
    """

    footage: Path
    calibration: Path
    cameras: Mapping[str, str] = field(default_factory=dict)
    times: str = "container"
    time_unit: str = "s"
    recorded_fps: Mapping[str, float] = field(default_factory=dict)
    sync: str = "start"
    offsets: Mapping[str, float] = field(default_factory=dict)
    fps: float | None = None
    start: float | None = None
    end: float | None = None
    every: int = 1
    downscale: float = 1.0
    jpeg: int | None = None
    plates: Path | None = None
    plate_seconds: tuple[float, float] | None = None
    masks: Path | None = None
    chroma: Chroma | None = None
    segmenter: Path | None = None
    boxes: Mapping[str, Box] = field(default_factory=dict)
    scale: float | None = None
    baseline: tuple[str, str, float] | None = None
    landmarks: Path | None = None
    board: Path | None = None
    board_size: tuple[int, int, float] | None = None
    up: str | np.ndarray | None = None
    ground: float | str | None = None
    density: float | None = None
