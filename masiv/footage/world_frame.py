"""Unit of length, up axis and ground of the world of a calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from masiv.bounds import LENGTH
from masiv.errors import InputError
from masiv.footage.calibrated_camera import CalibratedCamera
from masiv.strict import read_yaml, validated

LARGEST_MISS = 0.01
"""Of the width of the picture: a landmark farther from its triangulated point is a wrong click or camera. Chosen."""
FAR_APART = 100.0
"""Distance of two cameras [m] that no one films an object of a table or a room with."""
Pixel = tuple[FiniteFloat, FiniteFloat]


class Landmarks(BaseModel):
    """Points that are seen in two or more cameras, and what is known of them.

    points: name -> camera -> (x, y) [pixels of the footage, from its top left corner]. distances: (name, name, metres).
    ground: names of three or more points on the ground. up: two names; the up axis goes from the first to the second.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    points: dict[str, dict[str, Pixel]]
    distances: tuple[tuple[str, str, Annotated[FiniteFloat, Field(gt=0)]], ...] = ()
    ground: tuple[str, ...] = ()
    up: tuple[str, str] | None = None


@dataclass(frozen=True)
class WorldFrame:
    """metres: of one unit of the calibration. up: unit vector (3,) or None. ground: (normal, height [m]) or None."""

    metres: float = 1.0
    up: np.ndarray | None = None
    ground: tuple[np.ndarray, float] | None = None


def read_landmarks(path: Path) -> Landmarks:
    """Raises InputError for unknown keys, names without a point, and fewer than three points of a ground."""
    landmarks = validated(Landmarks, read_yaml(path), str(path))
    named = (
        {name for a, b, _ in landmarks.distances for name in (a, b)} | set(landmarks.ground) | set(landmarks.up or ())
    )
    if unknown := sorted(named - landmarks.points.keys()):
        raise InputError(f"{path}: {unknown[0]!r} is not among the points: {', '.join(landmarks.points)}")
    if landmarks.ground and len(set(landmarks.ground)) < 3:
        raise InputError(f"{path}: ground needs three points or more")
    return landmarks


def frame_of(landmarks: Landmarks, cameras: Sequence[CalibratedCamera], where: Path) -> WorldFrame:
    """Scale, up axis and ground that ``landmarks`` say; ``cameras`` are those of the footage, in its size."""
    by_name = {camera.name: camera for camera in cameras}
    points: dict[str, np.ndarray] = {}
    for name, seen in landmarks.points.items():
        if unknown := sorted(seen.keys() - by_name.keys()):
            raise InputError(f"{where}: point {name!r} names camera {unknown[0]!r}, there are {', '.join(by_name)}")
        views = [by_name[camera] for camera in seen]
        points[name], miss = triangulate(views, np.array(list(seen.values())))
        worst = int(np.argmax(miss))
        if miss[worst] > LARGEST_MISS * views[worst].width:
            raise InputError(
                f"{where}: point {name!r} is {miss[worst]:.1f} px off in {views[worst].name} from where its cameras "
                "together place it: correct the pixels, or the calibration"
            )
    metres = 1.0
    if landmarks.distances:
        lengths = np.array([np.linalg.norm(points[a] - points[b]) for a, b, _ in landmarks.distances])
        metres = scale_of(lengths, np.array([d for *_, d in landmarks.distances]), str(where))
    up = None
    if landmarks.up is not None:
        up = points[landmarks.up[1]] - points[landmarks.up[0]]
        if np.linalg.norm(up) < 1e-9:
            raise InputError(f"{where}: the two points of up are in one place")
        up = up / np.linalg.norm(up)
    ground = None
    if landmarks.ground:
        ground = plane_of(metres * np.array([points[name] for name in landmarks.ground]), cameras, metres, str(where))
    return WorldFrame(metres, up if up is not None or ground is None else ground[0], ground)


def triangulate(cameras: Sequence[CalibratedCamera], pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The point (3,) that ``cameras`` see at ``pixels`` (V, 2), and by how far each misses it (V,) [pixels].

    Linear least squares (Hartley & Zisserman, Multiple View Geometry, 2004, section 12.2). Raises InputError for one
    camera, and for rays that are parallel.
    """
    if len(cameras) < 2:
        raise InputError("a landmark must be seen in two cameras or more")
    rows, rays = [], []
    for camera, pixel in zip(cameras, pixels, strict=True):
        ray, pose = camera.rays(pixel[None])[0], camera.world_to_camera
        rows += [ray[0] * pose[2] - pose[0], ray[1] * pose[2] - pose[1]]
        rays.append(ray)
    system = np.array(rows)
    point, _, rank, _ = np.linalg.lstsq(system[:, :3], -system[:, 3], rcond=1e-9)
    if rank < 3:
        raise InputError(f"{cameras[0].name} and {cameras[1].name} see a landmark along one line: use other cameras")
    miss = []
    for camera, ray in zip(cameras, rays, strict=True):
        x, y, z = camera.world_to_camera[:3] @ np.append(point, 1.0)
        off = np.hypot(x / z - ray[0], y / z - ray[1]) if z > 0 else np.inf
        miss.append(float(camera.intrinsics[0, 0] * off))
    return point, np.array(miss)


def scale_of(lengths: np.ndarray, metres: np.ndarray, where: str) -> float:
    """Metres of one unit, by least squares over known distances. InputError if they contradict each other by 5 %."""
    if (lengths < 1e-12).any():
        raise InputError(f"{where}: two points of a known distance are in one place")
    scale = float(lengths @ metres / (lengths @ lengths))
    off = np.abs(lengths * scale / metres - 1)
    if off.max() > 0.05:
        raise InputError(f"{where}: the known distances contradict each other by {off.max():.0%}: measure them again")
    LENGTH.check(scale, f"{where}: scale")
    return scale


def plane_of(
    points: np.ndarray, cameras: Sequence[CalibratedCamera], metres: float, where: str
) -> tuple[np.ndarray, float]:
    """The plane through ``points`` (N, 3) [m]: its normal (3,), on the side of the cameras, and its height [m]."""
    middle = points.mean(axis=0)
    _, size, axes = np.linalg.svd(points - middle)
    if size[1] < 1e-3 * size[0]:
        raise InputError(f"{where}: the points of the ground are on one line: give three that are not")
    above = np.mean([metres * camera.centre for camera in cameras], axis=0) - middle
    normal = axes[2] * (1.0 if axes[2] @ above > 0 else -1.0)
    return normal, float(normal @ middle)


def baseline(cameras: Sequence[CalibratedCamera], pair: tuple[str, str], metres: float) -> float:
    """Metres of one unit, from the distance of the optical centres of two cameras."""
    by_name = {camera.name: camera for camera in cameras}
    where = f"--baseline {','.join(pair)}"
    for name in pair:
        if name not in by_name:
            raise InputError(f"{where}: there is no camera {name!r}, only {', '.join(by_name)}")
    length = np.linalg.norm(by_name[pair[0]].centre - by_name[pair[1]].centre)
    if not metres > 0:
        raise InputError(f"{where}={metres:g}: a distance is positive")
    return scale_of(np.array([length]), np.array([metres]), where)


def check_distances(cameras: Sequence[CalibratedCamera]) -> None:
    """Raises InputError if two cameras are farther apart than in any room, as with a calibration in millimetres."""
    apart = max((float(np.linalg.norm(a.centre - b.centre)) for a, b in combinations(cameras, 2)), default=0.0)
    if apart > FAR_APART:
        raise InputError(
            f"two cameras would be {apart:.0f} m apart: if the calibration is in millimetres, give --scale 0.001"
        )
