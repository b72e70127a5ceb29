"""Make a scene folder of footage: the layout of nerfstudio with a time per picture, and a scene.yaml."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from masiv.bounds import DENSITY
from masiv.errors import InputError
from masiv.files import write_json, write_yaml
from masiv.footage import clocks
from masiv.footage.calibration import camera_of, read_calibration
from masiv.footage.common_frames import MISSING, CommonFrames, common_frames
from masiv.footage.pictures import Converter
from masiv.footage.recordings import Recording, find_recordings, open_recording
from masiv.footage.request import ImportRequest
from masiv.footage.times import timed
from masiv.footage.view import View, write_view
from masiv.footage.world import in_metres
from masiv.observations.read import read_scene
from masiv.progress import Progress, silent
from masiv.scene.segmenter import VideoSegmenter

RECORD = "import.json"
"""What was imported from where, in the scene folder."""


def make_scene(request: ImportRequest, out: Path, *, progress: Progress = silent) -> dict[str, Any]:
    """Write the scene to ``out`` and return what was made of it, as ``import.json`` has it.

    Pictures are read and written one at a time. ``out`` appears when it is complete. Raises InputError for whatever of
    the request cannot be used, and if ``out`` holds something already.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"--out {out} holds something already: give a new folder")
    _check_choices(request)
    paths = _paths(request)
    calibration = read_calibration(request.calibration)
    found = [camera_of(calibration, name, request.calibration) for name in paths]
    recordings = [
        timed(open_recording(_plain(name), path), request.times, request.time_unit, _rate(request, name))
        for name, path in paths.items()
    ]
    filmed = [replace(c, name=r.name).resized(*r.size) for c, r in zip(found, recordings, strict=True)]
    placed, world = in_metres(request, filmed)
    zeros = clocks.zeros(recordings, request.sync)
    added = [request.offsets.get(name, 0.0) for name in paths]
    views = [
        View(r, Converter.of(camera, request.downscale), zero + more, _mask_recording(request, r))
        for r, camera, zero, more in zip(recordings, placed, zeros, added, strict=True)
    ]
    frames = common_frames(
        [view.name for view in views],
        [view.times for view in views],
        fps=request.fps, start=request.start, end=request.end, every=request.every,
    )  # fmt: skip
    with _new_folder(out) as folder:
        rows = []
        total = int((frames.chosen != MISSING).sum())
        for v, view in enumerate(views):
            done = int((frames.chosen[:v] != MISSING).sum())
            rows += write_view(
                folder, request, view, frames, v, lambda k, done=done: progress("import", done + k, total)
            )
        write_json(folder / "transforms.json", {"frames": rows})
        declared = {"fps": frames.fps, **{key: world[key] for key in ("up_axis", "ground") if key in world}}
        if request.density is not None:
            declared["density"] = request.density
        write_yaml(folder / "scene.yaml", {**declared, **_segmenter(request, views)})
        record = _record(request, views, frames, world["metres"])
        record["problems"] = _read_back(folder, out) + _problems(views, frames, request)
        write_json(folder / RECORD, record)
    return {"scene": str(out), **record}


def _check_choices(request: ImportRequest) -> None:
    masks = {"--plates": request.plates, "--plate-seconds": request.plate_seconds, "--masks": request.masks,
             "--chroma": request.chroma}  # fmt: skip
    given = [name for name, value in masks.items() if value is not None]
    if len(given) > 1:
        raise InputError(f"{' and '.join(given)} both say the masks: give one")
    if request.segmenter is not None:
        if given and given[0] in ("--masks", "--chroma"):
            raise InputError(f"--segmenter has nothing to do, {given[0]} gives the masks: give one of them")
        VideoSegmenter(request.segmenter).check()
    elif request.boxes:
        raise InputError("--box is for --segmenter: give the folder of its weights")
    if request.jpeg is not None and not 1 <= request.jpeg <= 100:
        raise InputError(f"--jpeg {request.jpeg}: give a quality from 1 to 100")
    if request.density is not None:
        DENSITY.check(request.density, "--density")
    if request.sync == "clap" and request.recorded_fps:
        raise InputError("--sync clap needs the times of the videos, --recorded-fps replaces them: give --sync flash")


def _paths(request: ImportRequest) -> dict[str, Path]:
    """The recordings by name. Raises InputError for one camera only, and for options that name another one."""
    if request.cameras:
        paths = {name: request.footage / path for name, path in request.cameras.items()}
        for name, path in paths.items():
            if not path.exists():
                raise InputError(f"--camera {name}={request.cameras[name]}: {path} is missing")
    else:
        paths = find_recordings(request.footage)
    if len(paths) < 2:
        raise InputError(f"{request.footage} has one recording, {next(iter(paths))}: two cameras or more are needed")
    options = {"--recorded-fps": request.recorded_fps, "--offset": request.offsets, "--box": request.boxes}
    for option, values in options.items():
        if unknown := sorted(values.keys() - paths.keys() - {""}):
            raise InputError(f"{option} names {unknown[0]!r}, the recordings are {', '.join(paths)}")
    plain: dict[str, str] = {}
    for name in paths:
        if other := plain.get(_plain(name)):
            raise InputError(f"cameras {other!r} and {name!r} would have one folder: rename one")
        plain[_plain(name)] = name
    return paths


