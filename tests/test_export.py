"""Files for other programs, opened by readers that did not write them."""

from __future__ import annotations

import re
import struct
import sys

import moving_block as block
import numpy as np
import pytest
import torch
import trimesh
from numpy.testing import assert_allclose

import masiv.export as export
from masiv.errors import InputError
from masiv.export.kinematics import Deformation, equivalent_strain, particle_spacing, velocities
from masiv.simulation.rollout import Rollout
from masiv.splat.gaussians import Gaussians

ROUND = 1e-5
POINTS = Rollout(np.zeros((3, 2, 3), np.float32) + np.arange(3, dtype=np.float32)[:, None, None], np.arange(3) / 10)
"""Two points that move at 10 m/s along every axis: a body without volume."""


@pytest.fixture(scope="module")
def moving():
    return block.rollout()


def to_numpy(array):
    from vtkmodules.util.numpy_support import vtk_to_numpy

    return vtk_to_numpy(array)


# -- kinematics ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("parts", [1, 4, 8])
def test_spacing_of_a_lattice(parts):
    from masiv.simulation.subdivide import subdivide_particles

    points = subdivide_particles(block.lattice(), block.SPACING, parts)
    assert particle_spacing(points) == pytest.approx(block.SPACING / parts ** (1 / 3), rel=0.03)


def test_velocities_of_a_motion_that_is_quadratic_in_time(moving):
    exact = np.stack([block.velocity(t) for t in block.TIMES])
    assert_allclose(velocities(moving.positions, moving.times), exact, atol=1e-4)


def test_deformation_of_an_affine_motion(moving):
    deformation = Deformation.since(moving.positions[0])
    assert deformation is not None
    found = deformation.gradients(moving.positions[-1])
    assert_allclose(found, np.broadcast_to(block.gradient(block.TIMES[-1]), found.shape), atol=1e-4)


def test_strain_is_axial_in_an_isochoric_stretch_and_none_in_a_rotation():
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec([0.3, -1.2, 0.4]).as_matrix()
    stretch = np.diag(np.exp([0.2, -0.1, -0.1]))
    assert_allclose(equivalent_strain(np.stack([turn, turn @ stretch])), [0, 0.2], atol=1e-12)


# -- particles ----------------------------------------------------------------------------------------------------


def read_vtkhdf(path):
    from vtkmodules.vtkIOHDF import vtkHDFReader

    reader = vtkHDFReader()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    return reader


def test_vtkhdf_in_vtk(moving, tmp_path):
    export.write_vtkhdf(moving, tmp_path / "a.vtkhdf")
    reader = read_vtkhdf(tmp_path / "a.vtkhdf")
    assert reader.GetNumberOfSteps() == len(block.TIMES)
    for step, time in enumerate(block.TIMES):
        reader.SetStep(step)
        reader.Update()
        assert reader.GetTimeValue() == pytest.approx(time)
        data = reader.GetOutput()
        assert data.GetNumberOfVerts() == data.GetNumberOfPoints() == 1000
        assert_allclose(to_numpy(data.GetPoints().GetData()), block.positions(time), atol=ROUND)
        values = {name: to_numpy(data.GetPointData().GetArray(name)) for name in names(data)}
        assert_allclose(values["velocity"], block.velocity(time), atol=1e-4)
        assert_allclose(values["displacement"], block.positions(time) - block.lattice(), atol=ROUND)
        f = block.gradient(time)
        assert_allclose(values["deformation_gradient"], np.broadcast_to(f.ravel(), (1000, 9)), atol=1e-4)
        assert_allclose(values["volume_ratio"], np.linalg.det(f), atol=1e-4)
        assert_allclose(values["equivalent_strain"], equivalent_strain(f[None])[0], atol=1e-4)
        assert (values["particle"] == np.arange(1000)).all()


def names(data):
    return [data.GetPointData().GetArrayName(k) for k in range(data.GetPointData().GetNumberOfArrays())]


def test_points_without_volume_have_velocities_and_no_deformation(tmp_path):
    export.write_vtkhdf(POINTS, tmp_path / "a.vtkhdf")
    reader = read_vtkhdf(tmp_path / "a.vtkhdf")
    reader.SetStep(1)
    reader.Update()
    assert set(names(reader.GetOutput())) == {"velocity", "displacement", "particle"}
    assert_allclose(to_numpy(reader.GetOutput().GetPointData().GetArray("velocity")), 10.0, rtol=1e-5)
    with pytest.raises(InputError, match="have no surface"):
        export.write_glb(POINTS, tmp_path / "a.glb")


def test_ply_in_trimesh(moving, tmp_path):
    export.write_ply_sequence(moving, tmp_path / "frames")
    files = sorted((tmp_path / "frames").iterdir())
    assert [file.name for file in files] == [f"frame_{k:04d}.ply" for k in range(4)]
    for file, time in zip(files, block.TIMES, strict=True):
        cloud = trimesh.load(file)
        assert_allclose(cloud.vertices, block.positions(time), atol=ROUND)
        rows = cloud.metadata["_ply_raw"]["vertex"]["data"]
        assert_allclose(np.stack([rows[f"v{axis}"] for axis in "xyz"], -1), block.velocity(time), atol=1e-4)
        assert_allclose(rows["volume_ratio"], np.linalg.det(block.gradient(time)), atol=1e-4)


