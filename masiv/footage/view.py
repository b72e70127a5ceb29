"""Write what one camera contributes to a new scene."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from masiv.errors import InputError
from masiv.footage.common_frames import MISSING, CommonFrames
from masiv.footage.empty_scene import mean_picture, plate_of, spread
from masiv.footage.pictures import Converter, write_picture
from masiv.footage.recordings import Recording
from masiv.footage.request import ImportRequest

COPIED = (".png", ".jpg", ".jpeg")
"""Formats of pictures that readers of scenes know."""


@dataclass(frozen=True, eq=False)
class View:
    """A camera of the new scene.

    zero [s]: reading of its clock at the common time 0. masks: recording of its masks, frame by frame.
    """

    recording: Recording
    convert: Converter
    zero: float
    masks: Recording | None

    @property
    def name(self) -> str:
        return self.recording.name

    @property
    def times(self) -> np.ndarray:
        """Of its pictures [s, common time], shape (N,)."""
        assert self.recording.times is not None
        return self.recording.times - self.zero


def write_view(
    folder: Path, request: ImportRequest, view: View, frames: CommonFrames, v: int, done: Callable[[int], None]
) -> list[dict[str, Any]]:
    """Write pictures, masks and plate of camera ``v`` into ``folder``, one at a time; their entries in the listing.

    ``done`` is called with the number of pictures written.
    """
    lens = view.convert.written.listing_row()
    images, masks = Path("images") / view.name, Path("masks") / view.name
    taken = [(k, int(index)) for k, index in enumerate(frames.chosen[v]) if index != MISSING]
    rows: list[dict[str, Any]] = []
    plate = _plate(request, view)
    if plate is not None:
        write_picture(folder / images / "empty.png", view.convert(plate))
        rows.append({"file_path": str(images / "empty.png"), "time": -1 / frames.fps, **lens})
    mask_pictures = iter(()) if view.masks is None else view.masks.frames([index for _, index in taken])
    for count, ((k, index), picture) in enumerate(
        zip(taken, view.recording.frames([index for _, index in taken]), strict=True)
    ):
        name = images / f"{k:05d}{_suffix(request, view, index, picture)}"
        _write_frame(folder / name, request, view, index, picture)
        row = {"file_path": str(name), "time": k / frames.fps, **lens}
        mask = _mask(request, view, next(mask_pictures, None), picture, k)
        if mask is not None:
            row["mask_path"] = str(masks / f"{k:05d}.png")
            write_picture(folder / row["mask_path"], view.convert(mask))
        rows.append(row)
        done(count + 1)
    return rows


def _suffix(request: ImportRequest, view: View, index: int, picture: np.ndarray) -> str:
    if _is_copied(request, view):
        return view.recording.files[index].suffix
    return ".png" if request.jpeg is None or picture.shape[-1] == 4 else ".jpg"


def _is_copied(request: ImportRequest, view: View) -> bool:
    """Whether the files are copied: nothing about their pixels changes, and readers know their format."""
    files = view.recording.files
    alike = {file.suffix.lower() for file in files} <= set(COPIED)
    return bool(files) and alike and view.convert.changes_nothing and request.jpeg is None


def _write_frame(path: Path, request: ImportRequest, view: View, index: int, picture: np.ndarray) -> None:
    if _is_copied(request, view):
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(view.recording.files[index], path)
    else:
        write_picture(path, view.convert(picture), request.jpeg if path.suffix == ".jpg" else None)


def _plate(request: ImportRequest, view: View) -> np.ndarray | None:
    if request.plates is not None:
        return plate_of(request.plates, view.recording)
    if request.plate_seconds is None:
        return None
    start, end = request.plate_seconds
    shown = np.flatnonzero((view.times >= start) & (view.times <= end)).tolist()
    if not shown:
        raise InputError(
            f"--plate-seconds {start:g},{end:g}: {view.name} has no frame then, it filmed from {view.times[0]:.3f} to "
            f"{view.times[-1]:.3f} s"
        )
    return mean_picture(view.recording.frames(spread(shown)))


def _mask(
    request: ImportRequest, view: View, given: np.ndarray | None, picture: np.ndarray, frame: int
) -> np.ndarray | None:
    """Mask (H, W) uint8 of a picture as filmed. Raises InputError if one by colour shows nothing at frame 0."""
    if given is not None:
        return np.ascontiguousarray(given[..., :3].max(axis=-1))
    if request.chroma is None:
        return None
    mask = request.chroma.mask(picture)
    share = float((mask > 0).mean())
    if frame == 0 and not 0 < share < 0.95:
        raise InputError(
            f"--chroma {request.chroma.low:g}-{request.chroma.high:g} leaves {share:.0%} of the first picture of "
            f"{view.name}: give the hues of its background in degrees"
        )
    return mask
