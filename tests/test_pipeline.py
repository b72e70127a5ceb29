"""The whole job as a user runs it: synthesise, identify, get killed, go on, evaluate, simulate what was never
filmed."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from run_folder_page import missing
from small import SMALL

SPEC = {
    "shape": {"kind": "cube", "size": 0.4, "rotation_deg": [20, 30, 0], "clearance": 0.25},
    "material": {"law": "neo_hookean", "parameters": {"youngs_modulus": 4e4, "poissons_ratio": 0.3}},
    "velocity": [0.5, -1.5, 0.0],
    "frames": 6,
    "cameras": {"count": 6, "size": 48, "field_of_view_deg": 28},
    "truth_particles": 500,
}
TINY = {
    "simulator": SMALL.model_dump(exclude_defaults=True),
    "reconstruct": {"gaussians": 250, "hull_resolution": 24, "iterations": 120, "width": 16, "depth": 1},
    "trajectory": {"particle_count": 300, "fill_resolution": 24, "iterations": 20},
    "identify": {"start": "jelly", "contact": "sticky", "search_particles": 150, "iterations": 4},
}


def masiv(*arguments):
    code = "from masiv.cli.main import run; run()"
    return [sys.executable, "-c", code, *map(str, arguments)]


def done(*arguments):
    """What the command prints on stdout: one JSON object."""
    ended = subprocess.run(masiv(*arguments, "--json"), capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pipeline")
    (folder / "spec.yaml").write_text(yaml.safe_dump(SPEC))
    (folder / "tiny.yaml").write_text(yaml.safe_dump(TINY))
    done("synth", folder / "spec.yaml", "--out", folder / "scene")
    # A fit must not need the truth, so it is not there to be read.
    os.rename(folder / "scene" / "gt", folder / "gt")
    os.remove(folder / "scene" / "truth.yaml")
    return folder


def identify(folder, name):
    return ("identify", folder / "scene", "--out", folder / name, "--config", folder / "tiny.yaml", "--fit-frames", 5)


@pytest.fixture(scope="module")
def whole(folder):
    """A run that nothing interrupted."""
    done(*identify(folder, "whole"))
    return folder / "whole"


KILLED = """
import os, signal, sys
from pathlib import Path
import yaml

folder, stage = Path(sys.argv.pop(1)), sys.argv.pop(1)
record, busy = folder / "run.yaml", [False]

def kill(event, arguments):
    if event != "open" or busy[0] or not isinstance(arguments[0], (str, Path)):
        return
    path, writes = Path(arguments[0]), arguments[2] & (os.O_WRONLY | os.O_RDWR)
    if not (writes and folder in path.parents and record.exists()):
        return
    busy[0] = True  # reading opens a file, too
    if yaml.safe_load(record.read_text())["stages"][stage]["state"] == "running":
        os.kill(os.getpid(), signal.SIGKILL)
    busy[0] = False

sys.addaudithook(kill)
from masiv.cli.main import run
run()
"""


def killed_in(stage, run, arguments):
    """Run the command, and kill it as a power cut would when ``stage`` writes its first file to the folder ``run``."""
    command = [sys.executable, "-c", KILLED, run, stage, *arguments]
    ended = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False)
    assert ended.returncode == -signal.SIGKILL, ended.stderr


@pytest.mark.slow
def test_killed_fit_of_tracks_ends_with_the_numbers_of_a_whole_one(tmp_path):
    scene = Path(__file__).parent / "golden/balls"
    whole, broken = (("identify", scene, "--out", tmp_path / name) for name in ("whole", "broken"))
    done(*whole)
    killed_in("identify", tmp_path / "broken", broken)
    assert not (tmp_path / "broken/twin.yaml").exists()
    done(*broken)
    assert (tmp_path / "whole/twin.yaml").read_bytes() == (tmp_path / "broken/twin.yaml").read_bytes()


@pytest.mark.slow
def test_killed_run_ends_with_the_numbers_of_a_whole_one(folder, whole):
    killed_in("reconstruct", folder / "broken", identify(folder, "broken"))
    killed_in("identify", folder / "broken", identify(folder, "broken"))
    done(*identify(folder, "broken"))
    for name in ("trajectory.npz", "rollout.npz"):
        first, second = (np.load(path / name)["positions"] for path in (whole, folder / "broken"))
        assert np.array_equal(first, second)
    assert (whole / "twin.yaml").read_bytes() == (folder / "broken/twin.yaml").read_bytes()
    assert (whole / "material.json").read_bytes() == (folder / "broken/material.json").read_bytes()
    for name in ("gaussians.ply", "deformation.safetensors", "law.safetensors", "metrics.json", "report.html"):
        assert (folder / "broken" / name).stat().st_size > 0
    rollout = np.load(whole / "rollout.npz")
    assert rollout["positions"].shape[0] == len(rollout["times"]) == SPEC["frames"]
    assert rollout["positions"].dtype == np.float32


@pytest.mark.slow
def test_a_run_whose_material_is_missing_makes_it_again_and_nothing_else(folder, whole):
    shutil.copytree(whole, folder / "again")
    (folder / "again/material.json").unlink()
    done(*identify(folder, "again"))
    for name in ("material.json", "twin.yaml", "law.safetensors"):
        assert (folder / "again" / name).read_bytes() == (whole / name).read_bytes()


@pytest.mark.slow
def test_evaluate_separates_observed_from_future(folder, whole):
    numbers = done("evaluate", whole, "--truth", folder / "gt")
    twin = numbers["motion"]["twin"]
    assert twin["observed"]["frames"] == [0, 1, 2, 3, 4]
    assert twin["future"]["frames"] == [5]
    shutil.copytree(whole, folder / "alone/whole")
    alone = done("evaluate", folder / "alone/whole", "--truth", folder / "gt")
    assert alone["motion"] == numbers["motion"]
    assert numbers["twin"]
    assert (alone["reconstruction"], alone["twin"]) == (None, None)
    again = done("evaluate", folder / "alone/whole", "--truth", folder / "gt", "--scene", folder / "scene")
    assert again["twin"] == numbers["twin"]
    assert missing(whole, "pictures") == []
    rigid = numbers["motion"]["rigid, stops at the ground"]
    assert twin["observed"]["tracked_error_mm"] < 25
    assert twin["future"]["tracked_error_mm"] < rigid["future"]["tracked_error_mm"]


@pytest.mark.slow
def test_simulate_starts_from_the_identified_motion(folder, whole):
    shutil.copytree(whole, folder / "moved/whole")
    done("simulate", folder / "moved/whole", "--frames", 3, "--out", folder / "same")  # without the scene
    as_filmed, again = (np.load(path / "rollout.npz")["positions"] for path in (whole, folder / "same"))
    assert np.array_equal(as_filmed[:3], again)
    done(
        "simulate", whole, "--frames", 3, "--velocity", "1,0,0", "--gravity=0,0,0", "--out", folder / "new", "--render"
    )
    new = np.load(folder / "new" / "rollout.npz")
    drift = (new["positions"][1] - new["positions"][0]).mean(0) / new["times"][1]
    np.testing.assert_allclose(drift, [1.0, 0.0, 0.0], atol=2e-3)
    assert (folder / "new" / "video.mp4").stat().st_size > 0
    assert len(list((folder / "new" / "views").rglob("*.png"))) == 3
