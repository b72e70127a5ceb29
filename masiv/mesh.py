"""Triangle meshes from files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from masiv.errors import InputError

if TYPE_CHECKING:
    import trimesh

FORMATS = (".stl", ".obj", ".ply")
"""The others that trimesh reads are scenes or archives, whose readers may open further files."""


def read_mesh(path: Path) -> trimesh.Trimesh:
    """The watertight surface in an STL, OBJ or PLY file, in the file's unit.

    Raises InputError if the file is missing, has another extension, cannot be read or has holes.
    """
    import trimesh

    if path.suffix.lower() not in FORMATS:
        raise InputError(f"{path} is no STL, OBJ or PLY file: convert the mesh to one of these")
    if not path.is_file():
        raise InputError(f"{path} does not exist: give the path of a mesh")
    try:
        mesh = trimesh.load(path, force="mesh")
    except Exception as error:  # its readers raise what they like
        raise InputError(f"{path} is not a triangle mesh that can be read: {error}") from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0 or not mesh.is_watertight:
        raise InputError(f"{path} is not watertight, so it has no inside: close its holes first")
    return mesh
