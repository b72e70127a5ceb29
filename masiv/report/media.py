"""Pictures and videos on disk, written completely or not at all. Pictures are (H, W, 3) uint8 RGB."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from masiv.errors import MasivError
from masiv.files import atomic, write_bytes


def write_png(path: Path, image: np.ndarray) -> None:
    """Write a PNG, with the folders that lead to it."""
    encoded, data = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))
    if not encoded:
        raise MasivError(f"the picture {path} could not be encoded")
    write_bytes(path, data.tobytes())


def write_video(path: Path, images: Iterable[np.ndarray], fps: float, repeat: int = 1) -> None:
    """Write an H.264 mp4 that every browser plays. ``repeat`` shows each picture that many times, to slow it down."""
    import imageio_ffmpeg

    with atomic(path) as temporary:
        writer = None
        try:
            for image in images:
                even = _even(image)
                if writer is None:
                    size = even.shape[1], even.shape[0]
                    writer = imageio_ffmpeg.write_frames(
                        str(temporary),
                        size,
                        fps=fps,  # pyright: ignore[reportArgumentType] a fraction is fine for ffmpeg
                        quality=8,
                        macro_block_size=2,
                        pix_fmt_out="yuv420p",
                        ffmpeg_log_level="error",
                    )
                    writer.send(None)
                for _ in range(repeat):
                    writer.send(even.tobytes())
        finally:
            if writer is not None:
                writer.close()
        if writer is None:
            raise MasivError(f"there is no picture to make the video {path} of")


def _even(image: np.ndarray) -> np.ndarray:
    """yuv420p needs even sizes: repeat the last row and column where needed."""
    bottom, right = image.shape[0] % 2, image.shape[1] % 2
    return np.ascontiguousarray(np.pad(image, ((0, bottom), (0, right), (0, 0)), mode="edge"))
