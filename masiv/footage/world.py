"""The cameras of a request in metres, and what scene.yaml says of the world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from masiv.bounds import LENGTH
from masiv.errors import InputError
from masiv.footage.board import frame_of_board
from masiv.footage.calibrated_camera import CalibratedCamera
from masiv.footage.request import ImportRequest
from masiv.footage.world_frame import (
    WorldFrame,
    baseline,
    check_distances,
    frame_of,
    read_landmarks,
)
from masiv.scene.declaration import AXES


def in_metres(
    request: ImportRequest, cameras: Sequence[CalibratedCamera]
) -> tuple[list[CalibratedCamera], dict[str, Any]]:
    """``cameras``, of the footage's size, in metres, and the keys up_axis and ground of scene.yaml.

    Raises InputError if two options say the unit of length, or if none does and the calibration has none.
    """
    landmarks = None if request.landmarks is None else read_landmarks(request.landmarks)
    given = {
        "--scale": request.scale is not None,
        "--baseline": request.baseline is not None,
        "--landmarks (distances)": landmarks is not None and bool(landmarks.distances),
        "--board": request.board is not None,
    }
    sources = [name for name, has in given.items() if has]
    if len(sources) > 1:
        raise InputError(f"{' and '.join(sources)} both say the unit of length: give one")
    if not sources and request.calibration.suffix not in (".toml", ".json"):
        raise InputError(
            f"{request.calibration}: COLMAP's unit of length is arbitrary: give --baseline, --landmarks or --board, or "
            "--scale with the metres of a unit"
        )
    found = WorldFrame()
    if landmarks is not None:
        assert request.landmarks is not None
        found = frame_of(landmarks, cameras, request.landmarks)
    elif request.board is not None:
        if request.board_size is None:
            raise InputError("--board needs --board-size, for example 9x6x0.025")
        found = frame_of_board(request.board, request.board_size, cameras)
    metres = found.metres
    if request.scale is not None:
        if not request.scale > 0:
            raise InputError(f"--scale {request.scale:g}: metres of a unit of the calibration are positive")
        LENGTH.check(request.scale, "--scale")
        metres = request.scale
    if request.baseline is not None:
        one, other, length = request.baseline
        metres = baseline(cameras, (one, other), length)
    if landmarks is not None and not landmarks.distances and found.ground is not None:
        found = WorldFrame(metres, found.up, (found.ground[0], found.ground[1] * metres))
    placed = [camera.scaled(metres) for camera in cameras]
    check_distances(placed)
    return placed, {"metres": metres, **_declared(request, found)}


def _declared(request: ImportRequest, found: WorldFrame) -> dict[str, Any]:
    up: Any = request.up
    if up is None and found.up is not None:
        up = found.up
    vector = _vector(up)
    said: dict[str, Any] = {}
    if vector is not None:
        said["up_axis"] = up if isinstance(up, str) else vector.tolist()
    if request.ground == "none":
        said["ground"] = "none"
    elif request.ground is not None:
        if vector is None:
            raise InputError("--ground is a height along the up axis: give --up as well")
        said["ground"] = {"normal": vector.tolist(), "height": float(request.ground)}
    elif found.ground is not None:
        normal, height = found.ground
        if vector is not None and normal @ vector < 0:
            raise InputError("--up points away from the side of the ground on which the cameras are: turn it round")
        said["ground"] = {"normal": normal.tolist(), "height": height}
    return said


def _vector(up: str | np.ndarray | None) -> np.ndarray | None:
    if up is None:
        return None
    if isinstance(up, str):
        axis = up.strip().lstrip("+")
        if axis.lstrip("-") not in AXES:
            raise InputError(f"--up {up}: give x, y, z, with a minus sign, or three numbers with commas")
        return (-1.0 if axis.startswith("-") else 1.0) * np.array(AXES[axis.lstrip("-")]) + 0.0
    length = float(np.linalg.norm(up))
    if not length > 1e-9:
        raise InputError("--up is zero, it must be a direction")
    return np.asarray(up) / length
