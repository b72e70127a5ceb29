"""The PAC-NeRF layout (Li et al., ICLR 2023), also that of MASIV's multi-sequence scenes.

``all_data.json`` lists {file_path, c2w, intrinsic, time}; pictures are ``data/r_V_F.png`` for view V and frame F,
frame −1 the empty background, frame −2 an occluder. World: metres, y up, gravity 9.8 m/s² down, sticky ground at y = 0.
"""

from __future__ import annotations

import json
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from masiv.errors import InputError
from masiv.scene import masks
from masiv.scene.camera import Camera
from masiv.scene.declaration import SceneDeclaration
from masiv.scene.scene import Frame, Scene
from masiv.scene.transforms import frame_of_time, opengl_c2w_to_world_to_camera

LOOKED_FOR = "all_data.json or all_data_full.json"
NAMES = ("all_data_full.json", "all_data.json")
PICTURE = re.compile(r"^(?P<prefix>.*?)(?P<view>\d+)_(?P<frame>-?\d+)\.(png|jpg|jpeg)$", re.IGNORECASE)
BACKGROUND, OCCLUDER = -1, -2
OCCLUDER_ALPHA = 50
DENSITY = 1000.0
GRAVITY = 9.8


@dataclass(frozen=True)
class _Entry:
    view: int
    frame: int
    path: Path
    time: float
    intrinsics: np.ndarray
    world_to_camera: np.ndarray


def recognises(folder: Path) -> bool:
    """Whether ``folder`` has this layout."""
    return any((folder / name).is_file() for name in NAMES)


def read(folder: Path, declaration: SceneDeclaration) -> Scene:
    """The scene in ``folder``. Raises InputError for an unusable listing, camera, time or set of pictures."""
    listing = next(folder / name for name in NAMES if (folder / name).is_file())
    entries = _entries(folder, listing)
    observed = [e for e in entries if e.frame >= 0]
    if not observed:
        raise InputError(f"{listing} lists no picture with a frame of 0 or more")
    view_ids = sorted({e.view for e in observed})
    frame_count = _frame_count(observed, listing)
    fps = declaration.fps or _fps(observed, listing)
    present = [e for e in observed if e.path.is_file() and e.path.stat().st_size > 0]
    problems = _missing(view_ids, frame_count, present, listing)
    cameras = tuple(_camera(view, observed, present, listing) for view in view_ids)
    up = declaration.up("y")
    corners = declaration.crop_corners()
    reader = _Pictures(
        paths={(view_ids.index(e.view), e.frame): e.path for e in present},
        cameras=cameras,
        backgrounds=_special(entries, folder, view_ids, BACKGROUND),
        occluders=_special(entries, folder, view_ids, OCCLUDER),
        crops=None if corners is None else tuple(_crop(camera, corners) for camera in cameras),
    )
    source, more = reader.mask_sources()
    if declaration.fit_frames is not None and declaration.fit_frames > frame_count:
        raise InputError(f"scene.yaml: fit_frames is {declaration.fit_frames}, the scene has {frame_count} frames")
    return Scene(
        path=folder,
        layout="pacnerf",
        fps=fps,
        frame_count=frame_count,
        cameras=cameras,
        gravity=declaration.gravity_vector(up, GRAVITY),
        up=up,
        ground=declaration.ground_plane(up, 0.0),
        density=declaration.density or DENSITY,
        load=reader.load,
        mask_source=source,
        background=reader.background,
        problems=(*problems, *more),
        fit_frames=declaration.fit_frames,
    )


def _entries(folder: Path, listing: Path) -> list[_Entry]:
    try:
        rows: Any = json.loads(listing.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"{listing} is not valid JSON: {error}") from error
    if not isinstance(rows, list) or not rows:
        raise InputError(f"{listing} must be a list with one entry a picture")
    entries: dict[tuple[int, int], _Entry] = {}
    for number, row in enumerate(rows):
        where = f"{listing}, entry {number}"
        try:
            name, pose, intrinsic, time = row["file_path"], row["c2w"], row["intrinsic"], float(row["time"])
            intrinsics = np.array(intrinsic, dtype=np.float64)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{where}: needs file_path, c2w, intrinsic (3×3) and time, has a bad {error}") from error
        match = PICTURE.match(Path(name).name)
        if match is None:
            raise InputError(f"{where}: '{name}' does not read as …_VIEW_FRAME.png")
        if intrinsics.shape != (3, 3) or not np.isfinite(intrinsics).all() or min(np.diag(intrinsics)) <= 0:
            raise InputError(f"{where}: intrinsic must be 3×3, finite, with positive focal lengths")
        if not np.isfinite(time):
            raise InputError(f"{where}: time is {time}")
        try:
            world_to_camera = opengl_c2w_to_world_to_camera(pose)
        except (InputError, ValueError) as error:
            raise InputError(f"{where}: {error}") from error
        key = int(match["view"]), int(match["frame"])
        if key in entries:
            raise InputError(f"{where}: view {key[0]}, frame {key[1]} is listed twice")
        entries[key] = _Entry(*key, folder / name, time, intrinsics, world_to_camera)
    return list(entries.values())


