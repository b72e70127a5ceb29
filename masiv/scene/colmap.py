"""COLMAP's binary list of cameras, ``cameras.bin``: count (u64), then id, model (i32), width, height (u64), f64…"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

from masiv.errors import InputError
from masiv.files import require_file

PINHOLES = {0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4)}
OTHERS = {2: "SIMPLE_RADIAL", 3: "RADIAL", 4: "OPENCV", 5: "OPENCV_FISHEYE", 6: "FULL_OPENCV"}


@dataclass(frozen=True)
class ColmapCamera:
    """Focal lengths and principal point [pixels, pixel centres at +0.5] for pictures of width × height pixels."""

    width: int
    height: int
    focal_x: float
    focal_y: float
    cx: float
    cy: float


def read_pinhole(path: Path) -> ColmapCamera:
    """The first camera in ``path``. Raises InputError if it is missing, truncated or not a pinhole camera."""
    if not path.is_file():
        raise InputError(f"{path} is missing: the focal length is read from it")
    data = require_file(path).read_bytes()
    try:
        (count,) = struct.unpack_from("<Q", data)
        if count < 1:
            raise InputError(f"{path} lists no camera")
        _, model, width, height = struct.unpack_from("<iiQQ", data, 8)
        if model not in PINHOLES:
            name = OTHERS.get(model, f"number {model}")
            raise InputError(f"{path}: camera model {name} is not read, only PINHOLE and SIMPLE_PINHOLE are")
        numbers = struct.unpack_from(f"<{PINHOLES[model][1]}d", data, 32)
    except struct.error as error:
        raise InputError(f"{path} is cut short: it is no COLMAP cameras.bin") from error
    focal_x, focal_y = numbers[0], numbers[0 if model == 0 else 1]
    if width < 1 or height < 1 or not (focal_x > 0 and focal_y > 0):
        raise InputError(f"{path}: a camera of {width}×{height} pixels with focal length {focal_x:g} cannot be")
    return ColmapCamera(width, height, focal_x, focal_y, *numbers[-2:])
