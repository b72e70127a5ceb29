"""A run folder keeps what was asked, goes on after a kill, and refuses what differs."""

from __future__ import annotations

import os
import shutil

import numpy as np
import pytest
import yaml

from masiv.config import load_config
from masiv.errors import InputError, MasivError
from masiv.runfolder import Request, RunFolder, load_motion

SCENE = {"fps": 24.0, "frames": 16, "gravity_m_s2": [0.0, -9.8, 0.0], "cameras_sha256": "ab"}


def request(tmp_path, scene=SCENE, fit_frames=12, holdout=(3,), **changes):
    config = load_config("quick").model_dump(mode="json")
    for dotted, value in changes.items():
        section, key = dotted.split("__")
        config[section] = {**config[section], key: value}
    return Request(config, tmp_path / "scene", scene, fit_frames, holdout)


def test_a_new_run_says_what_was_asked(tmp_path):
    run = RunFolder.create_or_resume(tmp_path / "a/run", request(tmp_path))
    record = yaml.safe_load((tmp_path / "a/run/run.yaml").read_text())
    assert record["config"] == load_config("quick").model_dump(mode="json")
    assert record["split"] == {"fit_frames": 12, "holdout_cameras": [3]}
    assert {s["state"] for s in record["stages"].values()} == {"pending"}
    assert record["versions"]["numpy"] == np.__version__
    assert (run.fit_frames, run.holdout_cameras) == (12, (3,))


def test_stage_goes_pending_running_done(tmp_path):
    run = RunFolder.create_or_resume(tmp_path / "run", request(tmp_path))
    with run.stage("reconstruct") as checkpoint:
        assert RunFolder.open(run.path).record["stages"]["reconstruct"]["state"] == "running"
        checkpoint.save({"iteration": 3})
    again = RunFolder.open(run.path)
    assert again.done("reconstruct")
    assert not again.done("trajectory")
    assert again.seconds()["reconstruct"] >= 0
    assert run.checkpoint("reconstruct").load() is None


def test_a_failed_stage_keeps_its_checkpoint(tmp_path):
    run = RunFolder.create_or_resume(tmp_path / "run", request(tmp_path))

    def work():
        with run.stage("reconstruct") as checkpoint:
            checkpoint.save({"iteration": 3})
            raise MasivError("full disk")

    with pytest.raises(MasivError):
        work()
    again = RunFolder.create_or_resume(run.path, request(tmp_path))
    assert not again.done("reconstruct")
    assert again.checkpoint("reconstruct").load() == {"iteration": 3}
    with pytest.raises(InputError, match="no finished reconstruct"):
        again.require("reconstruct")


def test_the_same_request_resumes_and_another_is_refused(tmp_path):
    path = tmp_path / "run"
    run = RunFolder.create_or_resume(path, request(tmp_path))
    with run.stage("reconstruct"):
        pass
    RunFolder.create_or_resume(path, request(tmp_path))
    RunFolder.create_or_resume(path, request(tmp_path, reconstruct__processes=1))  # which changes no number
    cases = [
        (request(tmp_path, fit_frames=10), "fit_frames 12 → 10"),
        (request(tmp_path, holdout=()), "holdout_cameras"),
        (request(tmp_path, scene={**SCENE, "fps": 30.0}), "not the scene of the run.*scene fps 24.0 → 30.0"),
        (request(tmp_path, reconstruct__iterations=7), "reconstruct.iterations"),
    ]
    for asked, message in cases:
        with pytest.raises(InputError, match=message) as error:
            RunFolder.create_or_resume(path, asked)
        assert "--out" in str(error.value)


def test_settings_of_a_stage_not_begun_may_change(tmp_path):
    path = tmp_path / "run"
    run = RunFolder.create_or_resume(path, request(tmp_path))
    with run.stage("reconstruct"):
        pass
    RunFolder.create_or_resume(path, request(tmp_path, identify__iterations=77))
    assert RunFolder.open(path).config["identify"]["iterations"] == 77
    assert RunFolder.open(path).done("reconstruct")


def test_what_a_refused_run_was_asked_does_not_count(tmp_path):
    path = tmp_path / "run"
    RunFolder.create_or_resume(path, request(tmp_path, reconstruct__iterations=7))
    assert RunFolder.begun_in(path) is None
    other = request(tmp_path, scene={**SCENE, "fps": 30.0}, fit_frames=10, reconstruct__iterations=8)
    run = RunFolder.create_or_resume(path, other)
    assert RunFolder.open(path).record == run.record
    assert (run.fit_frames, run.record["scene"]["fps"], run.config["reconstruct"]["iterations"]) == (10, 30.0, 8)
    with run.stage("reconstruct"):
        pass
    begun = RunFolder.begun_in(path)
    assert begun is not None
    assert begun.record == run.record
    assert RunFolder.begun_in(tmp_path / "none") is None


