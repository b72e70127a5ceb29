"""The real captures of Spring-Gaus (Zhong et al., ECCV 2024): ``real_capture/``, three cameras at 120 frames a second.

Below ``dynamic/``: ``cameras_calib.json`` contains {rvecs [rad], tvecs [m]} of each camera (OpenCV, world to camera);
``sequences/<object>/<n>.json`` lists the pictures of each camera, ``videos_images/<camera>/…jpg`` with masks
``videos_masks/<camera>/…png``. The focal length is that of ``static/colmap/<object>/cameras.bin``, scaled to the
pictures; the principal point is their centre. World: metres, gravity (0, 0, +9.8) m/s², up −z, ground z = −0.025 m.
The static pictures are not used: they have other world axes.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from masiv.errors import InputError
from masiv.scene.assemble import Conventions, assemble
from masiv.scene.camera import Camera
from masiv.scene.colmap import ColmapCamera, read_pinhole
from masiv.scene.declaration import read_declaration
from masiv.scene.layout import Layout
from masiv.scene.listing import array, entries, mapping
from masiv.scene.pictures import PLAIN, MaskSource, Pictures, common_size
from masiv.scene.scene import Scene
from masiv.scene.transforms import rotation_vector_to_world_to_camera
from masiv.strict import read_json

CONVENTIONS = Conventions(up="-z", ground_height=0.025)  # height is along up
FPS = 120.0
VECTORS = ((3,), (3, 1), (1, 3))


def can_read(path: Path) -> bool:
    """Whether ``path`` is the root of this layout, the folder of an object's sequences, or a sequence's file."""
    return _root(path) is not None


def read(path: Path) -> Scene:
    """The one sequence at ``path``. Raises InputError where there are several, or files are unusable."""
    root = _root(path)
    assert root is not None
    sequence = _sequence(path, root)
    declaration = read_declaration(path.parent if path.is_file() else path)
    calibration = root / "dynamic" / "cameras_calib.json"
    poses = mapping(read_json(calibration), str(calibration))
    listed = mapping(read_json(sequence), str(sequence))
    names = [name for name, row in poses.items() if isinstance(row, Mapping) and "rvecs" in row and name in listed]
    if not names:
        raise InputError(f"{calibration} and {sequence} have no camera in common")
    lens = read_pinhole(root / "static" / "colmap" / sequence.parent.name / "cameras.bin")
    paths: dict[tuple[int, int], Path] = {}
    cameras = []
    for view, name in enumerate(names):
        rows = entries(listed[name], f"{sequence}, '{name}'", "frame")
        folder = root / "dynamic" / "videos_images" / name
        mine = [_picture(folder, row, f"{sequence}, '{name}'[{k}]") for k, row in enumerate(rows)]
        paths.update({(view, frame): picture for frame, picture in enumerate(mine)})
        width, height = common_size(mine, f"camera {name} in {folder}")
        cameras.append(_camera(name, poses[name], lens, width, height, f"{calibration}, '{name}'"))
    frame_count = 1 + max(frame for _, frame in paths)
    if frame_count < 2:
        raise InputError(f"{sequence} has one frame only: a motion needs two or more")
    masks = {key: _mask_source(root / "dynamic", picture) for key, picture in paths.items()}
    return assemble(
        path,
        "springgaus_real",
        declaration,
        CONVENTIONS,
        Pictures(paths=paths, masks=masks, cameras=tuple(cameras)),
        fps=declaration.fps or FPS,
        frame_count=frame_count,
    )


def _root(path: Path) -> Path | None:
    for candidate in (path, *list(path.resolve().parents)[:4]):
        if (candidate / "dynamic" / "cameras_calib.json").is_file():
            below = (candidate / "dynamic" / "sequences").resolve()
            return candidate if candidate == path or below in path.resolve().parents else None
    return None


def _sequence(path: Path, root: Path) -> Path:
    if path.is_file():
        return path
    pattern = "dynamic/sequences/*/*.json" if path == root else "*.json"
    found = sorted(path.glob(pattern))
    if not found:
        raise InputError(f"{path} has no sequence: looked for {pattern}")
    if len(found) > 1:
        raise InputError(f"{path} has {len(found)} sequences: give one of them as SCENE, for example {found[0]}")
    return found[0]


def _camera(name: str, row: Any, lens: ColmapCamera, width: int, height: int, where: str) -> Camera:
    focal_x, focal_y = lens.focal_x * width / lens.width, lens.focal_y * height / lens.height
    intrinsics = np.array([[focal_x, 0, width / 2], [0, focal_y, height / 2], [0, 0, 1.0]])
    rotation, translation = (array(row, key, VECTORS, where) for key in ("rvecs", "tvecs"))
    return Camera(name, width, height, intrinsics, rotation_vector_to_world_to_camera(rotation, translation))


def _picture(folder: Path, row: Any, where: str) -> Path:
    """The picture that a sequence names, by file name or by number."""
    if isinstance(row, str) and row:
        path = folder / row if Path(row).suffix else folder / f"{row}.jpg"
    elif isinstance(row, int) and not isinstance(row, bool):
        path = next((p for p in sorted(folder.glob("*.jpg")) if p.stem.isdigit() and int(p.stem) == row), None)
        path = path or folder / f"{row}.jpg"
    else:
        raise InputError(f"{where} is {row!r}: it must be the name or the number of a picture")
    if not path.is_file():
        raise InputError(f"{path}, which {where} names, is missing")
    return path


def _mask_source(dynamic: Path, picture: Path) -> MaskSource:
    mask = (dynamic / "videos_masks" / picture.relative_to(dynamic / "videos_images")).with_suffix(".png")
    return MaskSource("mask", "mask pictures videos_masks/…png", mask) if mask.is_file() else PLAIN


LAYOUT = Layout(
    "Spring-Gaus real", "dynamic/cameras_calib.json, or a folder or file below its dynamic/sequences", can_read, read
)
