"""Cameras and poses as COLMAP saves them: ``cameras`` and ``images``, binary (.bin) or text (.txt).

Format: https://colmap.github.io/format.html. Pixel centres are at +0.5; poses are world to camera, in OpenCV axes.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from masiv.errors import InputError
from masiv.files import require_file
from masiv.strict import quoted

MODELS: dict[int, tuple[str, tuple[str, ...]]] = {
    0: ("SIMPLE_PINHOLE", ("f", "cx", "cy")),
    1: ("PINHOLE", ("fx", "fy", "cx", "cy")),
    2: ("SIMPLE_RADIAL", ("f", "cx", "cy", "k1")),
    3: ("RADIAL", ("f", "cx", "cy", "k1", "k2")),
    4: ("OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    5: ("OPENCV_FISHEYE", ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")),
    6: ("FULL_OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    8: ("SIMPLE_RADIAL_FISHEYE", ("f", "cx", "cy", "k1")),
    9: ("RADIAL_FISHEYE", ("f", "cx", "cy", "k1", "k2")),
}
"""Number -> name and parameters of the camera models that are read; names of coefficients are OpenCV's."""
READ, PINHOLES = tuple(name for name, _ in MODELS.values()), ("SIMPLE_PINHOLE", "PINHOLE")


@dataclass(frozen=True)
class ColmapCamera:
    """Focal lengths and principal point [pixels, pixel centres at +0.5] for pictures of width × height pixels, and the
    coefficients of distortion by OpenCV's names."""

    model: str
    width: int
    height: int
    focal_x: float
    focal_y: float
    cx: float
    cy: float
    coefficients: dict[str, float]


@dataclass(frozen=True)
class ColmapImage:
    """A registered picture. world_to_camera: (4, 4), in COLMAP's unit of length."""

    name: str
    camera: int
    world_to_camera: np.ndarray


def read_pinhole(path: Path) -> ColmapCamera:
    """The first camera in ``path``. Raises InputError if it is missing, truncated or not a pinhole camera."""
    if not path.is_file():
        raise InputError(f"{path} is missing: the focal length is read from it")
    return next(iter(read_cameras(path, PINHOLES).values()))


def read_cameras(path: Path, models: tuple[str, ...] = READ) -> dict[int, ColmapCamera]:
    """The cameras by their id. Raises InputError for a file that is damaged, and for one that is not of ``models``."""
    rows = list((_text_cameras if path.suffix == ".txt" else _binary_cameras)(path, models))
    if not rows:
        raise InputError(f"{path} lists no camera")
    return dict(rows)


def read_images(path: Path) -> list[ColmapImage]:
    """The registered pictures, without their points. Raises InputError for a file that is damaged."""
    images = list(_text_images(path) if path.suffix == ".txt" else _binary_images(path))
    if not images:
        raise InputError(f"{path} lists no picture")
    return images


def _parameters(path: Path, model: str, models: tuple[str, ...]) -> tuple[str, ...]:
    if model not in models:
        raise InputError(f"{path}: camera model {model} is not read, only {', '.join(models)} are")
    return next(names for name, names in MODELS.values() if name == model)


def _camera(path: Path, model: str, width: int, height: int, names: tuple[str, ...], numbers: tuple) -> ColmapCamera:
    if len(numbers) != len(names):
        raise InputError(f"{path}: a camera {model} has {len(numbers)} parameters, it must have {len(names)}")
    given = dict(zip(names, numbers, strict=True))
    focal_x, focal_y = given.get("f", given.get("fx", 0.0)), given.get("f", given.get("fy", 0.0))
    if not all(map(math.isfinite, numbers)) or width < 1 or height < 1 or not (focal_x > 0 and focal_y > 0):
        raise InputError(f"{path}: a camera of {width}×{height} pixels with focal length {focal_x:g} cannot be")
    coefficients = {name: value for name, value in given.items() if name[0] in "kp"}
    return ColmapCamera(model, width, height, focal_x, focal_y, given["cx"], given["cy"], coefficients)


def _image(path: Path, name: str, camera: int, quaternion: tuple[float, ...], t: tuple[float, ...]) -> ColmapImage:
    w, x, y, z = quaternion
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if not (math.isfinite(length) and length > 1e-9 and all(map(math.isfinite, t))):
        raise InputError(f"{path}: the pose of {quoted(name)} is not finite, or is no rotation")
    w, x, y, z = (v / length for v in (w, x, y, z))
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = t
    return ColmapImage(name, camera, pose)


class _Bytes:
    """Reads values of a binary file one after the other."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.at = path, require_file(path).read_bytes(), 0

    def take(self, form: str) -> tuple:
        try:
            values = struct.unpack_from("<" + form, self.data, self.at)
        except struct.error as error:
            raise InputError(f"{self.path} is cut short: it is no COLMAP {self.path.name}") from error
        self.at += struct.calcsize("<" + form)
        return values

    def text(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise InputError(f"{self.path} is cut short: it is no COLMAP {self.path.name}")
        found, self.at = self.data[self.at : end], end + 1
        return found.decode("utf-8", "replace")


def _binary_cameras(path: Path, models: tuple[str, ...]) -> Iterator[tuple[int, ColmapCamera]]:
    file = _Bytes(path)
    (count,) = file.take("Q")
    for _ in range(count):
        number, model, width, height = file.take("iiQQ")
        name = MODELS[model][0] if model in MODELS else f"number {model}"
        names = _parameters(path, name, models)
        yield number, _camera(path, name, width, height, names, file.take(f"{len(names)}d"))


def _binary_images(path: Path) -> Iterator[ColmapImage]:
    file = _Bytes(path)
    (count,) = file.take("Q")
    for _ in range(count):
        _, *pose, camera = file.take("i7di")
        name = file.text()
        (points,) = file.take("Q")
        if points > len(file.data):
            raise InputError(f"{path} is cut short: it is no COLMAP {path.name}")
        file.take(f"{24 * points}x")
        yield _image(path, name, camera, tuple(pose[:4]), tuple(pose[4:]))


def _lines(path: Path) -> Iterator[str]:
    """Lines without comments. Empty ones count: a picture without points has one."""
    with require_file(path).open(encoding="utf-8", errors="replace") as file:
        for line in file:
            if not line.startswith("#"):
                yield line.strip()


def _text_cameras(path: Path, models: tuple[str, ...]) -> Iterator[tuple[int, ColmapCamera]]:
    for line in filter(None, _lines(path)):
        try:
            number, model, width, height, *numbers = line.split()
            key, size, values = int(number), (int(width), int(height)), tuple(map(float, numbers))
        except ValueError as error:
            raise InputError(f"{path}: the line {quoted(line)} is no camera of COLMAP") from error
        yield key, _camera(path, model, *size, _parameters(path, model, models), values)


def _text_images(path: Path) -> Iterator[ColmapImage]:
    lines = _lines(path)
    for line in lines:
        if not line:
            continue
        try:
            _, *pose, camera, name = line.split(maxsplit=9)
            numbers = tuple(map(float, pose))
            image = _image(path, name, int(camera), numbers[:4], numbers[4:])
        except (ValueError, TypeError) as error:
            raise InputError(f"{path}: the line {quoted(line)} is no picture of COLMAP") from error
        next(lines, "")  # its points
        yield image
