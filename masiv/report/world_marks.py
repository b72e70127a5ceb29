"""Up axis and ground drawn into a picture: an arrow and a grid with a length in metres."""

from __future__ import annotations

import cv2
import numpy as np

from masiv.scene.camera import Camera
from masiv.scene.scene import Ground

GRID, ARROW = (60, 190, 255), (255, 220, 0)
NEAR = 0.02
"""Of the distance to the object: lines end this far before the camera."""
CELLS = 4
"""Of the grid to each side of the object's foot."""


def round_length(size: float) -> float:
    """The largest of 1, 2, 5 × 10^k that is at most ``size`` [m]."""
    power = 10.0 ** np.floor(np.log10(size))
    return float(power * max(step for step in (1, 2, 5) if step * power <= size * (1 + 1e-9)))


def ground_axes(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two directions (3,), (3,) in the plane with ``normal`` (3,), along the axes of the world if it is one."""
    seed = np.eye(3)[int(np.abs(normal).argmin())]
    first = seed - (seed @ normal) * normal
    first /= np.linalg.norm(first)
    return first, np.cross(normal, first)


def draw_world(
    image: np.ndarray,
    camera: Camera,
    up: np.ndarray,
    ground: Ground | None,
    centre: np.ndarray,
    length: float,
    mask: np.ndarray,
) -> np.ndarray:
    """A copy of ``image`` (H, W, 3) RGB, of any size, with the grid of the ground under ``centre`` (3,) [m], its cells
    ``length`` [m] wide, and an arrow of this length up from its foot (from ``centre`` without ground). The
    object, where ``mask`` (H, W) exceeds 0.5, hides the grid."""
    drawn = np.ascontiguousarray(image.copy())
    scale = np.array([image.shape[1] / camera.width, image.shape[0] / camera.height])
    near = NEAR * float(np.linalg.norm(camera.centre - centre))
    foot = centre
    if ground is not None:
        foot = centre - (centre @ ground.normal - ground.height) * ground.normal
        # The grid stays where it is while the object moves.
        first, second = ground_axes(ground.normal)
        corner = [np.round((foot @ axis) / length) * length for axis in (first, second)]
        middle = corner[0] * first + corner[1] * second + ground.height * ground.normal
        ends = np.arange(-CELLS, CELLS + 1) * length
        for along, across in ((first, second), (second, first)):
            for step in ends:
                line = middle + step * across + np.outer([ends[0], ends[-1]], along)
                _line(drawn, camera, line, near, scale, GRID, 1)
        drawn[mask > 0.5] = image[mask > 0.5]
    _line(drawn, camera, np.stack([foot, foot + length * up]), near, scale, ARROW, 2, head=True)
    return drawn


def clipped(camera: Camera, line: np.ndarray, near: float) -> np.ndarray | None:
    """Pixels (2, 2) of the ends of ``line`` (2, 3) [m], cut off ``near`` [m] before it; None if it is behind."""
    in_camera = line @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
    depth = in_camera[:, 2]
    if (depth < near).all():
        return None
    if (depth < near).any():
        front, back = (0, 1) if depth[0] >= near else (1, 0)
        share = (depth[front] - near) / (depth[front] - depth[back])
        in_camera[back] = in_camera[front] + share * (in_camera[back] - in_camera[front])
    homogeneous = in_camera @ camera.intrinsics.T
    return homogeneous[:, :2] / homogeneous[:, 2:3]


def _line(drawn, camera, line, near, scale, colour, width: int, *, head: bool = False) -> None:
    ends = clipped(camera, line, near)
    if ends is None:
        return
    shift = 4
    # OpenCV has pixel centres at whole numbers; far outside of the picture its integers overflow.
    points = np.clip((ends * scale - 0.5) * 2**shift, -(2**24), 2**24).round().astype(int)
    start, end = tuple(points[0].tolist()), tuple(points[1].tolist())
    if head:
        for tint, thick in (((0, 0, 0), width + 2), (colour, width)):
            cv2.arrowedLine(drawn, start, end, tint, thick, cv2.LINE_AA, shift, 0.25)
    else:
        over = drawn.copy()
        cv2.line(over, start, end, colour, width, cv2.LINE_AA, shift)
        cv2.addWeighted(over, 0.6, drawn, 0.4, 0, drawn)
