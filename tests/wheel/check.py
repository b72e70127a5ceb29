"""Does what users install work? Needs the package ``build``; everything happens in a temporary folder.

    python tests/wheel/check.py [--reduced] [--torch-index URL]

The sdist is built from the repository and the wheel from the sdist. The wheel is installed into an empty environment,
and its commands run there, from a folder that is not the repository. Exits with 1 at the first thing that fails.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TINY = Path(__file__).with_name("tiny.yaml")
INSTALLED_AS = {"masiv": "masiv", "cli": "masiv/cli", "assets": "masiv/assets"}
NOT_INSTALLED = "assets/sample"
COMMANDS = "from masiv.cli.main import app; print(*(c.name or c.callback.__name__ for c in app.registered_commands))"
SCENE_OF_TRACKS = """\
layout: tracks
units: m
up_axis: y
columns: {time: t, markers: {centre: {y: height}}}
bodies:
  ball: {mass: 0.06, geometry: {sphere: 0.065, units: m, markers_at: {centre: [0, 0, 0]}}}
runs:
  - {file: fall.csv}
"""


class Failed(Exception):
    """What was found wrong."""


def run(*command: str | Path, cwd: Path) -> str:
    """What the command prints on stdout. Raises Failed if it exits with another code than 0."""
    print("$", *command, flush=True)
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | {"PYTHONUTF8": "1"}
    ended = subprocess.run(
        [str(c) for c in command], cwd=cwd, env=environment, stdout=subprocess.PIPE, text=True, encoding="utf-8"
    )
    if ended.returncode != 0:
        raise Failed(f"exit code {ended.returncode}: {ended.stdout}")
    return ended.stdout


def built_wheel(folder: Path) -> Path:
    """The wheel that is built from the sdist of the repository."""
    run(sys.executable, "-m", "build", "--outdir", folder, ROOT, cwd=folder)
    (wheel,) = folder.glob("*.whl")
    return wheel


def check_content(wheel: Path) -> None:
    """The wheel holds the package ``masiv`` and nothing beside it, and every file that the repository tracks of it."""
    names = set(zipfile.ZipFile(wheel).namelist())
    foreign = sorted(n for n in names if not n.startswith("masiv/") and ".dist-info/" not in n)
    tracked = run("git", "ls-files", *INSTALLED_AS, cwd=ROOT).split()
    wanted = {
        INSTALLED_AS[folder] + "/" + path
        for folder, _, path in (name.partition("/") for name in tracked if not name.startswith(NOT_INSTALLED))
    }
    missing = sorted(wanted - names)
    if foreign or missing or not wanted:
        raise Failed(f"{wheel.name}: beside masiv it holds {foreign}; it lacks {missing}")


def installed(wheel: Path, folder: Path, torch_index: str | None) -> Path:
    """The folder with the commands of a new environment that holds the wheel and what it depends on."""
    venv.create(folder, with_pip=True)
    bin = folder / ("Scripts" if os.name == "nt" else "bin")
    pip = bin / "python", "-m", "pip", "install", "--quiet", "--retries", "1", "--constraint", ROOT / "constraints.txt"
    if torch_index:  # alone, so that nothing else is looked for there
        run(*pip, "--extra-index-url", torch_index, "--no-deps", "torch", cwd=folder)
    run(*pip, wheel, cwd=folder)
    return bin


def write_tracks(folder: Path) -> Path:
    """A scene of tracks: a ball that falls for half a second."""
    folder.mkdir()
    rows = [f"{t:.3f},{2 - 4.9 * t * t:.6f}" for t in (k / 50 for k in range(26))]
    (folder / "fall.csv").write_text("\n".join(["t,height", *rows, ""]), encoding="utf-8")
    (folder / "scene.yaml").write_text(SCENE_OF_TRACKS, encoding="utf-8")
    return folder


def check_start(bin: Path, wheel: Path, cwd: Path) -> None:
    """Version, import, help of each command; ``cli`` and ``assets`` are no packages."""
    version = run(bin / "masiv", "--version", cwd=cwd).split()
    if version != ["masiv", wheel.name.split("-")[1]]:
        raise Failed(f"{wheel.name} says that it is {version}")
    run(bin / "python", "-c", "import masiv", cwd=cwd)
    for name in ("cli", "assets"):
        run(
            bin / "python",
            "-c",
            f"import importlib.util as u, sys; sys.exit(u.find_spec('{name}') is not None)",
            cwd=cwd,
        )
    commands = run(bin / "python", "-c", COMMANDS, cwd=cwd).split()
    if not commands:
        raise Failed("masiv has no commands")
    for command in commands:
        if f"masiv {command}" not in run(bin / "masiv", command, "--help", cwd=cwd):
            raise Failed(f"masiv {command} --help shows no example")


def check_work(bin: Path, cwd: Path) -> None:
    """The sample from pictures to a report."""
    run(
        bin / "masiv",
        "identify",
        ROOT / "assets" / "sample",
        "--out",
        "run",
        "--config",
        TINY,
        "--fit-frames",
        "4",
        cwd=cwd,
    )
    run(bin / "masiv", "refine", "run", "--config", TINY, cwd=cwd)
    for name in ("twin.yaml", "law.safetensors", "refine.json", "report.html"):
        if not (cwd / "run" / name).is_file():
            raise Failed(f"run/{name} is missing")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--reduced", action="store_true", help="leave out identify and refine: no kernel is compiled")
    parser.add_argument("--torch-index", help="where the build of torch for CPUs is, if plain torch brings CUDA along")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="wheeltest-", ignore_cleanup_errors=True) as temporary:
        folder = Path(temporary)
        elsewhere = folder / "elsewhere"
        elsewhere.mkdir()
        try:
            wheel = built_wheel(folder)
            check_content(wheel)
            bin = installed(wheel, folder / "environment", asked.torch_index)
            check_start(bin, wheel, elsewhere)
            scene = write_tracks(folder / "tracks")
            if "26 frames at 50 Hz" not in run(bin / "masiv", "inspect", scene, cwd=elsewhere):
                raise Failed("inspect does not say what it read")
            if not asked.reduced:
                check_work(bin, elsewhere)
        except Failed as failed:
            sys.exit(f"wheel test: {failed}")
    print("wheel test: passed")


if __name__ == "__main__":
    main()