def test_a_folder_that_holds_something_is_kept(moving, tmp_path):
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames/note.txt").write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        export.write_ply_sequence(moving, tmp_path / "frames")
    assert [path.name for path in tmp_path.rglob("*")] == ["frames", "note.txt"]


# -- surfaces -----------------------------------------------------------------------------------------------------


def test_surface_of_a_block():
    surface = export.reconstruct_surface(block.lattice(), block.SPACING)
    mesh = trimesh.Trimesh(surface.vertices, surface.triangles, process=False)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(block.VOLUME, rel=0.08)  # corners are rounded
    low, high = np.array([0, 0.3, 0]), np.array([0.5, 0.8, 0.5])
    middle = np.abs(surface.vertices[:, :2] - (low + high)[:2] / 2).max(axis=1) < 0.1
    for face in (low[2], high[2]):
        near = surface.vertices[middle & (np.abs(surface.vertices[:, 2] - face) < 0.1), 2]
        assert len(near) > 4
        assert_allclose(near, face, atol=0.05 * block.SPACING)
    outwards = surface.vertices - block.lattice().mean(0)
    assert (np.einsum("ij,ij->i", outwards, surface.normals) > 0).all()
    assert_allclose(np.linalg.norm(surface.normals, axis=1), 1, atol=1e-5)


def test_carried_surface_follows_an_affine_motion(moving):
    first, *_, last = export.carried_surface(moving.positions)
    f = block.gradient(block.TIMES[-1])
    rigid = block.positions(block.TIMES[-1])[0] - f @ block.lattice()[0]
    assert_allclose(last.vertices, first.vertices @ f.T + rigid, atol=0.15 * block.SPACING)


def test_obj_in_vtk(moving, tmp_path):
    from vtkmodules.vtkFiltersCore import vtkMassProperties
    from vtkmodules.vtkIOGeometry import vtkOBJReader

    export.write_obj_sequence(moving, tmp_path / "frames")
    assert len(list((tmp_path / "frames").glob("frame_????.obj"))) == 4
    for frame in (0, 3):
        reader = vtkOBJReader()
        reader.SetFileName(str(tmp_path / f"frames/frame_{frame:04d}.obj"))
        reader.Update()
        assert reader.GetOutput().GetPointData().GetNormals() is not None
        mass = vtkMassProperties()
        mass.SetInputConnection(reader.GetOutputPort())
        volume = block.VOLUME * np.linalg.det(block.gradient(block.TIMES[frame]))
        assert mass.GetVolume() == pytest.approx(volume, rel=0.12)


def glb_vertices(reader, time):
    reader.UpdateTimeStep(time)
    iterator = reader.GetOutput().NewIterator()
    iterator.InitTraversal()
    return to_numpy(iterator.GetCurrentDataObject().GetPoints().GetData()).copy()


def test_glb_in_vtk_shows_the_motion_at_its_times(moving, tmp_path):
    from vtkmodules.vtkIOGeometry import vtkGLTFReader

    export.write_glb(moving, tmp_path / "a.glb", up=(0, 0, 1))
    reader = vtkGLTFReader()
    reader.SetFileName(str(tmp_path / "a.glb"))
    reader.ApplyDeformationsToGeometryOn()
    reader.SetFrameRate(160)
    reader.UpdateInformation()
    assert reader.GetNumberOfAnimations() == 1
    assert reader.GetAnimationDuration(0) == pytest.approx(block.TIMES[-1])
    reader.EnableAnimation(0)
    reader.UpdateInformation()
    expected = [s.vertices[:, [0, 2, 1]] * [1, 1, -1] for s in export.carried_surface(moving.positions)]  # z up -> y up
    for frame, time in enumerate(block.TIMES):
        assert_allclose(glb_vertices(reader, time), expected[frame], atol=1e-5)
    between = (block.TIMES[1] + block.TIMES[2]) / 2
    assert_allclose(glb_vertices(reader, between), (expected[1] + expected[2]) / 2, atol=2e-3)


def numbers(text, attribute, frame):
    """Of a time sample in the text of a prim of a USD file."""
    samples = text.split(f" {attribute}.timeSamples = {{", 1)[1].split("\n    }", 1)[0]
    sample = re.search(rf"^\s*{frame}: \[(.*?)\]", samples, re.MULTILINE)
    assert sample is not None
    return np.array([float(n) for n in re.findall(r"[-+.\deE]+", sample[1])])


