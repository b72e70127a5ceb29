"""Kill runs at random moments: does each go on to the numbers of a run that nobody killed, and is no process left?

    python benchmarks/kills.py [--minutes 10] [--seed 0] [--out FOLDER] [--scenes bar balls cube]

Linux only. Scenes: two of tracks, a clamped bar and falling balls, and a filmed cube, whose fit has several processes.
Every command of a run is killed up to ``--kills`` times, then it runs to its end. A kill: a moment, uniform over the
time that the command takes; SIGTERM or SIGINT to the process that was started, or SIGKILL to it or to the one that
computes. Prints a table. Exits with 1 if anything differs.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import yaml
from safetensors import safe_open

SCENES = Path(__file__).parents[1] / "tests" / "golden"
MASIV = [sys.executable, "-m", "masiv.cli.supervisor"]
BAR_SETTINGS = {
    "tracks": {"particles": 50, "duration": 0.1, "search_duration": 0.1, "rollouts": 4},
    "simulator": {"subparticles": 1, "chunks": 1},
    "identify": {"law": "neo_hookean"},
    "refine": {"effects": ["viscosity"], "max_effects": 1},
}
BALLS_SETTINGS = {"refine": {"effects": ["quadratic_drag", "body_force"], "max_effects": 1}}
VIDEO_SETTINGS = {
    "simulator": {"particles_per_cell": 4.0, "subparticles": 1},
    "reconstruct": {
        **{"gaussians": 250, "hull_resolution": 24, "iterations": 120, "width": 16, "depth": 1},
        "processes": 2,
    },
    "trajectory": {"particle_count": 300, "fill_resolution": 24, "iterations": 20},
    "identify": {"start": "jelly", "contact": "sticky", "search_particles": 150, "iterations": 4, "processes": 2},
    "refine": {"particles": 150, "families": 1, "effects": ["linear_drag"], "max_effects": 1, "processes": 2},
}
"""Coarse: what is tested is that numbers are the same, not that they are good."""
CUBE = {
    "shape": {"kind": "cube", "size": 0.4, "rotation_deg": [20, 30, 0], "clearance": 0.25},
    "material": {"law": "neo_hookean", "parameters": {"youngs_modulus": 4e4, "poissons_ratio": 0.3}},
    "velocity": [0.5, -1.5, 0.0],
    "frames": 8,
    "cameras": {"count": 6, "size": 48, "field_of_view_deg": 28},
    "truth_particles": 500,
}
MAY_LIVE_S = 5.0
TAG = "MASIV_KILLS"


def commands(scene: str, folder: Path) -> list[list[str]]:
    """Those of a whole run of ``scene`` in ``folder``/run, in order. Their settings and data are written beside it."""
    run = str(folder / "run")
    refine = ["refine", run]
    settings = folder / "settings.yaml"
    folder.mkdir(parents=True, exist_ok=True)
    settings.write_text(json.dumps({"bar": BAR_SETTINGS, "balls": BALLS_SETTINGS, "cube": VIDEO_SETTINGS}[scene]))
    if scene == "cube":
        (folder / "spec.yaml").write_text(json.dumps(CUBE))
        if not (folder / "scene").exists():
            complete(["synth", str(folder / "spec.yaml"), "--out", str(folder / "scene")])
        stages = ["reconstruct", str(folder / "scene"), "--out", run, "--config", str(settings), "--fit-frames", "5"]
        return [stages, ["trajectory", run], ["identify", *stages[1:]], refine]
    identify = ["identify", str(SCENES / scene), "--out", run, "--config", str(settings)]
    return [identify, *([refine, [*refine, "--condition", "load"]] if scene == "bar" else [[*refine, "--group"]])]


@dataclass
class Tally:
    """What was seen. slowest_s: from a signal to the end of the last process."""

    kills: Counter[tuple[str, str]] = field(default_factory=Counter)
    slowest_s: dict[str, float] = field(default_factory=dict)
    runs: int = 0
    wrong: list[str] = field(default_factory=list)

    def blame(self, what: str) -> None:
        print(what, file=sys.stderr)
        self.wrong.append(what)


def alive(tag: str) -> dict[int, int]:
    """Processes with ``tag`` in their environment, and their parents; those that ended and wait for that to be noticed
    do not count."""
    found = {}
    for path in Path("/proc").iterdir():
        try:
            if path.name.isdigit() and tag.encode() in (path / "environ").read_bytes():
                state, parent, *_ = (path / "stat").read_text().rpartition(")")[2].split()
                if state not in "ZX":
                    found[int(path.name)] = int(parent)
        except OSError:
            continue
    return found


def start(arguments: Sequence[str], tag: str) -> subprocess.Popen[str]:
    environment = {**os.environ, TAG: tag}
    return subprocess.Popen(
        [*MASIV, *arguments], env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )


def complete(arguments: Sequence[str]) -> float:
    """Run a command to its end. Returns its duration [s]."""
    began = time.monotonic()
    process = start(arguments, uuid.uuid4().hex)
    _, said = process.communicate()
    if process.returncode:
        raise SystemExit(f"masiv {' '.join(arguments)} failed:\n{said}")
    return time.monotonic() - began


def kill(scene: str, arguments: Sequence[str], after_s: float, draw: random.Random, tally: Tally) -> bool:
    """Start a command and kill it ``after_s`` later. False if it had ended before."""
    tag = uuid.uuid4().hex
    process = start(arguments, tag)
    try:
        process.wait(after_s)
        process.communicate()
        return False
    except subprocess.TimeoutExpired:
        pass
    number = draw.choice([signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
    target, who = process.pid, "first process"
    if number == signal.SIGKILL and draw.random() < 0.5:
        computing = [pid for pid, parent in alive(tag).items() if parent == process.pid]
        if computing:
            target, who = computing[0], "computing process"
    began = time.monotonic()
    os.kill(target, number)
    while (left := alive(tag)) and time.monotonic() - began < MAY_LIVE_S:
        time.sleep(0.02)
    seconds = time.monotonic() - began
    where = f"{' '.join(arguments)}, {number.name} to the {who} after {after_s:.2f} s"
    if left:
        tally.blame(f"{where}: {len(left)} processes left after {MAY_LIVE_S:g} s")
        for pid in left:
            os.kill(pid, signal.SIGKILL)
    _, said = process.communicate()
    lines = [line for line in said.splitlines() if line.startswith("error: ")]
    expected = {signal.SIGTERM: 143, signal.SIGINT: 130, signal.SIGKILL: -9 if target == process.pid else 137}[number]
    if process.returncode == 0:
        return False  # it ended at that moment
    if process.returncode != expected or len(lines) != (expected > 0) or "Traceback" in said:
        tally.blame(f"{where}: exit code {process.returncode}, said {said!r}")
    stage = f"{scene} {arguments[0]}"
    tally.kills[stage, f"{number.name}, {who}"] += 1
    tally.slowest_s[number.name] = max(tally.slowest_s.get(number.name, 0.0), seconds)
    return True


def differences(run: Path, whole: Path) -> list[str]:
    """Names of files and arrays of ``run`` that differ from those of ``whole``, and of files that should not be there.

    run.yaml, log.csv and report.html, with times of day and durations, and the effort that went into a result are not
    compared.
    """
    names = {path.relative_to(folder) for folder in (run, whole) for path in folder.rglob("*") if path.is_file()}
    found = []
    for name in sorted(names):
        one, other = run / name, whole / name
        if not (one.is_file() and other.is_file()):
            found.append(f"{name} is in one of them only")
        elif name.suffix == ".npz":
            with np.load(one) as a, np.load(other) as b:
                same = set(a) == set(b) and all(np.array_equal(a[k], b[k], equal_nan=a[k].dtype.kind == "f") for k in a)
            found += [] if same else [str(name)]
        elif name.name not in ("run.yaml", "log.csv", "report.html") and _content(one) != _content(other):
            found.append(str(name))
    states = [yaml.safe_load((folder / "run.yaml").read_text())["stages"] for folder in (run, whole)]
    if any(states[0][stage]["state"] != states[1][stage]["state"] for stage in states[0]):
        found.append("stages of run.yaml")
    return found


def _content(path: Path) -> object:
    if path.suffix == ".safetensors":  # the order of its metadata is random
        with safe_open(path, "np") as file:
            return file.metadata(), {name: file.get_tensor(name).tobytes() for name in sorted(file.keys())}
    if path.suffix == ".json":  # seconds and rollouts are the effort of the last process
        return {k: v for k, v in json.loads(path.read_text()).items() if k not in ("seconds", "rollouts")}
    return path.read_bytes()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0, help="start no new run after so long")
    parser.add_argument("--kills", type=int, default=4, help="of a command, at most, before it runs to its end")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="keep the runs here")
    parser.add_argument("--scenes", nargs="+", choices=["bar", "balls", "cube"], default=["bar", "balls", "cube"])
    options = parser.parse_args()
    # A shell may start what it runs in the background with SIGINT ignored, and commands would inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    draw, tally = random.Random(options.seed), Tally()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.out or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        durations = {}
        for scene in options.scenes:
            durations[scene] = [complete(arguments) for arguments in commands(scene, folder / scene)]
            print(f"{scene}, whole: {', '.join(f'{s:.1f} s' for s in durations[scene])}", file=sys.stderr)
            shutil.move(folder / scene / "run", folder / scene / "whole")
        end = time.monotonic() + 60 * options.minutes
        for scene in itertools.cycle(options.scenes):
            if time.monotonic() > end:
                break
            run = folder / scene / "run"  # the same name as the whole one, which is part of its numbers
            for arguments, duration in zip(commands(scene, folder / scene), durations[scene], strict=True):
                for _ in range(options.kills):
                    if not kill(scene, arguments, draw.uniform(0, duration), draw, tally):
                        break
                complete(arguments)
            if different := differences(run, folder / scene / "whole"):
                tally.blame(f"run {tally.runs} of {scene}: {', '.join(different)}")
                shutil.copytree(run, folder / f"wrong_{tally.runs}")
            shutil.rmtree(run)
            tally.runs += 1
            print(f"{tally.runs} runs, {tally.kills.total()} kills, {len(tally.wrong)} wrong", file=sys.stderr)
    print(table(tally))
    sys.exit(bool(tally.wrong))


def table(tally: Tally) -> str:
    """Markdown."""
    kinds = sorted({kind for _, kind in tally.kills})
    lines = [f"| command | {' | '.join(kinds)} |", "|---|" + "---|" * len(kinds)]
    for stage in sorted({stage for stage, _ in tally.kills}):
        lines.append(f"| {stage} | {' | '.join(str(tally.kills[stage, kind]) for kind in kinds)} |")
    slowest = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in sorted(tally.slowest_s.items()))
    lines += ["", f"{tally.kills.total()} kills of {tally.runs} runs; slowest end of the last process: {slowest}."]
    lines += ["", f"Wrong: {len(tally.wrong)}", *(f"- {line}" for line in tally.wrong)]
    return "\n".join(lines)


if __name__ == "__main__":
    main()