def _plain(name: str) -> str:
    """``name`` as the name of a folder."""
    return name.replace("/", "_").replace("\\", "_").lstrip(".") or "_"


def _rate(request: ImportRequest, name: str) -> float | None:
    return request.recorded_fps.get(name, request.recorded_fps.get(""))


def _mask_recording(request: ImportRequest, recording: Recording) -> Recording | None:
    if request.masks is None:
        return None
    path = find_recordings(request.masks).get(recording.name)
    if path is None:
        raise InputError(f"--masks {request.masks} has no {recording.name}: give a video or a folder for each camera")
    masks = open_recording(recording.name, path)
    if len(masks) != len(recording) or masks.size != recording.size:
        raise InputError(
            f"{path} has {len(masks)} masks of {masks.size[0]}×{masks.size[1]} pixels, the recording has "
            f"{len(recording)} frames of {recording.size[0]}×{recording.size[1]}: give one mask a frame"
        )
    return masks


@contextmanager
def _new_folder(out: Path) -> Iterator[Path]:
    """A temporary folder beside ``out`` that becomes it, or is removed after an error."""
    out.parent.mkdir(parents=True, exist_ok=True)
    temporary = out.parent / f".{out.name}.{os.getpid()}.tmp"
    temporary.mkdir()
    try:
        yield temporary
        if out.is_dir():
            out.rmdir()
        os.replace(temporary, out)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


def _segmenter(request: ImportRequest, views: Sequence[View]) -> dict[str, Any]:
    if request.segmenter is None:
        return {}
    said: dict[str, Any] = {"segmenter": "sam2", "weights": str(request.segmenter.resolve())}
    boxes, given = {}, {_plain(name): box for name, box in request.boxes.items()}
    for view in views:
        if view.name in given:
            x0, y0, x1, y1 = given[view.name]
            corners = view.convert.point(np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]))
            size = [view.convert.written.width, view.convert.written.height]
            low, high = np.clip(corners.min(axis=0), 0, size), np.clip(corners.max(axis=0), 0, size)
            boxes[view.name] = [*low.tolist(), *high.tolist()]
    return {"masks": {**said, "boxes": boxes} if boxes else said}


def _record(request: ImportRequest, views: Sequence[View], frames: CommonFrames, metres: float) -> dict[str, Any]:
    cameras = []
    for v, view in enumerate(views):
        written, late = view.convert.written, 1e3 * frames.late[v]
        taken = frames.chosen[v] != MISSING
        cameras.append(
            {
                "name": view.name,
                "source": str(view.recording.path.resolve()),
                "width_px": written.width,
                "height_px": written.height,
                "clock_zero_s": view.zero,
                "pictures": int(taken.sum()),
                "late_mean_ms": float(np.nanmean(late)) if taken.any() else None,
                "late_spread_ms": float(np.nanstd(late)) if taken.any() else None,
                "source_frames": [int(k) if k != MISSING else None for k in frames.chosen[v]],
            }
        )
    return {
        "frames": frames.count,
        "fps": frames.fps,
        "first_frame_s": frames.first,
        "metres_per_unit": metres,
        "sync": request.sync,
        "cameras": cameras,
    }


def _read_back(folder: Path, out: Path) -> list[str]:
    """Problems of the scene as it is read. Raises InputError, with the name that the folder will have."""
    try:
        scene = read_scene(folder)
        scene.frame(0, 0)
    except InputError as error:
        raise InputError(str(error).replace(str(folder), str(out))) from error
    return [problem.replace(str(folder), str(out)) for problem in scene.problems]


def _problems(views: Sequence[View], frames: CommonFrames, request: ImportRequest) -> list[str]:
    found = []
    lengths = {view.name: len(view.recording) for view in views}
    if request.sync == "start" and len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
        found.append(
            f"the recordings are taken to begin together, but differ in length ({listed} frames): if one began later "
            "or lost pictures, give --sync flash, --sync clap, --offset or --times"
        )
    half_ms = 250 / frames.fps
    apart = [float(np.nanmean(1e3 * late)) for late in frames.late]
    if max(map(abs, apart)) > half_ms:
        listed = ", ".join(f"{view.name} {ms:+.1f} ms" for view, ms in zip(views, apart, strict=True))
        found.append(
            f"pictures were taken between the common frames ({listed}): identify corrects constant differences, "
            "--keep-calibration would leave them"
        )
    return found
