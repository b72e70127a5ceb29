"""The commands as a user runs them: exit codes, one JSON object, one sentence."""

from __future__ import annotations

import json
import resource
import shutil
import subprocess
import sys

import cv2
import numpy as np
import pytest

from masiv import __version__
from masiv.cli import main

COMMANDS = [command.name or command.callback.__name__ for command in main.app.registered_commands]


class Result:
    def __init__(self, returncode, stdout, stderr):
        self.returncode, self.stdout, self.stderr = returncode, stdout, stderr


@pytest.fixture
def masiv(monkeypatch, capfd):
    """Run a command in this process: a fresh one each would mostly measure imports."""

    def run(*arguments, cwd=None):
        monkeypatch.setattr(sys, "argv", ["masiv", *map(str, arguments)])
        if cwd is not None:
            monkeypatch.chdir(cwd)
        with pytest.raises(SystemExit) as ended:
            main.run()
        return Result(ended.value.code, *capfd.readouterr())

    return run


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A red square that falls, seen by two cameras that face each other."""
    folder = tmp_path_factory.mktemp("scene")
    (folder / "data").mkdir()
    rows = []
    for view, sign in ((0, 1.0), (1, -1.0)):
        pose = np.diag([sign, 1.0, sign]), np.array([0, 0.5, sign * 2])
        for frame in range(3):
            image = np.full((32, 32, 3), 90, np.uint8)
            cutout = np.full((32, 32, 3), 255, np.uint8)
            for target in (image, cutout):
                target[8 + frame : 18 + frame, 10:20] = (20, 20, 220)
            cv2.imwrite(str(folder / f"data/r_{view}_{frame}.png"), image)
            cv2.imwrite(str(folder / f"data/m_{view}_{frame}.png"), cutout)
            rows.append(
                {
                    "file_path": f"./data/r_{view}_{frame}.png",
                    "c2w": np.column_stack(pose).tolist(),
                    "intrinsic": [[40, 0, 16], [0, 40, 16], [0, 0, 1]],
                    "time": frame / 24,
                }
            )
    (folder / "all_data.json").write_text(json.dumps(rows))
    return folder


def test_help_imports_nothing_heavy():
    """In a process of its own: the help of a command must not wait for numpy or torch."""
    code = """
