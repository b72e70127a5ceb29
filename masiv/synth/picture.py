"""Pictures of a textured mesh over a ground plane: z-buffer, Lambert's law, one sun with a shadow on the ground."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from masiv.scene.camera import Camera
from masiv.synth.texture import ground_color

_SUN = np.array([0.45, 0.8, 0.4]) / np.linalg.norm([0.45, 0.8, 0.4])
_AMBIENT, _DIRECT, _SHADOW = 0.62, 0.5, 0.55
_SKY = np.array([0.70, 0.76, 0.84])


@dataclass(frozen=True)
class Surface:
    """vertices (V, 3) [m], faces (F, 3), local (V, 3): where each vertex is in the texture's own space."""

    vertices: np.ndarray
    faces: np.ndarray
    local: np.ndarray


def picture(
    camera: Camera,
    empty: np.ndarray,
    surface: Surface | None,
    color: Callable[[np.ndarray], np.ndarray],
    supersampling: int,
) -> tuple[np.ndarray, np.ndarray]:
    """The picture (H, W, 3) float [0, 1] that ``camera`` takes, and the object's share of each pixel (H, W).

    ``empty`` is the ``background`` of the camera, ``supersampling`` times as large. color: (N, 3) of places (N, 3) in
    the texture's own space.
    """
    fine = enlarged_camera(camera, supersampling)
    image = empty.copy()
    shown = np.zeros((fine.height, fine.width), np.float32)
    if surface is not None:
        image = _shade_ground(fine, surface, image, supersampling)
        face, barycentric = rasterise(fine, surface.vertices, surface.faces)
        hit = face >= 0
        corners = surface.faces[face[hit]]
        local = np.einsum("pk,pki->pi", barycentric[hit], surface.local[corners])
        a, b, c = (surface.vertices[corners[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-30
        light = _AMBIENT * (0.75 + 0.25 * normal[:, 1]) + _DIRECT * np.clip(normal @ _SUN, 0, None)
        image[hit] = color(local) * light[:, None]
        shown[hit] = 1
    size = (camera.width, camera.height)
    return (
        np.clip(cv2.resize(image, size, interpolation=cv2.INTER_AREA), 0, 1),
        cv2.resize(shown, size, interpolation=cv2.INTER_AREA),
    )


def rasterise(camera: Camera, vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest face at each pixel's centre (H, W), -1 for none, and barycentric coordinates (H, W, 3) in the world.

    Triangles are handled in groups of like size, all candidate pixels of a group at once. Those that face away or reach
    behind the camera are left out.
    """
    pixels, depth = camera.project(vertices)
    face = np.full(camera.height * camera.width, -1, np.int64)
    nearest = np.zeros(camera.height * camera.width)  # inverse depth
    bary = np.zeros((camera.height * camera.width, 3))
    corner = pixels[faces]
    inverse_depth = 1 / depth[faces]
    edge1, edge2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    area = edge1[:, 0] * edge2[:, 1] - edge1[:, 1] * edge2[:, 0]
    low = np.floor(corner.min(axis=1) - 0.5).astype(int).clip(0)
    high = np.ceil(corner.max(axis=1) + 0.5).astype(int)
    high = np.minimum(high, [camera.width, camera.height])
    # Counter-clockwise from outside is clockwise if y points down: a negative area faces the camera.
    drawn = (depth[faces] > 1e-3).all(axis=1) & (area < -1e-9) & (high > low).all(axis=1)
    reach = (high - low).max(axis=1)
    for size in 2 ** np.arange(1, int(np.log2(max(camera.width, camera.height))) + 2):
        group = np.flatnonzero(drawn & (reach <= size) & (reach > size // 2 if size > 2 else True))
        per_chunk = max(1, 4_000_000 // size**2)
        for chunk in (group[k : k + per_chunk] for k in range(0, len(group), per_chunk)):
            column, row = np.meshgrid(np.arange(size), np.arange(size))
            x = low[chunk, 0, None] + column.ravel()
            y = low[chunk, 1, None] + row.ravel()
            dx, dy = x + 0.5 - corner[chunk, 0, 0, None], y + 0.5 - corner[chunk, 0, 1, None]
            e1, e2, full = edge1[chunk, None], edge2[chunk, None], area[chunk, None]
            u = (dx * e2[..., 1] - dy * e2[..., 0]) / full
            v = (e1[..., 0] * dy - e1[..., 1] * dx) / full
            inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (x < camera.width) & (y < camera.height)
            which, _ = np.nonzero(inside)
            u, v = u[inside], v[inside]
            # Perspective-correct: what is linear on the picture is each coordinate over depth.
            over = np.stack([1 - u - v, u, v], axis=1) * inverse_depth[chunk[which]]
            closeness = over.sum(axis=1)
            index = y[inside] * camera.width + x[inside]
            order = np.argsort(closeness, kind="stable")
            order = order[closeness[order] > nearest[index[order]]]
            index = index[order]  # ascending: the last, nearest, wins
            nearest[index] = closeness[order]
            face[index] = chunk[which[order]]
            bary[index] = over[order] / closeness[order, None]
    shape = (camera.height, camera.width)
    return face.reshape(shape), bary.reshape(*shape, 3)


def enlarged_camera(camera: Camera, factor: int) -> Camera:
    """The camera with ``factor`` times as many pixels along each side."""
    intrinsics = camera.intrinsics * np.array([[factor], [factor], [1.0]])
    return Camera(camera.name, camera.width * factor, camera.height * factor, intrinsics, camera.world_to_camera)


def background(camera: Camera, seed: int) -> np.ndarray:
    """Sky and ground (H, W, 3) float32."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    inverse = np.linalg.inv(camera.intrinsics)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ inverse.T @ camera.world_to_camera[:3, :3]
    image = np.broadcast_to(_SKY, rays.shape).astype(np.float32)
    down = rays[..., 1] < -1e-3
    along = camera.centre[1] / -rays[down][:, 1]
    points = camera.centre + along[:, None] * rays[down]
    haze = np.exp(-np.linalg.norm(points[:, [0, 2]], axis=1) / 12.0)[:, None]
    image[down] = haze * ground_color(points, seed) + (1 - haze) * _SKY
    return image


def _shade_ground(camera: Camera, surface: Surface, image: np.ndarray, blur: int) -> np.ndarray:
    """Darken the ground where the body hides the sun."""
    drop = surface.vertices - np.maximum(surface.vertices[:, 1:2], 0) / _SUN[1] * _SUN
    covered = (rasterise(camera, drop, surface.faces)[0] >= 0).astype(np.float32)
    soft = cv2.GaussianBlur(covered, (0, 0), 1.2 * blur)
    return image * (1 - (1 - _SHADOW) * soft[..., None])
