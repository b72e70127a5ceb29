"""Decode videos and their sound with the ffmpeg that ``imageio-ffmpeg`` brings. Nothing is held but one picture."""

from __future__ import annotations

import re
import subprocess
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from masiv.errors import InputError
from masiv.files import require_file
from masiv.scene.picture_file import MAX_PIXELS
from masiv.strict import shortened

SMALL_WIDTH, SMALL_HEIGHT = 64, 36
"""Of the pictures by which brightness is measured."""
SOUND_RATE = 48_000
_FRAME = re.compile(r"\] n: *\d+ pts: *(\S+) .* s:(\d+)x(\d+) ")
_BASE = re.compile(r"config in time_base: (\d+)/(\d+)")
_CHUNK = 1 << 20


@dataclass
class _Log:
    """What ffmpeg says on stderr, read as it comes: times and size of frames, and the last other lines."""

    base: float = 0.0
    times: list[float] = field(default_factory=list)
    sizes: set[tuple[int, int]] = field(default_factory=set)
    last: deque[str] = field(default_factory=lambda: deque(maxlen=4))

    def read(self, lines: Iterator[bytes]) -> None:
        for raw in lines:
            line = raw.decode("utf-8", "replace").strip()
            if found := _FRAME.search(line):
                stamp = found[1]
                self.times.append(int(stamp) * self.base if stamp.lstrip("-").isdigit() else np.nan)
                self.sizes.add((int(found[2]), int(found[3])))
            elif found := _BASE.search(line):
                self.base = int(found[1]) / int(found[2])
            elif line and "showinfo" not in line and "User Data" not in line:
                self.last.append(line)


@dataclass(frozen=True)
class Scan:
    """What one pass over a video finds.

    times (N,) [s]: of its frames, by the container, NaN where it says none. size: (width, height) [pixels]. brightness
    (N,): mean grey level of each frame, 0 to 255.
    """

    times: np.ndarray
    size: tuple[int, int]
    brightness: np.ndarray


def scan(path: Path) -> Scan:
    """Decode all of ``path`` once. Raises InputError if it has no frame, or frames of different sizes."""
    filters = f"showinfo=checksum=0,scale={SMALL_WIDTH}:{SMALL_HEIGHT}:flags=area,format=gray"
    size = SMALL_WIDTH * SMALL_HEIGHT
    brightness = []
    with _decoding(path, ["-map", "0:v:0", "-vf", filters, "-fps_mode", "passthrough", "-f", "rawvideo"]) as (
        pipe,
        log,
    ):
        while len(frame := pipe.read(size)) == size:
            brightness.append(float(np.frombuffer(frame, np.uint8).mean()))
    count = min(len(brightness), len(log.times))
    if not count:
        raise InputError(
            f"{path} has no picture that can be decoded ({shortened(' '.join(log.last))}): record it again"
        )
    if len(log.sizes) > 1:
        raise InputError(f"{path} changes its size while it runs ({sorted(log.sizes)}): convert it to one size")
    width, height = next(iter(log.sizes))
    if width * height > MAX_PIXELS:
        raise InputError(f"{path} says that it has {width}×{height} pixels, which no camera takes: replace it")
    return Scan(np.array(log.times[:count]), (width, height), np.array(brightness[:count]))


def frames(path: Path, size: tuple[int, int], indices: Sequence[int]) -> Iterator[np.ndarray]:
    """The frames (H, W, 3) uint8 RGB at the ascending ``indices``, in turn. Raises InputError if one cannot be read."""
    if not indices:
        return
    first, last = indices[0], indices[-1]
    filters = f"select=between(n\\,{first}\\,{last}),format=rgb24"
    options = ["-map", "0:v:0", "-vf", filters, "-fps_mode", "passthrough", "-frames:v", str(last - first + 1)]
    width, height = size
    wanted = iter(indices)
    due = next(wanted)
    with _decoding(path, [*options, "-f", "rawvideo", "-pix_fmt", "rgb24"]) as (pipe, log):
        for index in range(first, last + 1):
            data = pipe.read(3 * width * height)
            if len(data) < 3 * width * height:
                break
            if index == due:
                yield np.frombuffer(data, np.uint8).reshape(height, width, 3)
                due = next(wanted, -1)
        if due != -1:
            raise InputError(f"{path} cannot be decoded at frame {due} ({shortened(' '.join(log.last))}): convert it")


def sound(path: Path) -> Iterator[np.ndarray]:
    """The first sound track as float32 in [-1, 1], ``SOUND_RATE`` a second from time 0 of the container, piece by
    piece. Yields nothing if there is no sound."""
    options = ["-vn", "-map", "0:a:0?", "-af", "aresample=async=1:first_pts=0", "-ac", "1", "-ar", str(SOUND_RATE)]
    with _decoding(path, [*options, "-f", "s16le"]) as (pipe, _):
        while data := pipe.read(_CHUNK):
            yield np.frombuffer(data[: len(data) // 2 * 2], "<i2").astype(np.float32) / 32768


@contextmanager
def _decoding(path: Path, options: list[str]) -> Iterator[tuple]:
    """Run ffmpeg on ``path``: its stdout, and its log, which is complete when the block ends.

    ``path`` is passed as a file that may open no other files, since playlists could name any.
    """
    import imageio_ffmpeg

    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-nostdin", "-nostats", "-protocol_whitelist", "file"]
    command += ["-i", f"file:{require_file(path).resolve()}", *options, "pipe:1"]
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stderr is not None
    log = _Log()
    reader = threading.Thread(target=log.read, args=(iter(process.stderr),), daemon=True)
    reader.start()
    try:
        yield process.stdout, log
        process.stdout.close()
        reader.join()
    finally:
        process.kill()
        process.wait()
        reader.join()
        process.stdout.close()
        process.stderr.close()