import atexit, sys
atexit.register(lambda: print("imported:", *sorted({"cv2", "numpy", "scipy", "taichi", "torch"} & sys.modules.keys())))
from masiv.cli.main import run
run()
"""
    result = subprocess.run([sys.executable, "-c", code, "--help"], capture_output=True, text=True, check=False)
    assert result.returncode == 0
    assert all(name in result.stdout for name in COMMANDS)
    assert result.stdout.splitlines()[-1].split() == ["imported:"]


def test_version(masiv):
    result = masiv("--version")
    assert (result.returncode, result.stdout) == (0, f"masiv {__version__}\n")


def test_commands_are_those_of_the_application():
    """The tests of each command have something to test."""
    assert {"identify", "refine", "synth"} <= set(COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_an_example_and_the_shared_options(masiv, command):
    text = masiv(command, "--help").stdout
    assert f"masiv {command}" in text
    for option in ("--config", "--preset", "--arch", "--seed", "--json"):
        assert option in text


def test_inspect_prints_one_json_object_and_draws(masiv, scene, tmp_path):
    result = masiv("inspect", scene, "--json", "--out", tmp_path / "sheet.png")
    assert result.returncode == 0, result.stderr
    data = json.loads(result.stdout)
    assert (data["frames"], data["views"], data["fps"], data["problems"]) == (3, 2, 24, [])
    assert data["mask_coverage"]["mean"] == pytest.approx(100 / 1024)
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    assert sheet.shape == (2 * 160, 3 * 160, 3)
    assert (sheet == (0, 60, 255)).all(-1).any()  # the outline, in BGR


def test_inspect_for_a_person(masiv, scene, tmp_path):
    result = masiv("inspect", scene, cwd=tmp_path)
    assert "3 at 24 fps" in result.stdout
    assert "gravity (0, -9.8, 0) m/s²" in result.stdout
    assert list(tmp_path.glob("*_inspect.png"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["inspect", "/nowhere"], "/nowhere is not a folder"),
        (["inspect", "SCENE", "--preset", "fast"], "unknown preset 'fast'"),
        (["inspect", "SCENE", "--frobnicate"], "--frobnicate"),
        (["inspect"], "SCENE"),
        (["reconstruct", "SCENE", "--out", "OUT", "--fit-frames", "9"], "give 2 to 3"),
        (["reconstruct", "SCENE", "--out", "OUT", "--holdout-camera", "2"], "cameras 0 to 1"),
        (["reconstruct", "SCENE", "--out", "OUT", "--config", "/none.yaml"], "/none.yaml"),
        (["identify", "SCENE", "--out", "SCENE"], "not a run folder"),
        (["trajectory", "SCENE"], "not a run folder"),
        (["evaluate", "SCENE", "--truth", "SCENE"], "not a run folder"),
        (["simulate", "SCENE", "--frames", "3", "--velocity", "1,2"], "three finite numbers"),
        (["pretrain", "cheese"], "cheese"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_code_2(masiv, scene, tmp_path, arguments, message):
    filled = [{"SCENE": str(scene), "OUT": str(tmp_path / "run")}.get(a, a) for a in arguments]
    result = masiv(*filled, "--json", cwd=tmp_path)
    assert result.returncode == 2, result.stderr
    assert message in json.loads(result.stdout)["error"]
    sentences = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert len(sentences) == 1
    assert "Traceback" not in result.stderr
    assert not (tmp_path / "run").exists()


def moved_apart(scene, target, frame):
    """A copy of the scene in which no volume projects on the masks of both cameras at ``frame``."""
    shutil.copytree(scene, target)
    for view, rows in ((0, -6), (1, 8)):
        for kind in "rm":
            path = target / f"data/{kind}_{view}_{frame}.png"
            cv2.imwrite(str(path), np.roll(cv2.imread(str(path)), rows, axis=0))
    return target


def test_work_that_fails_is_exit_code_1(masiv, scene, tmp_path):
    broken = moved_apart(scene, tmp_path / "scene", 1)
    result = masiv("reconstruct", broken, "--out", tmp_path / "run", "--json")
    assert result.returncode == 1, result.stderr
    assert "frame 1" in json.loads(result.stdout)["error"]


def test_a_first_frame_without_an_object_is_bad_input(masiv, scene, tmp_path):
    broken = moved_apart(scene, tmp_path / "scene", 0)
    result = masiv("reconstruct", broken, "--out", tmp_path / "run", "--json")
    assert result.returncode == 2, result.stderr
    assert "no volume" in json.loads(result.stdout)["error"]
    assert not (tmp_path / "run").exists()
    assert any(
        "no volume" in p for p in json.loads(masiv("inspect", broken, "--json", cwd=tmp_path).stdout)["problems"]
    )


def test_a_file_that_the_system_cannot_hold_is_one_sentence_and_exit_code_1(masiv, scene, tmp_path):
    """As on a full disk, with a limit of 1 kB a file in its place."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        result = masiv("inspect", scene, "--out", tmp_path / "sheet.png")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert result.returncode == 1
    assert result.stderr.startswith(f"error: {tmp_path / 'sheet.png'}: File too large")
    assert len(result.stderr.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["taken/x.png", "taken", "x" * 300])
def test_an_impossible_place_is_one_sentence_and_exit_code_2(masiv, scene, tmp_path, name):
    (tmp_path / "taken").mkdir() if name == "taken" else (tmp_path / "taken").write_text("a file")
    result = masiv("inspect", scene, "--out", tmp_path / name)
    assert result.returncode == 2, result.stderr
    assert str(tmp_path / name.split("/")[0])[:150] in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert [p.name for p in tmp_path.iterdir()] == ["taken"]


def test_a_wrong_option_is_named(masiv, scene, tmp_path):
    (tmp_path / "settings.yaml").write_text("seed: 3")
    for option, value in (("--law", "typo"), ("--geometry-loss", "typo"), ("--arch", "typo"), ("--seed", "-1")):
        result = masiv("identify", scene, "--config", tmp_path / "settings.yaml", option, value, cwd=tmp_path)
        assert result.returncode == 2, result.stderr
        assert option in result.stderr
        assert "settings.yaml" not in result.stderr
