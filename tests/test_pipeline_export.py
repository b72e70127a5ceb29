"""masiv export of runs of pictures and of tracks, and of what masiv simulate wrote."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import small_run
import yaml

from masiv.cli import main
from masiv.errors import InputError
from masiv.files import write_npz
from masiv.mpm.config import SimulatorConfig
from masiv.pipeline import export_results
from masiv.pipeline.export import FORMATS
from masiv.tracks.config import TracksConfig
from masiv.tracks.read import read_tracks
from masiv.twin.from_tracks import twin_of_tracks

GOLDEN = Path(__file__).parent / "golden"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return small_run.write_run(tmp_path_factory.mktemp("export") / "run").path


@pytest.fixture
def simulation(run, tmp_path):
    """A folder as masiv simulate leaves it."""
    (tmp_path / "moon").mkdir()
    shutil.copy(run / "rollout.npz", tmp_path / "moon")
    return tmp_path / "moon"


@pytest.fixture(scope="module")
def balls(tmp_path_factory):
    """A run of tracks of rigid bodies."""
    folder = small_run.write_run(tmp_path_factory.mktemp("tracks") / "run").path
    record = yaml.safe_load((folder / "run.yaml").read_text())
    record["scene"]["layout"] = "tracks"
    (folder / "run.yaml").write_text(yaml.safe_dump(record))
    twin = twin_of_tracks(read_tracks(GOLDEN / "balls"), TracksConfig(), SimulatorConfig(), rigid=True)
    twin.save(folder)
    name = twin.initial_conditions[0].observation
    write_npz(folder / "rollout.npz", **{f"times@{name}": np.arange(5) / twin.fps})
    return folder, len({start.body for start in twin.in_condition().initial_conditions})


@pytest.mark.parametrize("kind", FORMATS)
def test_every_format_of_a_run_of_pictures(run, tmp_path, kind):
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    out = tmp_path / f"out{FORMATS[kind].extension}"
    said = export_results(run, kind, out)
    assert said.data["path"] == str(out)
    if FORMATS[kind].extension:
        assert out.stat().st_size > 500
    else:
        assert len(list(out.iterdir())) == small_run.FRAMES  # as many files as frames; of the scene for Newton, three
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == before
    assert [path.name for path in tmp_path.iterdir()] == [out.name]


def test_a_simulation_has_particles_and_a_surface_of_its_own(simulation, tmp_path):
    for kind in ("vtkhdf", "ply", "obj", "glb", "usd"):
        export_results(simulation, kind, tmp_path / f"{kind}{FORMATS[kind].extension}")
    for kind in ("3dgs", "csv", "newton"):
        with pytest.raises(InputError, match="say which run it was made from with --run"):
            export_results(simulation, kind, tmp_path / f"{kind}{FORMATS[kind].extension}")


def test_gaussians_of_a_simulation_are_those_of_its_run(simulation, run, tmp_path):
    export_results(simulation, "3dgs", tmp_path / "a", run=run)
    export_results(run, "3dgs", tmp_path / "b")
    for frame in range(small_run.FRAMES):
        name = f"frame_{frame:04d}.ply"
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_the_motion_that_was_observed(run, tmp_path):
    import trimesh

    export_results(run, "ply", tmp_path / "particles", motion="trajectory")
    with np.load(run / "trajectory.npz") as file:
        last = file["positions"][-1]
    np.testing.assert_allclose(trimesh.load(tmp_path / "particles/frame_0002.ply").vertices, last, atol=1e-6)
    export_results(run, "3dgs", tmp_path / "gaussians", motion="trajectory")
    assert len(list((tmp_path / "gaussians").iterdir())) == small_run.FRAMES


def test_rigid_bodies_of_tracks_are_points(balls, tmp_path):
    from vtkmodules.vtkIOHDF import vtkHDFReader

    folder, count = balls
    export_results(folder, "vtkhdf", tmp_path / "a.vtkhdf")
    reader = vtkHDFReader()
    reader.SetFileName(str(tmp_path / "a.vtkhdf"))
    reader.Update()
    assert reader.GetNumberOfSteps() == 5
    assert reader.GetOutput().GetNumberOfPoints() == count
    for kind in ("obj", "glb", "usd", "csv", "newton"):
        with pytest.raises(InputError, match="a rigid body is a point"):
            export_results(folder, kind, tmp_path / f"b{FORMATS[kind].extension}")
    with pytest.raises(InputError, match="without pictures there are no Gaussians"):
        export_results(folder, "3dgs", tmp_path / "b")
    with pytest.raises(InputError, match="it has no trajectory"):
        export_results(folder, "ply", tmp_path / "b", motion="trajectory")
    assert [path.name for path in tmp_path.iterdir()] == ["a.vtkhdf"]


def test_the_clamped_body_of_tracks_is_simulated(tmp_path, taichi):
    from masiv.materials.classical import ClassicalLaw

    folder = small_run.write_run(tmp_path / "run").path
    record = yaml.safe_load((folder / "run.yaml").read_text())
    record["scene"]["layout"] = "tracks"
    (folder / "run.yaml").write_text(yaml.safe_dump(record))
    simulator = SimulatorConfig(courant_number=0.6, max_substeps_per_frame=4000)
    twin = twin_of_tracks(read_tracks(GOLDEN / "bar"), TracksConfig(particles=64), simulator, rigid=False)
    twin = twin.with_body(law=ClassicalLaw("neo_hookean", youngs_modulus=2e5, poissons_ratio=0.2))
    twin.save(folder)
    times = np.arange(3) / twin.fps
    write_npz(folder / "rollout.npz", **{f"times@{twin.initial_conditions[0].observation}": times})
    export_results(folder, "obj", tmp_path / "surface")
    assert len(list((tmp_path / "surface").iterdir())) == 3


def test_what_cannot_be_exported_is_one_sentence(run, simulation, tmp_path):
    cases = [
        (dict(folder=run, kind="fbx"), "--format fbx: give one of vtkhdf"),
        (dict(folder=run, kind="ply", motion="guess"), "--motion guess: give one of"),
        (dict(folder=tmp_path, kind="ply"), "neither a run folder nor"),
        (dict(folder=run, kind="ply", out=run), "is a run folder"),
        (dict(folder=run, kind="glb", out=tmp_path), "is a folder: give the name of a file"),
        (dict(folder=run, kind="usd", out=tmp_path / "a.abc"), "does not end in .usd"),
        (dict(folder=run, kind="ply", run=run), "is a run itself, leave it out"),
        (dict(folder=simulation, kind="ply", motion="trajectory"), "which has no trajectory"),
    ]
    for given, message in cases:
        with pytest.raises(InputError, match=message):
            export_results(**given)


@pytest.mark.parametrize("damage", [{"excited": [1]}, {"quantities": {"yield stress": 3}}, {"excited": {"rate": "x"}}])
def test_a_damaged_material_is_one_sentence(tmp_path, damage):
    folder = small_run.write_run(tmp_path / "run").path
    (folder / "material.json").write_text(json.dumps({"schema": 1, "summary": "soft", **damage}))
    with pytest.raises(InputError, match=r"material\.json is damaged"):
        export_results(folder, "csv", tmp_path / "law.csv")


def test_command(monkeypatch, capfd, run, tmp_path):
    def ends(*arguments):
        monkeypatch.setattr(sys, "argv", ["masiv", "export", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main.run()
        return ended.value.code, capfd.readouterr()

    code, said = ends(run, "--format", "ply", "--out", tmp_path / "a", "--json")
    assert code == 0
    assert json.loads(said.out)["path"] == str(tmp_path / "a")
    code, said = ends(run, "--format", "ply", "--out", tmp_path / "a")
    assert code == 2
    assert said.err.strip().splitlines()[-1] == f"error: {tmp_path / 'a'} exists already: give another folder"
