"""The PAC-NeRF layout (Li et al., ICLR 2023), also that of MASIV's multi-sequence scenes.

``all_data.json`` lists {file_path, c2w 3×4 [m], camera to world, OpenGL axes, intrinsic 3×3 [pixels], time [s]}.
Pictures are ``data/r_V_F.png`` for view V and frame F; frame −1 is the empty background, frame −2 an occluder. Masks:
``data/a_V_F.png`` (alpha) or ``data/m_V_F.png`` (the object on white), else the difference to the background. Depth,
if any: ``data/d_V_F.png`` (16 bits, millimetres), and ``data/d_V_-1.png`` of the empty scene. World: metres, y up,
gravity 9.8 m/s², ground at y = 0.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from masiv.errors import InputError
from masiv.scene.assemble import Conventions, assemble
from masiv.scene.camera import Camera
from masiv.scene.declaration import read_declaration
from masiv.scene.layout import Layout
from masiv.scene.listing import array, mapping, number, text
from masiv.scene.listing import entries as listed_entries
from masiv.scene.pictures import DEPTH, PLAIN, MaskSource, Pictures, common_size
from masiv.scene.scene import Scene
from masiv.scene.transforms import count_frames, frame_of_time, opengl_c2w_to_world_to_camera, round_if_close
from masiv.strict import quoted, read_json

NAMES = ("all_data_full.json", "all_data.json")
PICTURE = re.compile(r"^(?P<prefix>.*?)(?P<view>\d{1,9})_(?P<frame>-?\d{1,18})\.(png|jpg|jpeg)$", re.IGNORECASE)
BACKGROUND, OCCLUDER = -1, -2
CONVENTIONS = Conventions(up="y", ground_height=0.0)


@dataclass(frozen=True)
class _Entry:
    view: int
    frame: int
    path: Path
    time: float
    intrinsics: np.ndarray
    world_to_camera: np.ndarray


def can_read(folder: Path) -> bool:
    """Whether ``folder`` has this layout."""
    return any((folder / name).is_file() for name in NAMES)


def read(folder: Path) -> Scene:
    """The scene in ``folder``. Raises InputError for an unusable listing, camera, time or set of pictures."""
    declaration = read_declaration(folder)
    listing = next(folder / name for name in NAMES if (folder / name).is_file())
    entries = _entries(folder, listing)
    observed = [e for e in entries if e.frame >= 0]
    if not observed:
        raise InputError(f"{listing} lists no picture with a frame of 0 or more")
    view_ids = sorted({e.view for e in observed})
    frame_count = count_frames({e.frame for e in observed}, str(listing))
    fps = declaration.fps or _fps(observed, listing)
    present = [e for e in observed if e.path.is_file() and e.path.stat().st_size > 0]
    cameras = tuple(_camera(view, observed, present, listing) for view in view_ids)
    backgrounds = _extra_pictures(entries, folder, view_ids, BACKGROUND)
    paths = {(view_ids.index(e.view), e.frame): e.path for e in present}
    depths = {key: depth for key, path in paths.items() if (depth := _sibling(path, "d")).is_file()}
    empty_depths = {i: path for i, v in enumerate(view_ids) if (path := folder / "data" / f"d_{v}_-1.png").is_file()}
    pictures = Pictures(
        paths=paths,
        masks={
            key: _mask_source(path, key[0] in backgrounds, key in depths and key[0] in empty_depths)
            for key, path in paths.items()
        },
        cameras=cameras,
        backgrounds=backgrounds,
        occluders=_extra_pictures(entries, folder, view_ids, OCCLUDER),
        depths=depths,
        empty_depths=empty_depths,
    )
    return assemble(folder, "pacnerf", declaration, CONVENTIONS, pictures, fps=fps, frame_count=frame_count)


def _entries(folder: Path, listing: Path) -> list[_Entry]:
    rows = listed_entries(read_json(listing), str(listing), "picture")
    entries: dict[tuple[int, int], _Entry] = {}
    for k, row in enumerate(rows):
        where = f"{listing}, entry {k}"
        row = mapping(row, where)
        name, time = text(row, "file_path", where), number(row, "time", where)
        intrinsics = array(row, "intrinsic", ((3, 3),), where)
        if min(np.diag(intrinsics)) <= 0:
            raise InputError(f"{where}: 'intrinsic' needs positive focal lengths")
        match = PICTURE.match(Path(name).name)
        if match is None:
            raise InputError(f"{where}: {quoted(name)} does not read as …_VIEW_FRAME.png")
        pose = array(row, "c2w", ((3, 4), (4, 4)), where)
        try:
            world_to_camera = opengl_c2w_to_world_to_camera(pose)
        except InputError as error:
            raise InputError(f"{where}: {error}") from error
        key = int(match["view"]), int(match["frame"])
        if key in entries:
            raise InputError(f"{where}: view {key[0]}, frame {key[1]} is listed twice")
        entries[key] = _Entry(*key, folder / name, time, intrinsics, world_to_camera)
    return list(entries.values())


def _fps(observed: list[_Entry], listing: Path) -> float:
    """Frames per second from the times, snapped to a whole number that agrees to 0.1 %."""
    first, last = min(observed, key=lambda e: e.frame), max(observed, key=lambda e: e.frame)
    if last.time <= first.time:
        raise InputError(f"{listing}: time does not increase with the frame; fix it or give fps in scene.yaml")
    fps = round_if_close((last.frame - first.frame) / (last.time - first.time))
    for entry in observed:
        steps = (entry.time - first.time) * fps
        if frame_of_time(entry.time - first.time, fps) != entry.frame - first.frame or abs(steps - round(steps)) > 0.25:
            raise InputError(
                f"{listing}: {entry.path.name} has time {entry.time:g} s, which is not frame {entry.frame} "
                f"at {fps:g} fps; fix the times or give fps in scene.yaml"
            )
    return fps


def _camera(view: int, observed: list[_Entry], present: list[_Entry], listing: Path) -> Camera:
    mine = [e for e in observed if e.view == view]
    first = mine[0]
    for entry in mine:
        same = np.allclose(entry.world_to_camera, first.world_to_camera, atol=1e-5)
        if not (same and np.allclose(entry.intrinsics, first.intrinsics, atol=1e-3)):
            raise InputError(
                f"{listing}: the camera of view {view} moves between {first.path.name} and {entry.path.name}"
            )
    seen = [e.path for e in present if e.view == view]
    if not seen:
        raise InputError(f"{listing.parent} has none of the pictures of view {view}: remove the view from the listing")
    width, height = common_size(seen, f"view {view} in {listing.parent}")
    return Camera(f"view {view}", width, height, first.intrinsics, first.world_to_camera)


def _extra_pictures(entries: list[_Entry], folder: Path, view_ids: list[int], frame: int) -> dict[int, Path]:
    """Pictures of the empty background or of the occluder, by camera; they need not be listed."""
    listed = {e.view: e.path for e in entries if e.frame == frame}
    paths = {i: listed.get(v, folder / "data" / f"r_{v}_{frame}.png") for i, v in enumerate(view_ids)}
    return {i: path for i, path in paths.items() if path.is_file()}


def _mask_source(path: Path, has_background: bool, has_depth: bool) -> MaskSource:
    if (alpha := _sibling(path, "a")).is_file():
        return MaskSource("alpha", "alpha pictures a_V_F.png", alpha)
    if (cutout := _sibling(path, "m")).is_file():
        return MaskSource("cutout", "cut-outs on white m_V_F.png", cutout)
    if has_background:
        return MaskSource("background", "difference from the background frame −1")
    return DEPTH if has_depth else PLAIN


def _sibling(path: Path, kind: str) -> Path:
    """data/r_V_F.png -> data/m_V_F.png (kind 'm') or data/a_V_F.png (kind 'a')."""
    match = PICTURE.match(path.name)
    assert match is not None
    return path.with_name(f"{kind}_{match['view']}_{match['frame']}.png")


LAYOUT = Layout("PAC-NeRF", "all_data.json or all_data_full.json", can_read, read)