def test_a_run_made_before_a_key_existed_opens(tmp_path):
    """The missing key had what is the default today; asking for another value is another request."""
    path = tmp_path / "run"
    run = RunFolder.create_or_resume(path, request(tmp_path))
    with run.stage("reconstruct"):
        pass
    record = yaml.safe_load((path / "run.yaml").read_text())
    default = record["config"]["reconstruct"].pop("prune_opacity")
    del record["config"]["simulator"]
    (path / "run.yaml").write_text(yaml.safe_dump(record))
    with pytest.raises(InputError, match=r"reconstruct\.prune_opacity"):
        RunFolder.create_or_resume(path, request(tmp_path, reconstruct__prune_opacity=2 * default))
    RunFolder.create_or_resume(path, request(tmp_path))
    assert RunFolder.open(path).config["reconstruct"]["prune_opacity"] == default
    with pytest.raises(InputError, match=r"reconstruct\.iterations"):
        RunFolder.create_or_resume(path, request(tmp_path, reconstruct__iterations=7))


def test_a_run_of_an_earlier_version_is_resumed(tmp_path):
    """Its keys have older names."""
    run = RunFolder.create_or_resume(tmp_path / "run", request(tmp_path))
    with run.stage("reconstruct"):
        pass
    record = yaml.safe_load((run.path / "run.yaml").read_text())
    values = record["config"]["reconstruct"]
    values["pictures"] = values.pop("batch_size")
    (run.path / "run.yaml").write_text(yaml.safe_dump(record))
    assert RunFolder.open(run.path).config == run.config
    assert RunFolder.create_or_resume(run.path, request(tmp_path)).done("reconstruct")


def test_a_folder_with_something_else_is_left_alone(tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos/cat.jpg").write_text("cat")
    with pytest.raises(InputError, match="not a run folder"):
        RunFolder.create_or_resume(tmp_path / "photos", request(tmp_path))
    assert [p.name for p in (tmp_path / "photos").iterdir()] == ["cat.jpg"]
    with pytest.raises(InputError, match="not a run folder"):
        RunFolder.open(tmp_path)


def test_a_run_and_its_scene_can_be_moved_together(tmp_path):
    (tmp_path / "here").mkdir()
    asked = request(tmp_path / "here", identify__also=[str(tmp_path / "here/other")])
    RunFolder.create_or_resume(tmp_path / "here/runs/run", asked)
    assert yaml.safe_load((tmp_path / "here/runs/run/run.yaml").read_text())["scene"]["path"] == "../../scene"
    shutil.move(tmp_path / "here", tmp_path / "there")
    moved = RunFolder.open(tmp_path / "there/runs/run")
    assert moved.scene_path == tmp_path / "there/scene"
    assert moved.config["identify"]["also"] == [str(tmp_path / "there/other")]
    again = request(tmp_path / "there", identify__also=[str(tmp_path / "there/other")])
    RunFolder.create_or_resume(moved.path, again)


def test_a_run_of_schema_1_is_read_and_becomes_one_of_schema_2(tmp_path):
    path = tmp_path / "run"
    RunFolder.create_or_resume(path, request(tmp_path))
    record = yaml.safe_load((path / "run.yaml").read_text())
    record |= {"schema": 1, "scene": {**record["scene"], "path": str(tmp_path / "scene")}}
    (path / "run.yaml").write_text(yaml.safe_dump(record))
    assert RunFolder.open(path).scene_path == tmp_path / "scene"
    RunFolder.create_or_resume(path, request(tmp_path))
    again = yaml.safe_load((path / "run.yaml").read_text())
    assert (again["schema"], again["scene"]["path"]) == (2, "../scene")
    (path / "run.yaml").write_text(yaml.safe_dump({**again, "schema": 3}))
    with pytest.raises(InputError, match=r"schema 3.*newer version"):
        RunFolder.open(path)


def test_what_a_killed_process_left_half_written_is_removed(tmp_path):
    path = tmp_path / "run"
    run = RunFolder.create_or_resume(path, request(tmp_path))
    (path / "checkpoints").mkdir()
    for name in ("rollout.123.tmp.npz", "checkpoints/identify.123.tmp.pt", "mine.tmp.npz"):
        (path / name).touch()
    with run.locked():
        assert (path / "rollout.123.tmp.npz").exists()  # of a process that may be at work
    (path / "lock.json").write_text("{}")
    os.utime(path / "lock.json", (0, 0))
    with pytest.warns(UserWarning, match="has ended"), run.locked():
        assert {p.name for p in path.rglob("*.tmp.*")} == {"mine.tmp.npz"}


def test_a_lock_sees_the_state_in_which_another_process_left_the_run(tmp_path):
    one, other = (RunFolder.create_or_resume(tmp_path / "run", request(tmp_path)) for _ in range(2))
    with one.locked(), one.stage("reconstruct"):
        pass
    assert not other.done("reconstruct")
    with other.locked():
        assert other.done("reconstruct")


def test_motion_round_trip(tmp_path):
    positions = np.random.default_rng(0).random((3, 5, 3)).astype(np.float32)
    np.savez(tmp_path / "rollout.npz", positions=positions, times=np.arange(3) / 24)
    again, times = load_motion(tmp_path / "rollout.npz")
    np.testing.assert_array_equal(again, positions)
    np.testing.assert_array_equal(times, np.arange(3) / 24)
    with pytest.raises(InputError, match="not a rollout"):
        load_motion(tmp_path / "nothing.npz")
