"""A checkerboard that lies on the ground: unit of length, up axis and ground."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from masiv.errors import InputError
from masiv.footage.calibrated_camera import CalibratedCamera
from masiv.footage.recordings import PICTURES
from masiv.footage.world_frame import LARGEST_MISS, WorldFrame, plane_of, scale_of, triangulate
from masiv.scene.pictures import read_pixels


def parse_board(text: str) -> tuple[int, int, float]:
    """'9x6x0.025' -> inner corners along both sides, edge of a square [m]. Raises InputError."""
    found = re.fullmatch(r"(\d+)x(\d+)x([\d.eE+-]+)", text)
    try:
        columns, rows, square = int(found[1]), int(found[2]), float(found[3])  # type: ignore[index]
    except (TypeError, ValueError):
        columns, rows, square = 0, 0, 0.0
    if min(columns, rows) < 3 or columns == rows or not 0 < square < 10:
        raise InputError(
            f"--board-size {text}: give inner corners along both sides (3 or more, and not as many along both) and the "
            "edge of a square in metres, for example 9x6x0.025"
        )
    return columns, rows, square


def frame_of_board(folder: Path, size: tuple[int, int, float], cameras: Sequence[CalibratedCamera]) -> WorldFrame:
    """Scale, up axis and ground by a checkerboard in the pictures ``folder``/CAMERA.png, one a camera, at one place.

    Raises InputError if fewer than two cameras see it, or if they do not agree about it.
    """
    columns, rows, square = size
    seen: list[tuple[CalibratedCamera, np.ndarray]] = []
    for camera in cameras:
        path = next((p for s in PICTURES if (p := folder / f"{camera.name}{s}").is_file()), None)
        if path is None:
            continue
        picture = read_pixels(path)[..., :3]
        if (picture.shape[1], picture.shape[0]) != (camera.width, camera.height):
            raise InputError(
                f"{path} has another size than the pictures of {camera.name}: take it with the same format"
            )
        grey = cv2.cvtColor(np.ascontiguousarray(picture), cv2.COLOR_RGB2GRAY)
        found, corners = cv2.findChessboardCornersSB(grey, (columns, rows), flags=cv2.CALIB_CB_ACCURACY)
        if found:
            seen.append((camera, corners.reshape(-1, 2) + 0.5))  # OpenCV: pixel centres at whole numbers
    if len(seen) < 2:
        raise InputError(
            f"--board {folder}: a board with {columns}×{rows} inner corners is found in {len(seen)} pictures, two are "
            f"needed: one a camera, named as {cameras[0].name}.png"
        )
    points = _corners(folder, seen).reshape(rows, columns, 3)
    along = np.linalg.norm(np.diff(points, axis=1), axis=-1).mean()
    across = np.linalg.norm(np.diff(points, axis=0), axis=-1).mean()
    metres = scale_of(np.array([along, across]), np.array([square, square]), f"--board {folder}")
    ground = plane_of(metres * points.reshape(-1, 3), cameras, metres, f"--board {folder}")
    return WorldFrame(metres, ground[0], ground)


def _corners(folder: Path, seen: list[tuple[CalibratedCamera, np.ndarray]]) -> np.ndarray:
    """Triangulated corners (N, 3). Half a turn of the board looks the same, so its first corner in each view is found
    by trying, a view at a time: corners agree with those of the views before for one choice only."""
    first, *others = seen
    views, chosen = [first[0]], [first[1]]
    for camera, corners in others:
        views.append(camera)
        choices = [np.stack([*chosen, turned], axis=1) for turned in (corners, corners[::-1])]
        off = [np.mean([triangulate(views, at)[1].max() for at in pixels]) for pixels in choices]
        chosen.append(choices[int(np.argmin(off))][:, -1])
    best = np.stack(chosen, axis=1)
    found = [triangulate(views, at) for at in best]
    worst = max(float(miss.max()) for _, miss in found)
    if worst > LARGEST_MISS * min(camera.width for camera in views):
        raise InputError(
            f"--board {folder}: its corners are up to {worst:.1f} px off from where the cameras together place them: "
            "was it moved between the pictures, or is the calibration of another set-up?"
        )
    return np.array([point for point, _ in found])
