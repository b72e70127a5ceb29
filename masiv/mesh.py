"""Triangle meshes from files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from masiv.errors import InputError
from masiv.strict import shortened

if TYPE_CHECKING:
    import trimesh

FORMATS = (".stl", ".obj", ".ply")
"""The others that trimesh reads are scenes or archives, whose readers may open further files."""

_LARGEST = 1e12
"""Coordinate in the unit of a file: above it, volumes lose their digits."""


def read_mesh(path: Path) -> trimesh.Trimesh:
    """The watertight surface in an STL, OBJ or PLY file, in the file's unit.

    Raises InputError if the file is missing, has another extension, cannot be read or has holes.
    """
    import trimesh

    if path.suffix.lower() not in FORMATS:
        raise InputError(f"{path} is no STL, OBJ or PLY file: convert the mesh to one of these")
    if not path.is_file():
        raise InputError(f"{path} does not exist or is not a regular file: give the path of a mesh")
    try:
        mesh = trimesh.load(path, force="mesh")
        corners = np.asarray(mesh.vertices, np.float64) if isinstance(mesh, trimesh.Trimesh) else np.zeros((0, 3))
    except Exception as error:  # its readers raise what they like
        raise InputError(f"{path} is not a triangle mesh that can be read: {shortened(error)}") from error
    if not (np.isfinite(corners).all() and np.abs(corners).max(initial=0) < _LARGEST):
        raise InputError(f"{path} has a coordinate that is not finite or above {_LARGEST:g}: repair the mesh")
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0 or not mesh.is_watertight:
        raise InputError(f"{path} is not watertight, so it has no inside: close its holes first")
    return mesh


def lattice_inside(mesh: trimesh.Trimesh, axis: np.ndarray) -> np.ndarray:
    """Which points of the lattice axis x axis x axis are inside a closed mesh, (A, A, A) bool.

    axis (A,): evenly spaced, ascending. A point is inside if a ray along z crosses the surface an odd number of times.
    """
    count, step = len(axis), axis[1] - axis[0]
    # Off the lattice by a hair, so that no column runs along an edge.
    a, b, c = (mesh.vertices[mesh.faces[:, k]] - [1.3e-7, 2.9e-7, 0] for k in range(3))
    crossings = np.zeros((count, count, count + 1), np.int32)
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    for i in np.flatnonzero(np.abs(area) > 1e-14):
        corner = np.stack([a[i], b[i], c[i]])
        low = np.maximum(np.ceil((corner[:, :2].min(0) - axis[0]) / step).astype(int), 0)
        high = np.minimum(np.floor((corner[:, :2].max(0) - axis[0]) / step).astype(int) + 1, count)
        if (high <= low).any():
            continue
        x, y = np.meshgrid(axis[low[0] : high[0]], axis[low[1] : high[1]], indexing="ij")
        u = ((x - a[i, 0]) * (c[i, 1] - a[i, 1]) - (y - a[i, 1]) * (c[i, 0] - a[i, 0])) / area[i]
        v = ((b[i, 0] - a[i, 0]) * (y - a[i, 1]) - (b[i, 1] - a[i, 1]) * (x - a[i, 0])) / area[i]
        hit = (u >= 0) & (v >= 0) & (u + v <= 1)
        z = a[i, 2] + u * (b[i, 2] - a[i, 2]) + v * (c[i, 2] - a[i, 2])
        first = np.clip(np.ceil((z - axis[0]) / step).astype(int), 0, count)
        rows, columns = np.nonzero(hit)
        np.add.at(crossings, (rows + low[0], columns + low[1], first[hit]), 1)
    return np.cumsum(crossings, axis=2)[:, :, :count] % 2 == 1
