"""From where a simulation is drawn: a camera of the scene, one that stands anywhere, or one that circles the body."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from masiv.bounds import LENGTH
from masiv.errors import InputError
from masiv.scene.camera import Camera

FIELD_OF_VIEW = math.radians(40)
"""Of the shorter side of a picture that no camera of the scene takes."""
DEFAULT_SIZE = 640, 480
"""Width and height [px] of such a picture."""
MAX_SIDE = 8192
"""Longest side of a picture [px]: H.264 has no larger ones that players show."""
MARGIN = 1.15
"""Distance of an orbit over the one from which the motion just fits into the picture."""
EXAMPLE = "give an index or a name of the scene's cameras, free:X,Y,Z,LX,LY,LZ or orbit:turns=1,elevation=20"


@dataclass(frozen=True)
class SceneView:
    """A camera of the scene, by index or name."""

    which: str


@dataclass(frozen=True)
class FreeView:
    """A camera at ``position`` (3,) [m, world] that looks at ``target`` (3,) [m, world]."""

    position: np.ndarray
    target: np.ndarray


@dataclass(frozen=True)
class OrbitView:
    """A camera that circles the body: so many ``turns`` in the whole motion, counter-clockwise seen from above;
    elevation [deg] above the horizontal; distance [m] from the middle of the motion (None: so that all of it fits)."""

    turns: float = 1.0
    elevation: float = 20.0
    distance: float | None = None


View = SceneView | FreeView | OrbitView


@dataclass(frozen=True)
class Viewpoint:
    """Its name in files, and its camera at each frame."""

    name: str
    cameras: tuple[Camera, ...]


def parse_view(text: str) -> View:
    """The view that --camera ``text`` asks for. Raises InputError."""
    kind, colon, rest = text.strip().partition(":")
    if kind == "free" and colon:
        values = _numbers(rest.split(","), text)
        if len(values) != 6:
            raise InputError(f"--camera {text[:60]}: free needs six numbers [m], three of its place, three to look at")
        position, target = np.array(values[:3]), np.array(values[3:])
        for what, place in (("the place", position), ("what it looks at", target)):
            LENGTH.check(place, f"--camera {text[:60]}, {what}")
        if np.allclose(position, target):
            raise InputError(f"--camera {text[:60]}: the camera stands where it should look, give two places")
        return FreeView(position, target)
    if kind == "orbit":
        return _orbit(rest, text)
    return SceneView(text.strip())


def _orbit(rest: str, text: str) -> OrbitView:
    given: dict[str, float] = {}
    for part in filter(None, rest.split(",")):
        name, equals, value = part.partition("=")
        if name.strip() not in ("turns", "elevation", "distance") or not equals:
            raise InputError(f"--camera {text[:60]}: an orbit has turns, elevation [deg] and distance [m]; {EXAMPLE}")
        given[name.strip()] = _numbers([value], text)[0]
    orbit = OrbitView(**given)
    if not -89 <= orbit.elevation <= 89:
        raise InputError(f"--camera {text[:60]}: the elevation must be between -89 and 89 degrees")
    if abs(orbit.turns) > 1000:
        raise InputError(f"--camera {text[:60]}: give at most 1000 turns")
    if orbit.distance is not None:
        LENGTH.check(orbit.distance, f"--camera {text[:60]}, distance")
        if orbit.distance <= 0:
            raise InputError(f"--camera {text[:60]}: the distance must be above 0 m")
    return orbit


def _numbers(parts: Sequence[str], text: str) -> list[float]:
    try:
        values = [float(part) for part in parts]
    except ValueError:
        values = [math.nan]
    if not all(map(math.isfinite, values)):
        raise InputError(f"--camera {text[:60]}: {EXAMPLE}")
    return values


def parse_size(text: str | None) -> tuple[int, int] | None:
    """Width and height [px] of --size ``text``, for example 640x480. Raises InputError."""
    if text is None:
        return None
    width, _, height = text.lower().replace("×", "x").partition("x")
    if not (width.isascii() and height.isascii() and width.isdigit() and height.isdigit()):
        raise InputError(f"--size {text[:40]}: give width and height in pixels, for example --size 640x480")
    if not all(len(side) < 6 and 16 <= int(side) <= MAX_SIDE for side in (width, height)):
        raise InputError(f"--size {text[:40]}: give 16 to {MAX_SIDE} pixels a side")
    return int(width), int(height)


def scene_camera(view: SceneView, cameras: Sequence[Camera]) -> tuple[int, Camera]:
    """Index and camera of ``view``; a name goes before an index. Raises InputError for one that is not there."""
    names = [camera.name for camera in cameras]
    if view.which in names:
        index = names.index(view.which)
        return index, cameras[index]
    if view.which.isascii() and view.which.isdigit() and len(view.which) < 6 and int(view.which) < len(cameras):
        return int(view.which), cameras[int(view.which)]
    if not cameras:
        raise InputError(f"--camera {view.which[:60]}: the scene has no cameras; use orbit, or free:…")
    raise InputError(
        f"--camera {view.which[:60]}: the scene has cameras 0 to {len(cameras) - 1} ({', '.join(names[:20])}); or use "
        "orbit, or free:…"
    )


def viewpoints(
    views: Sequence[View],
    cameras: Sequence[Camera],
    motion: np.ndarray,
    up: np.ndarray,
    size: tuple[int, int] | None = None,
) -> list[Viewpoint]:
    """``views`` of ``motion`` (T, Q, 3) [m, world] with up axis ``up`` (3,). cameras: of the scene. size: width and
    height [px] of every picture (None: that of the camera, or ``DEFAULT_SIZE``). Raises InputError."""
    frames = len(motion)
    found: list[Viewpoint] = []
    for view in views:
        if isinstance(view, SceneView):
            index, camera = scene_camera(view, cameras)
            found.append(Viewpoint(str(index), (resized(camera, *size) if size else camera,) * frames))
        elif isinstance(view, FreeView):
            camera = looking_at(view.position, view.target, up, size or DEFAULT_SIZE)
            found.append(Viewpoint(_free_name("free", found), (camera,) * frames))
        else:
            found.append(Viewpoint(_free_name("orbit", found), _circle(view, motion, up, size or DEFAULT_SIZE)))
    return found


def _free_name(kind: str, before: Sequence[Viewpoint]) -> str:
    same = sum(viewpoint.name.rstrip("0123456789") == kind for viewpoint in before)
    return kind if not same else f"{kind}{same + 1}"


def resized(camera: Camera, width: int, height: int) -> Camera:
    """``camera`` with pictures of another size: all that it sees, as large as fits and in the middle."""
    factor = min(width / camera.width, height / camera.height)
    intrinsics = camera.intrinsics * np.array([[factor], [factor], [1.0]])
    intrinsics[0, 2] += 0.5 * (width - factor * camera.width)
    intrinsics[1, 2] += 0.5 * (height - factor * camera.height)
    return replace(camera, width=width, height=height, intrinsics=intrinsics)


def looking_at(position: np.ndarray, target: np.ndarray, up: np.ndarray, size: tuple[int, int]) -> Camera:
    """A camera at ``position`` (3,) [m, world] with ``target`` (3,) in the middle of its picture and ``up`` (3,) above,
    ``FIELD_OF_VIEW`` along the shorter side. Straight up or down, the picture's top is along any horizontal axis."""
    forward = (target - position) / np.linalg.norm(target - position)
    down = -np.asarray(up, dtype=np.float64)
    if np.linalg.norm(np.cross(forward, down)) < 1e-6 * np.linalg.norm(down):
        down = np.eye(3)[np.abs(forward).argmin()]
    right = np.cross(down, forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ position
    width, height = size
    focal = 0.5 * min(size) / math.tan(0.5 * FIELD_OF_VIEW)
    return Camera("free", width, height, np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]), pose)


def _circle(orbit: OrbitView, motion: np.ndarray, up: np.ndarray, size: tuple[int, int]) -> tuple[Camera, ...]:
    points = motion.reshape(-1, 3).astype(np.float64)
    middle = 0.5 * (points.min(0) + points.max(0))
    distance = orbit.distance
    if distance is None:
        radius = float(np.linalg.norm(points - middle, axis=1).max())
        distance = MARGIN * max(radius, 1e-6) / math.sin(0.5 * FIELD_OF_VIEW)
    up = up / np.linalg.norm(up)
    first = np.cross(np.eye(3)[np.abs(up).argmin()], up)
    first /= np.linalg.norm(first)
    second = np.cross(up, first)
    elevation = math.radians(orbit.elevation)
    cameras = []
    for frame in range(len(motion)):
        angle = 2 * math.pi * orbit.turns * frame / len(motion)
        outwards = math.cos(elevation) * (math.cos(angle) * first + math.sin(angle) * second)
        place = middle + distance * (outwards + math.sin(elevation) * up)
        cameras.append(looking_at(place, middle, up, size))
    return tuple(cameras)
