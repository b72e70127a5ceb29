"""The synthetic scenes of Spring-Gaus (Zhong et al., ECCV 2024): ``mpm_synthetic/render/<object>/``.

``camera.json`` lists {camera, K (3×3) [pixels], c2w (4×4) [m], OpenGL axes}; ``frame.json`` lists the times [s];
pictures are ``<camera>/FFF.png``, alpha is the mask. World: metres, y up, gravity 9.8 m/s², ground y = 0.3 m (0.2 m for
some objects).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from masiv.errors import InputError
from masiv.scene.assemble import Conventions, assemble
from masiv.scene.camera import Camera
from masiv.scene.declaration import read_declaration
from masiv.scene.layout import Layout
from masiv.scene.listing import array, entries, mapping, number, text
from masiv.scene.pictures import OWN_ALPHA, PLAIN, Pictures, common_size, has_transparency
from masiv.scene.scene import Scene
from masiv.scene.transforms import TimeGrid, opengl_c2w_to_world_to_camera
from masiv.strict import read_json

CONVENTIONS = Conventions(up="y", ground_height=0.3)
LOW_GROUND = frozenset({"C", "E", "V", "rope", "toothpaste"})
STEP = 0.03


def can_read(folder: Path) -> bool:
    """Whether ``folder`` has this layout."""
    return (folder / "camera.json").is_file()


def read(folder: Path) -> Scene:
    """The scene in ``folder``. Raises InputError for an unusable camera.json, frame.json or set of pictures."""
    declaration, listing = read_declaration(folder), folder / "camera.json"
    rows = entries(read_json(listing), str(listing), "camera")
    problems: list[str] = []
    grid, names = _times(folder, declaration.fps, problems)
    paths: dict[tuple[int, int], Path] = {}
    cameras = []
    for view, row in enumerate(rows):
        where = f"{listing}, entry {view}"
        camera, mine = _camera(folder, mapping(row, where), where, names)
        if camera.name in [other.name for other in cameras]:
            raise InputError(f"{where}: camera '{camera.name}' is listed twice")
        cameras.append(camera)
        paths.update({(view, frame): path for frame, path in mine.items()})
    opaque = [
        view for view in range(len(rows)) if not has_transparency(next(p for key, p in paths.items() if key[0] == view))
    ]
    pictures = Pictures(
        paths=paths,
        masks={key: PLAIN if key[0] in opaque else OWN_ALPHA for key in paths},
        cameras=tuple(cameras),
    )
    low = folder.resolve().name in LOW_GROUND
    conventions = replace(CONVENTIONS, ground_height=0.2) if low else CONVENTIONS
    return assemble(
        folder,
        "springgaus_synthetic",
        declaration,
        conventions,
        pictures,
        fps=grid.fps,
        frame_count=len(names),
        problems=problems,
    )


def _times(folder: Path, fps: float | None, problems: list[str]) -> tuple[TimeGrid, list[str]]:
    """The grid of times and the names of the frames' pictures."""
    path = folder / "frame.json"
    if not path.is_file():
        names = sorted({p.name for p in folder.glob("*/[0-9][0-9][0-9].png")})
        count = 1 + max((int(name[:3]) for name in names), default=-1)
        problems.append(f"frame.json is missing: frames are taken to be {fps or 1 / STEP:.4g} a second")
        times = [STEP * k for k in range(count)]
    else:
        times = [_time(row, f"{path}, entry {k}") for k, row in enumerate(entries(read_json(path), str(path), "frame"))]
    if len(times) < 2:
        raise InputError(f"{path} has fewer than two frames: a motion needs two or more")
    if any(later <= earlier for earlier, later in pairwise(times)):
        raise InputError(f"{path}: time does not increase from one frame to the next")
    names = [f"{k:03d}.png" for k in range(len(times))]
    return TimeGrid.from_times(times, [f"{path}, entry {k}" for k in range(len(times))], fps), names


def _time(row: object, where: str) -> float:
    if isinstance(row, Mapping) and len(row) == 1:
        return number(row, next(iter(row)), where)
    return number({"time": row}, "time", where)


def _camera(folder: Path, row: Mapping, where: str, names: list[str]) -> tuple[Camera, dict[int, Path]]:
    name = text(row, "camera", where)
    intrinsics = array(row, "K", ((3, 3),), where)
    if min(intrinsics[0, 0], intrinsics[1, 1]) <= 0:
        raise InputError(f"{where}: 'K' needs positive focal lengths")
    try:
        world_to_camera = opengl_c2w_to_world_to_camera(array(row, "c2w", ((4, 4), (3, 4)), where))
    except InputError as error:
        raise InputError(str(error) if where in str(error) else f"{where}: {error}") from error
    mine = {frame: folder / name / file for frame, file in enumerate(names) if (folder / name / file).is_file()}
    if not mine:
        raise InputError(f"{folder / name} has none of the pictures {names[0]} to {names[-1]} that {where} lists")
    width, height = common_size(list(mine.values()), f"camera {name} in {folder}")
    return Camera(name, width, height, np.array(intrinsics), world_to_camera), mine


LAYOUT = Layout("Spring-Gaus synthetic", "camera.json with <camera>/000.png", can_read, read)