@pytest.mark.parametrize(("up", "axis"), [((0, 0, 1), "Z"), ((0, 1, 0), "Y"), ((1, 0, 0), "Y")])
def test_usd_in_tinyusdz(moving, tmp_path, up, axis):
    import tinyusdz

    export.write_usd(moving, tmp_path / "a.usdc", up=up)
    stage = tinyusdz.load(str(tmp_path / "a.usdc"))
    asked = {"upAxis": axis, "metersPerUnit": 1.0, "timeCodesPerSecond": 8.0, "startTimeCode": 0.0, "endTimeCode": 3.0}
    assert {key: stage.get_metadata(key) for key in asked} == asked
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]) if up == (1, 0, 0) else np.eye(3)
    particles, surface = (stage.get_prim_at_path(f"/body/{name}").to_string() for name in ("particles", "surface"))
    for frame in (0, 3):
        time = block.TIMES[frame]
        found = numbers(particles, "points", frame).reshape(-1, 3)
        assert_allclose(found, block.positions(time) @ turn.T, atol=1e-4)
        found = numbers(particles, "velocities", frame).reshape(-1, 3)
        assert_allclose(found, block.velocity(time) @ turn.T, atol=1e-3)
        vertices = numbers(surface, "points", frame).reshape(-1, 3)
        triangles = numbers(surface, "faceVertexIndices", frame).astype(int).reshape(-1, 3)
        assert (numbers(surface, "faceVertexCounts", frame) == 3).all()
        volume = block.VOLUME * np.linalg.det(block.gradient(time))
        assert trimesh.Trimesh(vertices, triangles, process=False).volume == pytest.approx(volume, rel=0.12)


def test_usd_complies(moving, tmp_path):
    from pxr import Usd, UsdValidation

    export.write_usd(moving, tmp_path / "a.usda")
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 5
    found = UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(str(tmp_path / "a.usda")))
    assert [error.GetErrorAsString() for error in found] == []
    with pytest.raises(InputError, match=r"does not end in \.usd"):
        export.write_usd(moving, tmp_path / "a.abc")


# -- Gaussians ----------------------------------------------------------------------------------------------------


def strict_3dgs(path):
    """Columns by name, as a loader that takes only the layout of Kerbl et al. 2023 reads them: 62 floats each."""
    head, body = path.read_bytes().split(b"end_header\n", 1)
    lines = head.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = int(next(line for line in lines if line.startswith("element vertex ")).split()[2])
    properties = [line.split()[1:] for line in lines if line.startswith("property ")]
    expected = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{k}" for k in range(3)), *(f"f_rest_{k}" for k in range(45))]
    expected += ["opacity", *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]
    assert properties == [["float", name] for name in expected]
    rows = np.array(list(struct.iter_unpack("<62f", body)))
    assert len(rows) == count
    return dict(zip(expected, rows.T, strict=True))


def test_gaussians_in_a_strict_loader(moving, tmp_path):
    rng = np.random.default_rng(1)
    means = rng.uniform(block.lattice().min(0), block.lattice().max(0), (20, 3))
    colours = rng.uniform(size=(20, 3))
    tensors = (means, np.full(20, 0.02), rng.uniform(0.1, 0.9, 20), colours)
    gaussians = Gaussians(*(torch.as_tensor(t).float() for t in tensors))
    export.write_gaussians(export.follow_gaussians(gaussians, moving.positions), tmp_path / "frames")
    f = block.gradient(block.TIMES[-1])
    shift = block.positions(block.TIMES[-1])[0] - f @ block.lattice()[0]
    read = strict_3dgs(tmp_path / "frames/frame_0003.ply")
    assert_allclose(np.stack([read[axis] for axis in "xyz"], -1), means @ f.T + shift, atol=0.1 * block.SPACING)
    for k in range(3):
        assert_allclose(np.exp(read[f"scale_{k}"]), 0.02 * np.cbrt(np.linalg.det(f)), rtol=0.02)
        assert_allclose(0.5 + 0.28209479177387814 * read[f"f_dc_{k}"], colours[:, k], atol=1e-5)
    assert_allclose(1 / (1 + np.exp(-read["opacity"])), tensors[2], atol=1e-5)
    assert_allclose(np.stack([read[f"rot_{k}"] for k in range(4)]), [[1.0] * 20, *[[0.0] * 20] * 3])
    assert not any(read[f"f_rest_{k}"].any() for k in range(45))
    assert Gaussians.load_ply(tmp_path / "frames/frame_0003.ply").means.shape == (20, 3)


def test_gaussians_of_another_place_are_refused(moving, tmp_path):
    far = Gaussians(torch.full((5, 3), 9.0), torch.full((5,), 0.1), torch.full((5,), 0.5), torch.zeros(5, 3))
    with pytest.raises(InputError, match="of another body or place"):
        export.write_gaussians(export.follow_gaussians(far, moving.positions), tmp_path / "frames")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("library", "write", "name"),
    [("h5py", "write_vtkhdf", "a.vtkhdf"), ("pygltflib", "write_glb", "a.glb"), ("pxr", "write_usd", "a.usdc"),
     ("pysplashsurf", "write_obj_sequence", "a")],
)  # fmt: skip
def test_a_library_that_is_missing_is_named(monkeypatch, moving, tmp_path, library, write, name):
    monkeypatch.setitem(sys.modules, library, None)  # as if it were not installed
    with pytest.raises(InputError, match=rf"{library}.*pip install 'masiv\[export\]'"):
        getattr(export, write)(moving, tmp_path / name)
    assert not list(tmp_path.iterdir())