def _frame_count(observed: list[_Entry], listing: Path) -> int:
    frames = sorted({e.frame for e in observed})
    missing = sorted(set(range(frames[-1] + 1)) - set(frames))
    if missing:
        raise InputError(
            f"{listing} has no picture of any view at frame {missing[0]}: frames must run from 0 without gaps"
        )
    if len(frames) < 2:
        raise InputError(f"{listing} has one frame only: a motion needs two or more")
    return len(frames)


def _fps(observed: list[_Entry], listing: Path) -> float:
    """Frames per second from the times, snapped to a whole number that agrees to 0.1 %."""
    first, last = min(observed, key=lambda e: e.frame), max(observed, key=lambda e: e.frame)
    if last.time <= first.time:
        raise InputError(f"{listing}: time does not increase with the frame; fix it or give fps in scene.yaml")
    fps = (last.frame - first.frame) / (last.time - first.time)
    fps = float(round(fps)) if abs(fps - round(fps)) < 1e-3 * fps else fps
    for entry in observed:
        steps = (entry.time - first.time) * fps
        if frame_of_time(entry.time - first.time, fps) != entry.frame - first.frame or abs(steps - round(steps)) > 0.25:
            raise InputError(
                f"{listing}: {entry.path.name} has time {entry.time:g} s, which is not frame {entry.frame} "
                f"at {fps:g} fps; fix the times or give fps in scene.yaml"
            )
    return fps


def _missing(view_ids: list[int], frame_count: int, present: list[_Entry], listing: Path) -> list[str]:
    have = {(e.view, e.frame) for e in present}
    problems = []
    for view in view_ids:
        gaps = [f for f in range(frame_count) if (view, f) not in have]
        if len(gaps) == frame_count:
            raise InputError(
                f"{listing.parent} has none of the pictures of view {view}: remove the view from the listing"
            )
        if gaps:
            problems.append(f"view {view} has no picture at frame {', '.join(map(str, gaps))}: treated as not visible")
    for frame in range(frame_count):
        if not any((view, frame) in have for view in view_ids):
            raise InputError(f"{listing.parent} has no picture of any view at frame {frame}")
    return problems


def _camera(view: int, observed: list[_Entry], present: list[_Entry], listing: Path) -> Camera:
    mine = [e for e in observed if e.view == view]
    first = mine[0]
    for entry in mine:
        same = np.allclose(entry.world_to_camera, first.world_to_camera, atol=1e-5)
        if not (same and np.allclose(entry.intrinsics, first.intrinsics, atol=1e-3)):
            raise InputError(
                f"{listing}: the camera of view {view} moves between {first.path.name} and {entry.path.name}"
            )
    sizes = {_size(e.path): e.path for e in present if e.view == view}
    if len(sizes) > 1:
        listed = ", ".join(f"{path.name} {w}×{h}" for (w, h), path in sizes.items())
        raise InputError(f"pictures of view {view} in {listing.parent} differ in size: {listed}")
    width, height = next(iter(sizes))
    return Camera(f"view {view}", width, height, first.intrinsics, first.world_to_camera)


def _size(path: Path) -> tuple[int, int]:
    """Width and height, from the header where the file is a PNG."""
    with path.open("rb") as file:
        head = file.read(24)
    if head[:8] == b"\x89PNG\r\n\x1a\n" and len(head) == 24:
        return struct.unpack(">II", head[16:24])
    height, width = _pixels(path).shape[:2]
    return width, height


def _special(entries: list[_Entry], folder: Path, view_ids: list[int], frame: int) -> dict[int, Path]:
    """Pictures of the empty background or of the occluder, by camera; they need not be listed."""
    listed = {e.view: e.path for e in entries if e.frame == frame}
    paths = {i: listed.get(v, folder / "data" / f"r_{v}_{frame}.png") for i, v in enumerate(view_ids)}
    return {i: path for i, path in paths.items() if path.is_file()}


