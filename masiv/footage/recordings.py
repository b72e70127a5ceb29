"""What one camera recorded: a video, or a folder of pictures, with the time of each frame by the camera's own clock."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np

from masiv.errors import InputError
from masiv.footage import ffmpeg
from masiv.scene.pictures import image_size, read_pixels

VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".m2ts", ".ts", ".mpg", ".mpeg", ".wmv")
PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")


@dataclass(frozen=True, eq=False)
class Recording:
    """Frames of one camera.

    path: the video or the folder. files: the pictures in the folder, in order; empty for a video. size: (width, height)
    [pixels]. times (N,) [s]: of the frames by the camera's clock, None as long as nothing says them.
    """

    name: str
    path: Path
    files: tuple[Path, ...]
    size: tuple[int, int]
    times: np.ndarray | None
    scanned_brightness: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.files) if self.files else len(self.brightness)

    @cached_property
    def brightness(self) -> np.ndarray:
        """Mean grey level of each frame (N,), 0 to 255."""
        if self.scanned_brightness is not None:
            return self.scanned_brightness
        small = ffmpeg.SMALL_WIDTH, ffmpeg.SMALL_HEIGHT
        return np.array(
            [cv2.resize(read_pixels(f)[..., :3], small, interpolation=cv2.INTER_AREA).mean() for f in self.files]
        )

    def with_times(self, times: np.ndarray) -> Recording:
        """With ``times`` (N,) [s]. Raises InputError unless there is one a frame, and they ascend."""
        if len(times) != len(self):
            raise InputError(f"{self.path} has {len(self)} frames, but {len(times)} times: give one time a frame")
        if not np.isfinite(times).all():
            raise InputError(f"{self.path} has frames without a time: give --recorded-fps")
        if (late := np.flatnonzero(np.diff(times) <= 0)).size:
            k = int(late[0])
            raise InputError(
                f"{self.path}: frame {k + 1} is at {times[k + 1]:.6g} s, the one before it at {times[k]:.6g} s: times "
                "must ascend; correct them, or give --recorded-fps"
            )
        return replace(self, times=times)

    def frames(self, indices: Sequence[int]) -> Iterator[np.ndarray]:
        """The frames (H, W, 3) RGB, or (H, W, 4) RGBA, uint8, at the ascending ``indices``, one at a time."""
        if not self.files:
            yield from ffmpeg.frames(self.path, self.size, indices)
            return
        for k in indices:
            pixels = read_pixels(self.files[k])
            if (pixels.shape[1], pixels.shape[0]) != self.size:
                raise InputError(
                    f"{self.files[k]} has {pixels.shape[1]}×{pixels.shape[0]} pixels, the pictures before it have "
                    f"{self.size[0]}×{self.size[1]}"
                )
            yield pixels


def open_recording(name: str, path: Path) -> Recording:
    """The recording at ``path``. A video is decoded once. Raises InputError if it has no picture."""
    if path.is_dir():
        files = tuple(sorted((f for f in path.iterdir() if _is_picture(f)), key=lambda f: natural(f.name)))
        if not files:
            raise InputError(f"{path} has no pictures ({', '.join(PICTURES)}): give a video or a folder of pictures")
        return Recording(name, path, files, image_size(files[0]), None)
    if path.suffix.lower() not in VIDEOS:
        raise InputError(f"{path} is no video ({', '.join(VIDEOS)}) and no folder of pictures")
    found = ffmpeg.scan(path)
    times = None if np.isnan(found.times).any() else found.times
    return Recording(name, path, (), found.size, times, found.brightness)


def find_recordings(folder: Path) -> dict[str, Path]:
    """Videos and folders of pictures in ``folder`` by name, in natural order. Raises InputError if there is none, or if
    two have one name."""
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: give one with a video or a folder of pictures for each camera")
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir(), key=lambda p: natural(p.name)):
        if path.name.startswith("."):
            continue
        if path.is_dir():
            if not any(map(_is_picture, path.iterdir())):
                continue
            name = path.name
        elif path.suffix.lower() in VIDEOS:
            name = path.stem
        else:
            continue
        if name in found:
            raise InputError(f"{folder} has two recordings called {name}: {found[name].name} and {path.name}")
        found[name] = path
    if not found:
        raise InputError(f"{folder} has no video and no folder of pictures")
    return found


def natural(name: str) -> list[tuple[int, str]]:
    """Sort key by which frame_2 comes before frame_10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.findall(r"[0-9]+|[^0-9]+", name)]


def _is_picture(path: Path) -> bool:
    return path.suffix.lower() in PICTURES and path.is_file() and not path.name.startswith(".")
