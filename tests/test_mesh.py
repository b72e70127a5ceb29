"""Meshes from files."""

from __future__ import annotations

import pytest
import trimesh

from masiv.errors import InputError
from masiv.mesh import read_mesh
from masiv.tracks.declaration import GeometryDeclaration
from masiv.tracks.geometry import make_geometry


@pytest.mark.parametrize("name", ["cube.stl", "cube.OBJ", "cube.ply"])
def test_formats(tmp_path, name):
    trimesh.creation.box((1, 2, 3)).export(tmp_path / name, file_type=name[-3:].lower())
    assert abs(read_mesh(tmp_path / name).volume) == pytest.approx(6.0)


@pytest.mark.parametrize("name", ["cube.glb", "cube.off", "cube.stl.zip", "cube"])
def test_other_formats_are_refused(tmp_path, name):
    kind = name.rpartition(".")[2] if name in ("cube.glb", "cube.off") else "stl"
    trimesh.creation.box((1, 2, 3)).export(tmp_path / name, file_type=kind)
    with pytest.raises(InputError, match="no STL, OBJ or PLY file"):
        read_mesh(tmp_path / name)
    declared = GeometryDeclaration.model_validate({"mesh": name, "units": "m", "markers_at": {"a": [0, 0, 0]}})
    with pytest.raises(InputError, match="no STL, OBJ or PLY file"):
        make_geometry(declared, tmp_path)


def test_what_is_no_closed_mesh_is_refused(tmp_path):
    (tmp_path / "text.stl").write_text("not a mesh")
    with pytest.raises(InputError, match=r"text\.stl"):
        read_mesh(tmp_path / "text.stl")
    with pytest.raises(InputError, match="does not exist"):
        read_mesh(tmp_path / "none.stl")
    opened = trimesh.creation.box((1, 1, 1))
    opened.update_faces([True] * 11 + [False])
    opened.export(tmp_path / "open.ply")
    with pytest.raises(InputError, match="not watertight"):
        read_mesh(tmp_path / "open.ply")
