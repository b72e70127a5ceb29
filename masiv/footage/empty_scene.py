"""The empty scene of each camera, and masks by the colour of the background."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from masiv.errors import InputError
from masiv.footage.recordings import PICTURES, VIDEOS, Recording, open_recording
from masiv.scene.background import largest_components
from masiv.scene.pictures import image_size
from masiv.subsample import evenly_spread

MOST_AVERAGED = 100
"""Frames of a clip of the empty scene that are averaged: noise falls to a tenth, below a grey level."""
LEAST_SATURATION, LEAST_VALUE = 0.25, 0.12
"""Of a coloured background, 0 to 1: below, a hue is mostly noise. Chosen."""


@dataclass(frozen=True)
class Chroma:
    """A background of one colour: hues from ``low`` to ``high`` [degrees], through 360 if low is larger."""

    low: float
    high: float

    def mask(self, picture: np.ndarray) -> np.ndarray:
        """Mask (H, W) uint8, 255 on what has another colour, without components of less than 2 % of the largest."""
        values = cv2.cvtColor(np.ascontiguousarray(picture[..., :3]).astype(np.float32) / 255, cv2.COLOR_RGB2HSV)
        hue, saturation, value = values[..., 0], values[..., 1], values[..., 2]
        inside = (hue >= self.low) & (hue <= self.high)
        if self.low > self.high:
            inside = (hue >= self.low) | (hue <= self.high)
        background = inside & (saturation >= LEAST_SATURATION) & (value >= LEAST_VALUE)
        return np.where(largest_components(~background), 255, 0).astype(np.uint8)


def parse_chroma(text: str) -> Chroma:
    """'90-150' as hues in degrees. Raises InputError."""
    try:
        low, high = (float(part) for part in text.split("-"))
    except ValueError:
        low = high = -1.0
    if not (0 <= low <= 360 and 0 <= high <= 360 and low != high):
        raise InputError(f"--chroma {text}: give two hues in degrees, 0 to 360, for example 90-150 for a green screen")
    return Chroma(low, high)


def mean_picture(pictures: Iterable[np.ndarray]) -> np.ndarray:
    """The mean of pictures (H, W, 3) uint8, which are held one at a time."""
    total, count = np.zeros(1), 0
    for picture in pictures:
        total, count = total + picture[..., :3].astype(np.float64), count + 1
    return np.clip(np.round(total / count), 0, 255).astype(np.uint8)


def plate_of(folder: Path, recording: Recording) -> np.ndarray:
    """The empty scene (H, W, 3) uint8: ``folder``/CAMERA, a picture, or the mean of a video or a folder of pictures.

    Raises InputError if it is missing, or has another size than the recording.
    """
    paths = [folder / f"{recording.name}{suffix}" for suffix in (*PICTURES, *VIDEOS)] + [folder / recording.name]
    path = next((p for p in paths if p.exists()), None)
    if path is None:
        raise InputError(
            f"--plates {folder} has no {recording.name}: give a picture or a clip of the empty scene for each camera, "
            "named as the camera"
        )
    if path.suffix.lower() in PICTURES:
        clip = Recording(recording.name, path, (path,), image_size(path), None)
    else:
        clip = open_recording(recording.name, path)
    if clip.size != recording.size:
        raise InputError(
            f"{path} has {clip.size[0]}×{clip.size[1]} pixels, the footage has {recording.size[0]}×{recording.size[1]}"
        )
    return mean_picture(clip.frames(spread(range(len(clip)))))


def spread(indices: Sequence[int]) -> list[int]:
    """At most ``MOST_AVERAGED`` of ``indices``, evenly spread."""
    return evenly_spread(indices, MOST_AVERAGED)
