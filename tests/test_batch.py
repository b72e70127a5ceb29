"""Many runs at once: what a spec means, which stages share, what a failure, a killed worker and Ctrl-C leave."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import typer
import yaml

from cli.main import app
from masiv.batch.batch import run_batch
from masiv.batch.engine import engine
from masiv.batch.plan import stages_of
from masiv.batch.run import DONE, FAILED
from masiv.batch.spec import BatchSpec, jobs_of, read_spec
from masiv.config import load_config
from masiv.errors import InputError
from masiv.pipeline import Overrides

TESTS = Path(__file__).parent
BALLS = TESTS / "golden" / "balls"
SAMPLE = TESTS.parent / "assets" / "sample"


def spec_file(folder: Path, **keys) -> Path:
    path = folder / "study.yaml"
    path.write_text(yaml.safe_dump(keys))
    return path


def planned(path: Path, out: Path):
    spec = read_spec(path)
    jobs = jobs_of(spec, path.parent, path)
    return jobs, stages_of(spec, jobs, out)


def test_runs_of_one_scene_share_what_does_not_depend_on_the_law(tmp_path):
    path = spec_file(
        tmp_path, scenes=[str(SAMPLE), str(BALLS)], law=["neo_hookean", "newtonian"], preset="quick",
        variants={"plain": {}, "short": {"identify": {"iterations": 20}}, "sharp": {"reconstruct.iterations": 900}},
        refine=True, evaluate=True, fit_frames=6, holdout_camera=[1],
    )  # fmt: skip
    jobs, stages = planned(path, tmp_path / "out")
    assert len(jobs) == 2 * 2 * 3
    assert len({job.name for job in jobs}) == len(jobs)
    by_key = {stage.key: stage for stage in stages}
    assert sum(stage.name == "reconstruct" for stage in stages) == 2  # of two iteration counts
    assert sum(stage.name == "identify" for stage in stages) == len(jobs)
    first, second = (by_key[f"sample-{law}-plain/identify"] for law in ("neo_hookean", "newtonian"))
    assert first.after == second.after
    assert first.copy_of == second.copy_of == by_key[first.after[0]].folder != first.folder
    assert by_key["sample-neo_hookean-short/identify"].after == first.after
    assert by_key["sample-neo_hookean-sharp/identify"].after != first.after
    assert "identify.iterations=20" in by_key["sample-neo_hookean-short/identify"].command
    for place, stage in enumerate(stages):
        assert all(key in [s.key for s in stages[:place]] for key in stage.after)
    # what is for pictures alone is not asked of tracks
    tracks = [s for s in stages if s.run.startswith("balls")]
    assert not any("--fit-frames" in s.command or "--truth" in s.command for s in tracks)
    assert by_key["sample-newtonian-plain/evaluate"].after == ("sample-newtonian-plain/refine",)


def test_every_command_of_a_plan_is_one_that_masiv_takes(tmp_path):
    path = spec_file(
        tmp_path, scenes=[str(SAMPLE), str(BALLS)], law=["neo_hookean"], preset="quick", fit_frames=6, seed=[0, 3],
        holdout_camera=[1], keep_calibration=True, evaluate=True, refine={"group": True, "condition": "load"},
        set={"reconstruct.batch_size": 3, "refine": {"effects": ["swirl", "linear_drag"]}},
    )  # fmt: skip
    commands = typer.main.get_command(app).commands
    jobs, stages = planned(path, tmp_path / "out")
    assert len(jobs) == 4
    for stage in stages:
        name, *arguments = stage.command
        context = commands[name].make_context(name, list(arguments))
        given = context.params.get("assignments") or ()
        if name == "identify":
            assert "refine.effects=[swirl, linear_drag]" in given
            assert context.params["seed"] in (0, 3)


@pytest.mark.parametrize(
    ("keys", "why"),
    [
        ({"scenes": []}, "scenes"),
        ({"scenes": ["nowhere"]}, "nowhere does not exist"),
        ({"scenes": ["no*where"]}, "no folder matches"),
        ({"scenes": [str(BALLS)], "laws": ["auto"]}, "laws"),
        ({"scenes": [str(BALLS)], "law": "jelly_bean"}, "jelly_bean"),
        ({"scenes": [str(BALLS)], "seed": [1, 1]}, "given twice"),
        ({"scenes": [str(BALLS)], "set": {"identify.iteration": 3}}, "did you mean 'identify.iterations'"),
        ({"scenes": [str(BALLS)], "set": {"identify.iterations": -3}}, "greater than"),
        ({"scenes": [str(BALLS)], "set": {"seed": 3}}, "give it as seed"),
        ({"scenes": [str(BALLS)], "law": "auto", "set": {"identify.law": "auto"}}, "keep one"),
        ({"scenes": [str(BALLS)], "variants": {"a/b": {}}}, "variants"),
        ({"scenes": [str(BALLS)], "refine": {"groups": True}}, "refine"),
    ],
)
def test_a_spec_that_is_not_valid_makes_nothing(tmp_path, keys, why):
    with pytest.raises(InputError, match=why):
        run_batch(spec_file(tmp_path, **keys), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_options_of_the_command_are_of_all_runs(tmp_path):
    settings = tmp_path / "settings.yaml"
    settings.write_text("identify: {iterations: 7, family_rollouts: 9}")
    path = spec_file(tmp_path, scenes=[str(BALLS)], seed=[0, 1], set={"identify.iterations": 8})
    given = Overrides("paper", settings, 5, "cpu", ("tracks.particles=300",))
    (command,) = run_batch(path, tmp_path / "out", overrides=given, dry_run=True).data["commands"]
    context = typer.main.get_command(app).commands["identify"].make_context("identify", command[1:])
    assert (context.params["preset"], context.params["seed"], context.params["arch"]) == ("paper", 5, "cpu")
    config = load_config("paper", assignments=context.params["assignments"])
    assert (config.identify.iterations, config.identify.family_rollouts, config.tracks.particles) == (8, 9, 300)
    assert not (tmp_path / "out").exists()


def test_patterns_and_scenes_of_one_name(tmp_path):
    for parent in ("a", "b"):
        (tmp_path / parent / "ball").mkdir(parents=True)
    spec = BatchSpec.model_validate({"scenes": ["*/ball", "a/ball"]})
    jobs = jobs_of(spec, tmp_path, tmp_path / "study.yaml")
    assert [(job.name, job.scene.parent.name) for job in jobs] == [("ball", "a"), ("ball_2", "b")]


@pytest.fixture(scope="module")
def broken_scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("broken")
    scene = yaml.safe_load((BALLS / "scene.yaml").read_text())
    scene["runs"] = [{**run, "file": "missing.csv"} for run in scene["runs"]]
    (folder / "scene.yaml").write_text(yaml.safe_dump(scene))
    return folder


def states(out: Path) -> dict[str, str]:
    return {key: row["state"] for key, row in json.loads((out / "batch.json").read_text())["stages"].items()}


@pytest.mark.slow
def test_a_scene_that_fails_does_not_stop_the_others_and_runs_again(tmp_path, broken_scene):
    path = spec_file(tmp_path, scenes=[str(broken_scene), str(BALLS)], evaluate=True)
    out, broken = tmp_path / "out", broken_scene.name
    first = run_batch(path, out, workers=2, threads=1)
    rows = {row["run"]: row for row in first.data["runs"]}
    assert rows["balls"]["state"] == DONE
    assert rows["balls"]["fit_mm"] > 0
    assert rows[broken]["state"] == FAILED
    assert "missing.csv" in rows[broken]["message"]
    assert states(out) == {f"{broken}/identify": FAILED, "balls/identify": DONE, "balls/evaluate": DONE}
    for name in ("batch.csv", "batch.html"):
        assert "balls" in (out / name).read_text()
    assert 'href="runs/balls/report.html"' in (out / "batch.html").read_text()
    kept = (out / "runs" / "balls" / "report.html").stat().st_mtime_ns
    again = run_batch(path, out, workers=1, threads=1)
    assert [row["state"] for row in again.data["runs"]] == [FAILED, DONE]
    assert (out / "runs" / "balls" / "report.html").stat().st_mtime_ns == kept


def test_without_dask_the_stages_are_waited_for_by_threads(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with engine(2, None) as executor:
        assert list(executor.map(abs, [-1, 2, -3])) == [1, 2, 3]
    with pytest.raises(InputError, match=r"pip install 'masiv\[batch\]'"), engine(2, "tcp://127.0.0.1:1"):
        pass


def test_a_scheduler_that_does_not_answer(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("masiv.batch.engine.CONNECT_S", 1)
    with pytest.raises(InputError, match="no Dask scheduler answers there"), engine(1, "tcp://127.0.0.1:1"):
        pass


def command(path: Path, out: Path, *more: str) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-m", "cli.supervisor", "batch", str(path), "--out", str(out), "--threads", "1", *more],
        cwd=TESTS.parent, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


def wait_for(path: Path, process: subprocess.Popen) -> None:
    """Until a stage has begun to write its run folder."""
    began = time.monotonic()
    while not path.exists():
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < began + 120
        time.sleep(0.05)


@pytest.mark.slow
def test_a_worker_that_is_killed_is_replaced(tmp_path):
    psutil = pytest.importorskip("psutil")
    pytest.importorskip("distributed")
    path, out = spec_file(tmp_path, scenes=[str(BALLS)], seed=[0, 1]), tmp_path / "out"
    process = command(path, out, "--workers", "1")
    wait_for(out / "runs" / "balls-seed0" / "run.yaml", process)
    stages = [p for p in psutil.Process(process.pid).children(recursive=True) if "identify" in p.cmdline()]
    worker = min(stages, key=lambda p: p.create_time()).parent()
    assert "identify" not in worker.cmdline()
    worker.kill()
    text = process.communicate(timeout=300)[0]
    assert process.returncode == 0, text
    assert set(states(out).values()) == {DONE}


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="signals of POSIX")
def test_ctrl_c_ends_it_and_the_same_command_goes_on(tmp_path):
    path, out = spec_file(tmp_path, scenes=[str(BALLS)], seed=[0, 1]), tmp_path / "out"
    process = command(path, out, "--workers", "1")
    wait_for(out / "runs" / "balls-seed0" / "run.yaml", process)
    process.send_signal(signal.SIGINT)
    text = process.communicate(timeout=30)[0]
    assert process.returncode == 130, text
    assert not states(out)
    text = command(path, out, "--workers", "1").communicate(timeout=300)[0]
    assert set(states(out).values()) == {DONE}, text


@pytest.mark.slow
def test_runs_that_share_give_what_they_give_alone(tmp_path):
    settings = {"reconstruct.iterations": 40, "identify.iterations": 4, "identify.processes": 1}
    keys = {"scenes": [str(SAMPLE)], "preset": "quick", "set": settings, "fit_frames": 5}
    alone = run_batch(spec_file(tmp_path, law="newtonian", **keys), tmp_path / "alone", workers=1, threads=2)
    both = run_batch(
        spec_file(tmp_path, law=["neo_hookean", "newtonian"], **keys), tmp_path / "both", workers=1, threads=2
    )
    assert [row["state"] for row in both.data["runs"]] == [DONE, DONE]
    assert both.data["runs"][1]["fit_mm"] == alone.data["runs"][0]["fit_mm"]
    assert both.data["runs"][0]["fit_mm"] != alone.data["runs"][0]["fit_mm"]