def _crop(camera: Camera, corners: np.ndarray) -> np.ndarray:
    """Pixels (H, W) bool that the crop box covers; all of them for a box that reaches behind the camera."""
    pixels, depth = camera.project(corners)
    if depth.min() <= 1e-6:
        return np.ones((camera.height, camera.width), bool)
    hull = cv2.convexHull(np.clip(pixels, -1e6, 1e6).astype(np.int32))
    return cv2.fillConvexPoly(np.zeros((camera.height, camera.width), np.uint8), hull, 1).astype(bool)


def _pixels(path: Path) -> np.ndarray:
    """(H, W, 3) RGB or (H, W, 4) RGBA, uint8."""
    decoded = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if decoded is None:
        raise InputError(f"{path} cannot be read as a picture: replace it or remove it from the listing")
    raw = np.asarray(decoded)
    if raw.dtype == np.uint16:
        raw = (raw // 256).astype(np.uint8)
    if raw.ndim == 2:
        return np.repeat(raw[..., None], 3, axis=-1)
    return np.ascontiguousarray(raw[..., [2, 1, 0, 3][: raw.shape[-1]]])


@dataclass(frozen=True)
class _Pictures:
    """Reads pictures and masks. Keys of ``paths`` are (camera index, frame); of the others, camera indices."""

    paths: dict[tuple[int, int], Path]
    cameras: tuple[Camera, ...]
    backgrounds: dict[int, Path]
    occluders: dict[int, Path]
    crops: tuple[np.ndarray, ...] | None

    def load(self, view: int, frame: int) -> Frame:
        camera = self.cameras[view]
        shape = camera.height, camera.width
        path = self.paths.get((view, frame))
        if path is None:  # listed in Scene.problems: nothing was seen
            return Frame(np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.float32), np.zeros(shape, bool))
        image = self._read(path, shape)
        mask = self._mask(view, path, image)
        valid = np.ones(shape, bool)
        if view in self.occluders:
            occluder = self._read(self.occluders[view], shape)
            if occluder.shape[-1] == 4:
                valid = occluder[..., 3] <= OCCLUDER_ALPHA
        if self.crops is not None:
            mask = mask * self.crops[view]
        return Frame(image[..., :3], mask, valid)

    def background(self, view: int) -> np.ndarray | None:
        """The empty scene in ``view``, (H, W, 3) uint8, where there is a picture of it."""
        if view not in self.backgrounds:
            return None
        camera = self.cameras[view]
        return self._read(self.backgrounds[view], (camera.height, camera.width))[..., :3]

    def mask_sources(self) -> tuple[str, list[str]]:
        """The main source of the masks, in words, and a problem for each picture set that has another one."""
        kinds: dict[str, list[str]] = {}
        for (view, _), path in self.paths.items():
            kinds.setdefault(self._source(view, path), []).append(path.name)
        main, *others = sorted(kinds, key=lambda kind: -len(kinds[kind]))
        problems = [f"{len(kinds[o])} pictures ({kinds[o][0]}, …) take their mask from {o}" for o in others]
        if any(self._read(p, None).shape[-1] != 4 for p in self.occluders.values()):
            problems.append("the occluder pictures (frame −2) have no alpha channel and are ignored")
        return main, problems

    def _source(self, view: int, path: Path) -> str:
        if _beside(path, "a").is_file():
            return "alpha pictures a_V_F.png"
        if _beside(path, "m").is_file():
            return "cut-outs on white m_V_F.png"
        return "difference from the background frame −1" if view in self.backgrounds else "plain background"

    def _mask(self, view: int, path: Path, image: np.ndarray) -> np.ndarray:
        shape = image.shape[:2]
        alpha, cutout = _beside(path, "a"), _beside(path, "m")
        if alpha.is_file():
            pixels = self._read(alpha, shape)
            return pixels[..., 3 if pixels.shape[-1] == 4 else 0].astype(np.float32) / 255
        if cutout.is_file():
            return masks.from_white(self._read(cutout, shape)[..., :3], image[..., :3])
        if view in self.backgrounds:
            return masks.from_background(image[..., :3], self._read(self.backgrounds[view], shape)[..., :3])
        return masks.from_plain_background(image[..., :3])

    def _read(self, path: Path, shape: tuple[int, int] | None) -> np.ndarray:
        pixels = _pixels(path)
        if shape is not None and pixels.shape[:2] != tuple(shape):
            h, w = pixels.shape[:2]
            raise InputError(f"{path} is {w}×{h}, the other pictures of its view are {shape[1]}×{shape[0]}")
        return pixels


def _beside(path: Path, kind: str) -> Path:
    """data/r_V_F.png -> data/m_V_F.png (kind 'm') or data/a_V_F.png (kind 'a')."""
    match = PICTURE.match(path.name)
    assert match is not None
    return path.with_name(f"{kind}_{match['view']}_{match['frame']}.png")
