"""A point cloud a frame and no pictures: ``cloud_F.ply`` or ``F.ply`` for the frames F = 0, 1, …

A file has vertices x, y, z [m, world], and, if known, normals nx, ny, nz and colours red, green, blue (0 to 255). What
else it has, faces for example, is not read. ``scene.yaml`` must give fps; world: z up and no ground, unless it says
otherwise.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np
from plyfile import PlyData

from masiv.bounds import FPS, LENGTH
from masiv.errors import InputError
from masiv.files import require_file
from masiv.scene.assemble import Conventions, guesses
from masiv.scene.cloud import Cloud
from masiv.scene.declaration import SceneDeclaration, read_declaration
from masiv.scene.frame_cache import Frame
from masiv.scene.layout import Layout
from masiv.scene.scene import Scene
from masiv.scene.transforms import count_frames
from masiv.strict import shortened

NAME = re.compile(r"^(?:cloud_)?(\d{1,18})\.ply$", re.IGNORECASE)
CONVENTIONS = Conventions(up="z", ground_height=None, up_assumed=True)
MIN_POINTS = 50
"""Fewer points do not show a shape."""


def can_read(folder: Path) -> bool:
    """Whether ``folder`` has this layout."""
    return folder.is_dir() and any(NAME.match(path.name) for path in folder.iterdir())


def read(folder: Path) -> Scene:
    """The scene in ``folder``. Raises InputError for missing frames, a missing fps and unusable files."""
    declaration = read_declaration(folder)
    files = _files(folder)
    if declaration.fps is None:
        raise InputError(f"{folder / 'scene.yaml'} must give fps: point clouds have no times")
    FPS.check(declaration.fps, f"{folder / 'scene.yaml'}: fps")
    for key, of in (("depth_unit", "depth pictures"), ("depth_noise", "depth pictures"), ("masks", "pictures")):
        if getattr(declaration, key) is not None:
            raise InputError(f"{folder / 'scene.yaml'}: {key} is for {of}, {folder} has point clouds: remove it")
    if declaration.fit_frames is not None and declaration.fit_frames > len(files):
        raise InputError(f"scene.yaml: fit_frames is {declaration.fit_frames}, the scene has {len(files)} frames")
    up = declaration.up(CONVENTIONS.up)
    load_cloud = partial(_load, files, declaration)
    load_cloud(0)
    return Scene(
        path=folder,
        layout="point clouds",
        fps=declaration.fps,
        frame_count=len(files),
        cameras=(),
        gravity=declaration.gravity_vector(up, CONVENTIONS.gravity),
        up=up,
        ground=declaration.ground_plane(up, CONVENTIONS.ground_height),
        density=declaration.density or CONVENTIONS.density,
        load=_no_picture,
        mask_source="none",
        problems=tuple(guesses(declaration, CONVENTIONS)),
        fit_frames=declaration.fit_frames,
        load_cloud=load_cloud,
    )


def read_cloud(path: Path) -> Cloud:
    """The vertices of the PLY file ``path``. Raises InputError if it is broken or a coordinate is not finite."""
    try:
        rows = PlyData.read(str(require_file(path)))["vertex"].data
        points = _columns(rows, "x", "y", "z")
    except InputError:
        raise
    except Exception as error:  # the library raises what it likes for a damaged file
        raise InputError(f"{path} is not a PLY file with vertices ({shortened(error)})") from error
    if points is None:
        raise InputError(f"{path}: its vertices have no x, y, z")
    if not np.isfinite(points).all():
        raise InputError(f"{path}: {int((~np.isfinite(points)).any(axis=1).sum())} points are not finite: remove them")
    if len(points):
        LENGTH.check(float(np.abs(points).max()), f"{path}: a coordinate")
    normals, colours = _columns(rows, "nx", "ny", "nz"), _columns(rows, "red", "green", "blue")
    if normals is not None:
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        # All zero is what writers put where they know none.
        normals = normals / length if length.min() > 0 and np.isfinite(length).all() else None
    if colours is not None:
        colours = np.clip(colours / (255 if rows["red"].dtype.kind in "ui" else 1), 0, 1)
    return Cloud(points, normals, colours)


def _files(folder: Path) -> tuple[Path, ...]:
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        if (match := NAME.match(path.name)) is not None:
            other = found.setdefault(int(match[1]), path)
            if other != path:
                raise InputError(f"{folder}: {other.name} and {path.name} are both frame {int(match[1])}: leave one")
    missing = sorted(set(range(count_frames(found, str(folder)))) - set(found))
    if missing:
        raise InputError(f"{folder} has no point cloud of frame {missing[0]}: frames must run from 0 without gaps")
    return tuple(found[frame] for frame in sorted(found))


def _load(files: tuple[Path, ...], declaration: SceneDeclaration, frame: int) -> Cloud:
    cloud = read_cloud(files[frame])
    kept = np.ones(len(cloud.points), bool)
    corners = declaration.crop_corners()
    if corners is not None:
        kept = ((cloud.points >= corners.min(axis=0)) & (cloud.points <= corners.max(axis=0))).all(axis=1)
    if kept.sum() < MIN_POINTS:
        inside = "" if corners is None else " in the crop_box of scene.yaml"
        raise InputError(f"{files[frame]} has {int(kept.sum())} points{inside}: a shape needs {MIN_POINTS} or more")
    normals, colours = (None if rows is None else rows[kept] for rows in (cloud.normals, cloud.colours))
    return Cloud(cloud.points[kept], normals, colours)


def _columns(rows: np.ndarray, *names: str) -> np.ndarray | None:
    """Columns (N, 3) float64, or None if one of them is missing."""
    if not set(names) <= set(rows.dtype.names or ()):
        return None
    return np.stack([np.asarray(rows[name], dtype=np.float64) for name in names], axis=1)


def _no_picture(view: int, frame: int) -> Frame:
    raise InputError(f"view {view}, frame {frame}: a recording of point clouds has no pictures")


LAYOUT = Layout("point clouds", "cloud_F.ply or F.ply with scene.yaml", can_read, read)
