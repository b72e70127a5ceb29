"""Pixels of a picture file as they are in it, and its size."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np

from masiv.errors import InputError
from masiv.files import require_file

MAX_PIXELS = 2**28
"""More than the largest sensor of a camera (200 million)."""


def read_raw(path: Path) -> np.ndarray:
    """The picture (H, W) or (H, W, C) as it is stored, channels in OpenCV's order.

    Raises InputError if it is missing, broken or larger than any camera's.
    """
    png_size(path)
    try:
        raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:  # a size that no memory holds
        raise InputError(f"{path} cannot be read as a picture ({error.err}): replace it") from error
    if raw is None:
        raise InputError(f"{path} cannot be read as a picture: replace it or remove it from the listing")
    return np.asarray(raw)


def png_size(path: Path) -> tuple[int, int] | None:
    """Width and height [pixels] by the header if the file is a PNG, else None. Raises InputError for a size that no
    camera has, which the header alone can say."""
    with require_file(path).open("rb") as file:
        head = file.read(24)
    if head[:8] != b"\x89PNG\r\n\x1a\n" or len(head) < 24:
        return None
    width, height = struct.unpack(">II", head[16:24])
    if not 0 < width * height <= MAX_PIXELS:
        raise InputError(f"{path} says that it has {width}×{height} pixels, which no camera takes: replace it")
    return width, height
