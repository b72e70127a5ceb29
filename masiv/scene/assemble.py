"""Make a ``Scene`` of the pictures of a reader, the conventions of its layout, and scene.yaml."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from masiv.bounds import FPS
from masiv.errors import InputError
from masiv.scene.camera import check_cameras
from masiv.scene.declaration import SceneDeclaration
from masiv.scene.pictures import ESTIMATED, Pictures, crop_mask
from masiv.scene.scene import Scene
from masiv.scene.segmenter import VideoSegmenter

MAX_LISTED = 8


@dataclass(frozen=True)
class Conventions:
    """Defaults of a layout, for what scene.yaml does not declare.

    up: axis. ground_height [m]: of the plane normal to it, None if the layout has no ground. gravity [m/s²] along −up;
    density [kg/m³]. up_assumed: the files do not define ``up``. Assumptions become ``problems`` unless scene.yaml
    declares the value.
    """

    up: str
    ground_height: float | None
    gravity: float = 9.8
    density: float = 1000.0
    up_assumed: bool = False


def assemble(
    folder: Path,
    layout: str,
    declaration: SceneDeclaration,
    conventions: Conventions,
    pictures: Pictures,
    *,
    fps: float,
    frame_count: int,
    problems: Iterable[str] = (),
) -> Scene:
    """The scene. Raises InputError for a frame or camera without a picture and for a scene.yaml that does not fit."""
    FPS.check(fps, f"{folder}: fps" if declaration.fps is None else f"{folder}/scene.yaml: fps")
    check_cameras(pictures.cameras, str(folder))
    shutters = declaration.shutters(pictures.cameras, fps)
    cameras = tuple(replace(c, shutter=s) for c, s in zip(pictures.cameras, shutters, strict=True))
    pictures = replace(pictures, cameras=cameras)
    if declaration.fit_frames is not None and declaration.fit_frames > frame_count:
        raise InputError(f"scene.yaml: fit_frames is {declaration.fit_frames}, the scene has {frame_count} frames")
    gaps = _gaps(folder, pictures, frame_count)
    up = declaration.up(conventions.up)
    corners = declaration.crop_corners()
    if corners is not None:
        pictures = replace(pictures, crops=tuple(crop_mask(camera, corners) for camera in cameras))
    if declaration.depth_unit is not None:
        pictures = replace(pictures, depth_unit=declaration.depth_unit)
    if declaration.depth_noise is not None:
        pictures = replace(pictures, depth_noise=declaration.depth_noise.noise())
    if declaration.masks is not None:
        beside = folder.parent if folder.is_file() else folder
        weights = beside / Path(declaration.masks.weights).expanduser()
        pictures = pictures.with_segmenter(VideoSegmenter(weights), declaration.masks.boxes_by_view(cameras))
    source, more = pictures.mask_sources()
    estimated = any(mask.kind in ESTIMATED for mask in pictures.masks.values())
    return Scene(
        path=folder,
        layout=layout,
        fps=fps,
        frame_count=frame_count,
        cameras=cameras,
        gravity=declaration.gravity_vector(up, conventions.gravity),
        up=up,
        ground=declaration.ground_plane(up, conventions.ground_height),
        density=declaration.density or conventions.density,
        load=pictures.load,
        mask_source=source,
        masks_estimated=estimated,
        load_with_mask=pictures.load if estimated else None,
        mask_inputs=partial(_mask_inputs, pictures, declaration) if estimated else None,
        background=pictures.background,
        problems=(*problems, *guesses(declaration, conventions), *gaps, *more, *pictures.depth_problems()),
        fit_frames=declaration.fit_frames,
        depth_noise=pictures.depth_noise if pictures.depths else None,
        missing=frozenset((v, k) for v in range(len(cameras)) for k in range(frame_count)) - pictures.paths.keys(),
    )


def _mask_inputs(pictures: Pictures, declaration: SceneDeclaration) -> list[Any]:
    return [declaration.model_dump(mode="json"), *pictures.mask_inputs()]


def guesses(declaration: SceneDeclaration, conventions: Conventions) -> list[str]:
    """A sentence for each convention that the files neither define nor contradict."""
    found = []
    if conventions.up_assumed and declaration.up_axis is None:
        found.append(f"the layout does not say which way is up: +{conventions.up} is taken, as is usual in it")
    if conventions.ground_height is None and declaration.ground is None:
        found.append(
            "the layout says nothing of a ground: none is assumed; if the object touches one, give ground in scene.yaml"
        )
    return found


def _gaps(folder: Path, pictures: Pictures, frame_count: int) -> list[str]:
    """One sentence for each camera that lacks frames, or one for all if there are many."""
    lacking: dict[int, list[int]] = {}
    for view, camera in enumerate(pictures.cameras):
        missing = [frame for frame in range(frame_count) if (view, frame) not in pictures.paths]
        if len(missing) == frame_count:
            raise InputError(f"{folder} has none of the pictures of {camera.name}: remove it from the listing")
        if missing:
            lacking[view] = missing
    empty = sorted(set(range(frame_count)) - {frame for _, frame in pictures.paths})
    if 0 in empty:
        raise InputError(f"{folder} has no picture of any view at frame 0: the motion begins there, remove it")
    if len(lacking) == len(pictures.cameras) and all(len(gaps) == frame_count - 1 for gaps in lacking.values()):
        return [
            f"every one of the {len(lacking)} cameras sees one frame only, as with one camera that moves: "
            "depth cannot be triangulated at any instant"
        ]
    lacking = {view: left for view, gaps in lacking.items() if (left := [k for k in gaps if k not in empty])}
    told = [
        f"{pictures.cameras[view].name} has no picture at frame {format_ranges(missing)}"
        for view, missing in list(lacking.items())[:MAX_LISTED]
    ]
    if len(lacking) > MAX_LISTED:
        told = [f"{len(lacking)} of {len(pictures.cameras)} cameras lack frames ({'; '.join(told)}; …)"]
    told = [f"{sentence}: treated as not visible" for sentence in told]
    if empty:
        told.append(f"no camera has a picture at frame {format_ranges(empty)}: the motion is interpolated there")
    return told


def format_ranges(numbers: list[int]) -> str:
    """Ascending integers as text: 0–3, 7."""
    runs: list[list[int]] = []
    for value in numbers:
        if runs and value == runs[-1][-1] + 1:
            runs[-1].append(value)
        else:
            runs.append([value])
    return ", ".join(f"{run[0]}" if len(run) == 1 else f"{run[0]}–{run[-1]}" for run in runs)
