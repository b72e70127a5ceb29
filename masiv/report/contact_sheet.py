"""One picture of a scene: a row a view, a column a frame, with the mask's outline, the up axis and the ground. Point
clouds from two sides."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from masiv.report.media import write_png
from masiv.report.world_marks import ARROW, GRID, draw_world
from masiv.scene.scene import Scene
from masiv.subsample import evenly_spread

OUTLINE = (255, 60, 0)
HIDDEN = (90, 90, 200)


@dataclass(frozen=True)
class Marks:
    """What is drawn of the world: centre (3,) [m] of the object at frame 0; length [m] of the arrow upwards and of the
    cells of the ground's grid."""

    centre: np.ndarray
    length: float


def contact_sheet(
    scene: Scene,
    columns: int = 6,
    tile: int = 160,
    notes: Mapping[int, str] | None = None,
    marks: Marks | None = None,
) -> np.ndarray:
    """(H, W, 3) uint8 RGB; ``columns`` frames spread over the scene, each picture ``tile`` pixels wide.

    notes: what is written into the first picture of a view. marks: drawn into every picture.
    """
    frames = evenly_spread(range(scene.frame_count), columns)
    if scene.load_cloud is not None:
        return _clouds(scene, frames, tile, marks)
    rows = [
        np.concatenate([_tile(scene, view, frame, tile, marks) for frame in frames], axis=1) for view in scene.views
    ]
    for row, view in zip(rows, scene.views, strict=True):
        if notes and view in notes:
            _write(row, notes[view], (3, row.shape[0] - 5))
    if marks is not None:
        _write(rows[0], f"up {marks.length:g} m", (tile - 70, 11))
    return np.concatenate(rows, axis=0)


def _clouds(scene: Scene, frames: Sequence[int], tile: int, marks: Marks | None) -> np.ndarray:
    """A row for each of two horizontal directions, ``up`` upwards; darker where there are more points."""
    clouds = [scene.cloud(int(frame)).points for frame in frames]
    seed = np.eye(3)[np.argmin(np.abs(scene.up))]
    across = np.cross(scene.up, seed) / np.linalg.norm(np.cross(scene.up, seed))
    together = np.concatenate(clouds)
    centre, size = (together.min(axis=0) + together.max(axis=0)) / 2, 1.05 * float(np.ptp(together, axis=0).max())
    rows = []
    for row, side in enumerate((across, np.cross(across, scene.up))):
        tiles = []
        for frame, points in zip(frames, clouds, strict=True):
            place = 0.5 + np.stack([(points - centre) @ side, -(points - centre) @ scene.up]) / size
            x, y = np.clip((place * tile).astype(int), 0, tile - 1)
            count = np.bincount(y * tile + x, minlength=tile * tile).reshape(tile, tile)
            grey = np.where(count > 0, 170 - 150 * np.minimum(count, 4) / 4, 245).astype(np.uint8)
            drawn = np.ascontiguousarray(np.repeat(grey[..., None], 3, axis=2))
            drawn[:, -1] = 200
            if marks is not None:
                _mark_cloud(drawn, scene, (centre, size), marks)
            cv2.putText(drawn, f"{row}:{frame}", (3, 11), cv2.FONT_HERSHEY_SIMPLEX, 0.36, (0, 0, 0), 1, cv2.LINE_AA)
            tiles.append(drawn)
        rows.append(np.concatenate(tiles, axis=1))
    return np.concatenate(rows, axis=0)


def _mark_cloud(drawn: np.ndarray, scene: Scene, box: tuple[np.ndarray, float], marks: Marks) -> None:
    """The ground's height as a line, if up is its normal, and a scale of ``marks.length`` upwards at the left side."""
    centre, size = box
    tile = len(drawn)
    if scene.ground is not None and scene.ground.normal @ scene.up > 0.999:
        row = round(tile * (0.5 - (scene.ground.height - float(centre @ scene.up)) / size))
        if 0 <= row < tile:
            drawn[row] = GRID
    long = round(tile * marks.length / size)
    cv2.arrowedLine(drawn, (8, tile - 6), (8, tile - 6 - long), (0, 0, 0), 3, cv2.LINE_AA, 0, 0.2)
    cv2.arrowedLine(drawn, (8, tile - 6), (8, tile - 6 - long), ARROW, 1, cv2.LINE_AA, 0, 0.2)


def write_contact_sheet(
    scene: Scene, path: Path, notes: Mapping[int, str] | None = None, marks: Marks | None = None
) -> None:
    """Write ``contact_sheet(scene, notes=notes, marks=marks)`` as a PNG."""
    write_png(path, contact_sheet(scene, notes=notes, marks=marks))


def outlined(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """A copy of ``image`` (H, W, 3) with the outline of ``mask`` (H, W) drawn one pixel wide."""
    drawn = np.ascontiguousarray(image.copy())
    contours, _ = cv2.findContours((mask > 0.5).astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(drawn, contours, -1, OUTLINE, 1)
    return drawn


def _tile(scene: Scene, view: int, frame: int, width: int, marks: Marks | None) -> np.ndarray:
    picture = scene.frame(view, frame)
    height = max(1, round(width * picture.image.shape[0] / picture.image.shape[1]))
    inter = cv2.INTER_AREA if picture.image.shape[1] > width else cv2.INTER_NEAREST
    image = cv2.resize(picture.image, (width, height), interpolation=inter)
    hidden = cv2.resize((~picture.valid).astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    image[hidden] = (image[hidden] // 2 + np.array(HIDDEN, np.uint8) // 2).astype(np.uint8)
    mask = cv2.resize(picture.mask, (width, height), interpolation=cv2.INTER_LINEAR)
    if marks is not None:
        image = draw_world(image, scene.cameras[view], scene.up, scene.ground, marks.centre, marks.length, mask)
    tile = outlined(image, mask)
    _write(tile, f"{view}:{frame}", (3, 11))
    return tile


def _write(image: np.ndarray, text: str, at: tuple[int, int]) -> None:
    for colour, width in (((0, 0, 0), 2), ((255, 255, 255), 1)):
        cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.36, colour, width, cv2.LINE_AA)
