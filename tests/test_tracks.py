"""Scenes of measured points: what is read, what is refused, what is found in them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import c3d
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from masiv.errors import InputError
from masiv.observations.read import read_observation, read_scene
from masiv.tracks.declaration import RunDeclaration
from masiv.tracks.placement import best_rigid
from masiv.tracks.read import read_tracks
from masiv.tracks.release import estimate_release
from masiv.tracks.summary import gaps, summarise_tracks
from masiv.tracks.table import read_c3d
from masiv.tracks.tracks import rest_positions

MARKERS_AT = {"a": [0, 0, 0], "b": [20, 0, 0], "c": [0, 30, 100]}
POSE = Rotation.from_rotvec([0.3, -1.1, 0.4]).as_matrix(), np.array([0.2, -0.1, 0.5])


def write_csv(path, rate=100.0, frames=40, released=20, unit="mm", scale=1e3, gap=(25, 28)):
    """Three markers at rest, then falling; marker b has a gap."""
    own = 1e-3 * np.array(list(MARKERS_AT.values()), float)
    times = np.arange(frames) / rate
    fall = 0.5 * 9.8 * np.maximum(times - released / rate, 0) ** 2
    points = (own @ POSE[0].T + POSE[1])[None] - fall[:, None, None] * np.array([0, 0, 1.0])
    header = ["frame", "time_s"] + [f"{m}_{axis}_{unit}" for m in "abc" for axis in "xyz"]
    lines = [",".join(header)]
    for k, row in enumerate(scale * points):
        cells = [f"{value:.6f}" for value in row.ravel()]
        if gap[0] <= k < gap[1]:
            cells[3:6] = ["", "nan", ""]
        lines.append(",".join([str(k), f"{times[k]:.6f}", *cells]))
    path.write_text("\n".join(lines) + "\n")
    return points


def document(**changes):
    body = {
        "density": 1100,
        "poissons_ratio": 0.45,
        "geometry": {"box": [30, 30, 100], "units": "mm", "markers_at": MARKERS_AT},
        "clamp": {"half_space": {"normal": [0, 0, 2], "height": -40}, "markers": ["a"]},
    }
    runs = [{"file": "one.csv", "rest_frames": [0, 15]}, {"file": "two.csv", "use": "hold_out", "condition": "load"}]
    return {"layout": "tracks", "up_axis": "z", "bodies": {"beam": body}, "runs": runs, **changes}


@pytest.fixture
def folder(tmp_path):
    write_csv(tmp_path / "one.csv")
    write_csv(tmp_path / "two.csv", unit="m", scale=1.0)
    save(tmp_path, document())
    return tmp_path


def save(folder, data):
    (folder / "scene.yaml").write_text(yaml.safe_dump(data))


def refused(folder, match, **changes):
    save(folder, document(**changes))
    with pytest.raises(InputError, match=match):
        read_tracks(folder)


def test_read_in_metres_with_gaps_and_pose(folder):
    tracks = read_observation(folder)
    first, second = tracks.runs
    truth = write_csv(folder / "one.csv")
    np.testing.assert_allclose(first.positions[:20], truth[:20], atol=1e-9)
    np.testing.assert_allclose(second.positions[30:], first.positions[30:], atol=2e-6)
    assert np.isnan(first.positions[25:28, 1]).all()
    assert np.isfinite(first.positions[:, [0, 2]]).all()
    assert gaps(first)["longest_frames"] == 3
    assert gaps(first)["by_marker"] == {"a": 0, "b": pytest.approx(3 / 40), "c": 0}
    assert first.rate == pytest.approx(100)
    np.testing.assert_allclose(first.placement.rotation, POSE[0], atol=1e-6)
    np.testing.assert_allclose(first.placement.translation, POSE[1], atol=1e-6)
    body = tracks.bodies["beam"]
    assert body.mass == pytest.approx(1100 * 9e-5, rel=1e-12)
    np.testing.assert_allclose(body.clamps[0].normals, [[0, 0, 1]])
    np.testing.assert_allclose(body.clamps[0].heights, [-0.04])
    assert first.release == pytest.approx(0.2, abs=1e-3)
    assert [run.name for run in tracks.chosen("hold_out", condition="load")] == ["two"]
    assert tracks.chosen("fit", condition="load") == ()
    np.testing.assert_allclose(tracks.gravity, [0, 0, -9.8])
    assert tracks.problems == ("run one: columns not used: frame", "run two: columns not used: frame")
    moving = first.moving()
    assert len(moving.times) in (19, 20)
    assert 0 <= moving.elapsed[0] < 0.011
    np.testing.assert_array_equal(moving.at_rest, first.at_rest)


def test_the_earlier_name_of_ignore_after_release_is_read():
    run = {"file": "a.csv", "name": "one"}
    assert RunDeclaration.model_validate({**run, "unsteady": 0.1}).ignore_after_release == 0.1
    assert RunDeclaration.model_validate({**run, "ignore_after_release": 0.2}).ignore_after_release == 0.2
    with pytest.raises(ValueError, match="earlier name"):
        RunDeclaration.model_validate({**run, "unsteady": 0.1, "ignore_after_release": 0.1})


def test_heights_of_several_bodies_in_one_long_table(tmp_path):
    rows = ["ball,drop,t,height"]
    for ball, drag in (("heavy", 0.0), ("light", 0.3)):
        for drop in (1, 2):
            rows += [f"{ball},{drop}.0,{t:.3f},{3000 - 490 * t**2 * (1 - drag):.4f}" for t in np.arange(0, 1, 0.1)]
    (tmp_path / "drops.csv").write_text("\n".join(rows))
    ball = {
        "mass": 0.1,
        "group": "balls",
        "geometry": {"sphere": 6, "units": "cm", "markers_at": {"centre": [0, 0, 0]}},
    }
    save(tmp_path, {
        "layout": "tracks", "units": "cm", "up_axis": "+y",
        "columns": {"time": "t", "markers": {"centre": {"y": "height"}}},
        "bodies": {"heavy": ball, "light": ball, "lone": {}},
        "runs": [{"file": "drops.csv", "body": name, "select": {"ball": name, "drop": drop},
                  "use": "fit" if drop == 1 else "hold_out"} for name in ("heavy", "light") for drop in (1, 2)],
    })  # fmt: skip
    tracks = read_tracks(tmp_path)
    assert [run.name for run in tracks.runs] == ["heavy 1", "heavy 2", "light 1", "light 2"]
    assert {name: len(bodies) for name, bodies in tracks.groups().items()} == {"balls": 2, "lone": 1}
    run = tracks.runs[2]
    assert run.axes.tolist() == [[False, True, False]]
    assert run.seen.all()
    assert run.positions[3, 0, 1] == pytest.approx(30 - 4.9 * 0.09 * 0.7, abs=1e-6)
    np.testing.assert_allclose(run.placement.translation, [0, 30, 0])
    assert tracks.bodies["light"].density == pytest.approx(0.1 / (np.pi / 6 * 0.06**3))
    assert "body lone has no run" in tracks.problems


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"gravty": 9.8}, "did you mean 'gravity'"),
        ({"runs": [{"file": "none.csv"}]}, "does not exist"),
        ({"runs": [{"file": "one.csv", "use": "hold_out"}]}, "use: fit"),
        ({"runs": [{"file": "one.csv", "markers": ["z"]}]}, "no marker 'z'"),
        ({"runs": [{"file": "one.csv", "body": "bem"}]}, "one of beam"),
        ({"runs": [{"file": "one.csv", "rest_frames": [0, 100]}]}, "has 40 frames"),
        ({"runs": [{"file": "one.csv", "select": {"frame": 99}}]}, "frame = 99"),
        ({"runs": [{"file": "one.csv"}, {"file": "one.csv"}]}, "two runs are named 'one'"),
        ({"bodies": {"beam": {"density": 1, "mass": 2}}}, "density or mass"),
        ({"bodies": {"beam": {"geometry": {"units": "mm"}}}}, "give one of mesh, box"),
        ({"bodies": {"beam": {"clamp": {"box": [[0, 0, 0], [1, 1, 1]]}}}}, "a clamp needs a geometry"),
        ({"columns": {"markers": {"a": {"x": "left"}}}}, "has no column 'left'"),
    ],
)
def test_refused_with_a_sentence(folder, changes, match):
    refused(folder, match, **changes)


def test_refuses_a_clamp_beside_the_body(folder):
    data = document()
    data["bodies"]["beam"]["clamp"] = {"half_space": {"normal": [0, 0, 1], "height": -60}}
    refused(folder, "holds no part", **data)
    data["bodies"]["beam"]["clamp"]["half_space"]["height"] = 60
    refused(folder, "holds the whole body", **data)


def test_refuses_files_that_do_not_say_enough(folder):
    (folder / "one.csv").write_text("t,a_x,a_y,a_z\n0,1,2,3\n0.1,1,2,3\n0.1,1,2,3\n")
    runs = [{"file": "one.csv"}]
    bodies = {"a": {}}
    refused(folder, "units: m", runs=runs, bodies=bodies)
    refused(folder, "must increase", runs=runs, bodies=bodies, units="m")
    (folder / "one.csv").write_text("a_x,a_y,a_z\n1,2,3\n1,2,3\n1,two,3\n")
    refused(folder, "row 4, column a_y: 'two'", runs=runs, bodies=bodies, units="m")
    (folder / "one.csv").write_text("a_x,a_y,a_z\n1,2,3\n1,2,3\n1,2,inf\n")
    refused(folder, "infinite", runs=runs, bodies=bodies, units="m")
    (folder / "one.csv").write_text("a_x,a_y,a_z\n1,2,3\n1,2,3\n1,2,4\n")
    refused(folder, "has no time", runs=runs, bodies=bodies, units="m")
    save(folder, document(runs=runs, bodies=bodies, units="mm", rate=50))
    np.testing.assert_allclose(read_tracks(folder).runs[0].times, [0, 0.02, 0.04])


def test_what_the_scene_says_wins_and_is_said(folder):
    save(folder, document(units="mm"))
    tracks = read_tracks(folder)
    assert any("two: the file says m, scene.yaml mm" in problem for problem in tracks.problems)
    assert any("after the best rigid motion" in problem for problem in tracks.problems)


def test_pictures_are_not_tracks(folder):
    with pytest.raises(InputError, match="scene of tracks"):
        read_scene(folder)


def test_best_rigid_motion_is_one():
    """Mirrored points: the best rotation is not a reflection."""
    own = np.random.default_rng(0).normal(size=(5, 3))
    found = best_rigid(own, own * [1, 1, -1])
    assert np.linalg.det(found.rotation) == pytest.approx(1)
    assert found.error > 0.1
    turned = best_rigid(own, own @ POSE[0].T + POSE[1])
    np.testing.assert_allclose(turned.rotation, POSE[0], atol=1e-12)
    np.testing.assert_allclose(turned.to_own(turned.to_world(own)), own, atol=1e-12)


@pytest.mark.parametrize("released", [0.503, 0.5078])
def test_release_between_frames(released):
    times = np.arange(100) / 100
    generator = np.random.default_rng(1)
    x = np.zeros((100, 2, 3))
    x[:, 0, 2] = -0.5 * 9.8 * np.maximum(times - released, 0) ** 2
    x += 1e-5 * generator.normal(size=x.shape)
    x[20] += 1.0  # one frame is a glitch, not a release
    rest = slice(0, 15)
    assert estimate_release(times, x, rest, *rest_positions(x, rest)) == pytest.approx(released, abs=2e-3)
    assert estimate_release(times, x[:, 1:], rest, *rest_positions(x[:, 1:], rest)) is None


def test_c3d_is_read_with_its_gaps_and_units(folder):
    writer, moved = c3d.Writer(point_rate=50.0), np.arange(24, dtype=np.float32).reshape(4, 2, 3)
    writer.set_point_labels(["tip", "base"])
    for k, points in enumerate(moved):
        frame = np.zeros((2, 5), dtype=np.float32)
        frame[:, :3] = points
        frame[1, 3] = -1.0 if k == 2 else 0.0
        writer.add_frames([(frame, np.zeros((0, 0)))])
    with (folder / "one.c3d").open("wb") as file:
        writer.write(file)
    table = read_c3d(folder / "one.c3d")
    assert table.markers == ("tip", "base")
    assert table.rate == 50.0
    assert table.unit == "mm"
    np.testing.assert_allclose(table.positions[:, 0], moved[:, 0], atol=0.05)
    assert np.isnan(table.positions[2, 1]).all()
    assert not np.isnan(table.positions[[0, 1, 3]]).any()
    (folder / "one.c3d").write_bytes(b"x")
    refused(folder, "is not a C3D file", runs=[{"file": "one.c3d"}])


def test_reading_is_light():
    code = "import sys, masiv.tracks.read, masiv.tracks.summary; assert not {'torch', 'taichi'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_inspect(folder, monkeypatch, capfd):
    from masiv.cli import main

    picture = folder / "out" / "tracks.png"
    monkeypatch.setattr(sys, "argv", ["masiv", "inspect", str(folder), "--out", str(picture), "--json"])
    with pytest.raises(SystemExit) as ended:
        main.run()
    out = capfd.readouterr().out
    assert ended.value.code == 0
    summary = json.loads(out)
    assert picture.read_bytes()[:4] == b"\x89PNG"
    assert summary["layout"] == "tracks"
    assert summary["bodies"][0]["volume_m3"] == pytest.approx(9e-5)
    assert summary["runs"][0]["placement_error_mm"] < 1e-3
    assert summary["runs"][0]["gaps"]["longest_s"] == pytest.approx(0.03)


def measured() -> Path:
    folder = Path(os.environ.get("MASIV_MEASURED", Path(__file__).parents[2] / "shared" / "measured")) / "silicone_beam"
    if not folder.is_dir():
        pytest.skip("no measured data: set MASIV_MEASURED to the folder that holds silicone_beam")
    return folder


def test_measured_silicone_beam(tmp_path):
    """The pose of the beam follows from its markers; the release from its motion; both files say the same."""
    source = measured()
    for name in ("beam.stl", "beam_gravity_V2_a.csv", "beam_gravity_V2_a.c3d"):
        (tmp_path / name).symlink_to((source / name).resolve())
    places = {"tip1": [36, 15, 0], "tip2": [24, -6, 0], "tip3": [6, 36, 0],
              "base1": [-1, -10, 94], "base2": [27.5, 40, 94], "base3": [0, 40, 94]}  # fmt: skip
    body = {
        "density": 1070,
        "geometry": {"mesh": "beam.stl", "units": "mm", "markers_at": places},
        "clamp": {"half_space": {"normal": [0, 0, -1], "height": -100}, "markers": ["base1", "base2", "base3"]},
    }
    data = document(
        bodies={"beam": body}, up_axis="x", runs=[{"file": "beam_gravity_V2_a.csv", "rest_frames": [20, 60]}]
    )
    save(tmp_path, data)
    tracks = read_tracks(tmp_path)
    run = tracks.runs[0]
    assert tracks.bodies["beam"].mass == pytest.approx(0.0963, rel=1e-6)
    assert run.rate == pytest.approx(100)
    assert run.positions.shape == (500, 6, 3)
    assert run.placement.error < 1e-3
    assert 0.70 <= run.release <= 0.72
    assert summarise_tracks(tracks)["runs"][0]["noise_mm"] < 0.05
    pytest.importorskip("c3d")
    data["bodies"]["beam"]["geometry"].pop("markers_at")
    data["bodies"]["beam"]["clamp"]["markers"] = []
    data["runs"] = [{"file": "beam_gravity_V2_a.c3d", "rest_frames": [20, 60]}]
    save(tmp_path, data)
    raw = read_tracks(tmp_path).runs[0]
    np.testing.assert_allclose(raw.positions, run.positions, atol=1e-6)
    np.testing.assert_allclose(raw.times, run.times, atol=1e-9)
    assert raw.markers[0] == "Tip - 1"
