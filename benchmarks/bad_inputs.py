"""What each command says to an input that cannot be used: exit code, sentence, files left.

usage: python benchmarks/bad_inputs.py [--work FOLDER] [--only TEXT] [--out TABLE.md]

A scene of four cameras, its run and a run of tracks are made once in --work (a minute). Each case copies what it
needs, breaks one thing, and runs the command in a process of its own with a limit on time. Cases of a full or a
read-only disk mount a small tmpfs, which takes a privileged user; for others they are left out.

A case passes if the command ends in time with the exit code that is expected, one line `error: …` (or, where the
command can go on, a line that says what was dropped), no traceback and no temporary file. Ends with exit code 1 if one
does not pass.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import yaml
from bad_input_cases import Case, cases
from bad_input_changes import SPEC

TIME_LIMIT_S = 90.0
"""Of a command: the longest takes 40 s, where a stage is done again."""
MEMORY_LIMIT_MB = 2000
"""Of the resident memory: an ordinary command on this scene has half of that."""
SETTINGS = {
    "simulator": {"subparticles": 1, "grid_nodes": 65536, "memory_mb": 16},
    "reconstruct": {"gaussians": 150, "hull_resolution": 24, "iterations": 20, "width": 16, "depth": 1},
    "trajectory": {"particle_count": 200, "fill_resolution": 24, "iterations": 5},
    "identify": {"law": "neo_hookean", "contact": "sticky", "search_particles": 150, "processes": 1},
}
BALLS = Path(__file__).resolve().parents[1] / "tests" / "golden" / "balls"


@dataclass(frozen=True)
class Outcome:
    code: int | None
    said: str
    left: tuple[str, ...]
    traceback: bool
    seconds: float
    memory_mb: float

    def passes(self, case: Case) -> bool:
        """Whether the command did what is asked of it."""
        right = self.code == (0 if case.goes_on else case.code) and bool(self.said)
        return right and not self.left and not self.traceback and self.memory_mb < MEMORY_LIMIT_MB


# ---- running --------------------------------------------------------------------------------------------------------


def prepare(work: Path) -> None:
    """A scene, its run and a copy of the tracks in ``work``, if they are missing."""
    work.mkdir(parents=True, exist_ok=True)
    (work / "spec.yaml").write_text(yaml.safe_dump(SPEC))
    (work / "tiny.yaml").write_text(yaml.safe_dump(SETTINGS))
    if not (work / "tracks").is_dir():
        shutil.copytree(BALLS, work / "tracks")
    for made, words in (
        (work / "scene", ["synth", work / "spec.yaml", "--out", work / "scene"]),
        (work / "run" / "report.html",
         ["identify", work / "scene", "--out", work / "run", "--config", work / "tiny.yaml"]),
    ):  # fmt: skip
        if not made.exists():
            code = "from masiv.cli.main import run; run()"
            subprocess.run([sys.executable, "-c", code, *map(str, words)], check=True, stdout=subprocess.DEVNULL)


@contextmanager
def disk(kind: str, folder: Path) -> Iterator[bool]:
    """A small file system at ``folder``, full or read-only. Yields whether it could be mounted."""
    folder.mkdir()
    size = "size=8k" if kind == "full" else "ro"
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", size, "none", folder], capture_output=True).returncode == 0
    try:
        if mounted and kind == "full":
            (folder / "other").write_bytes(b"0" * 4096)
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "-l", folder], check=True)


def run(case: Case, work: Path) -> Outcome | None:
    """Break a copy of what is in ``work`` and run the command; None if the disk cannot be had."""
    with tempfile.TemporaryDirectory(prefix="masiv-bad-") as name:
        folder = Path(name)
        for part in ("scene", "run", "tracks"):
            shutil.copytree(work / part, folder / part)
        shutil.copy(work / "tiny.yaml", folder)
        record = folder / "run" / "run.yaml"
        record.write_text(record.read_text().replace(str(work / "scene"), str(folder / "scene")))
        case.change(folder)
        places = {part: folder / part for part in ("scene", "run", "tracks", "out", "disk")} | {"dir": folder}
        words = [word.format(**places) for word in case.command.split()]
        if not case.disk:
            return _ended(words, folder)
        with disk(case.disk, folder / "disk") as mounted:
            return _ended(words, folder) if mounted else None


def _ended(words: list[str], folder: Path) -> Outcome:
    out, err = folder.with_suffix(".out"), folder.with_suffix(".err")
    began = time.monotonic()
    child = os.fork()
    if child == 0:
        _become(words, folder, out, err)
    code, usage = None, None
    while usage is None:
        pid, status, used = os.wait4(child, os.WNOHANG)
        if pid:
            code, usage = os.waitstatus_to_exitcode(status), used
        elif time.monotonic() - began > TIME_LIMIT_S:
            os.killpg(child, signal.SIGKILL)
            _, _, usage = os.wait4(child, 0)
        else:
            time.sleep(0.02)
    said, printed = err.read_text(errors="replace"), out.read_text(errors="replace")
    out.unlink()
    err.unlink()
    told = [line for line in said.splitlines() if line.startswith("error: ")]
    told = told or [line for line in said.splitlines() if "arning: " in line]
    told = told or [line[4:] for line in printed.splitlines() if line.startswith("  - ")]  # problems of a scene
    left = tuple(sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if ".tmp" in p.name))
    text = "hangs" if code is None else " ".join(told).replace(str(folder), "…")
    return Outcome(code, text, left, "Traceback" in said, time.monotonic() - began, usage.ru_maxrss / 1024)


def _become(words: list[str], folder: Path, out: Path, err: Path) -> None:
    """The command, in a process that has the imports already."""
    os.setsid()
    os.chdir(folder)
    for path, descriptor in ((out, 1), (err, 2)):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT), descriptor)
    sys.argv = ["masiv", *words]
    code = 1
    try:
        from masiv.cli.main import run as masiv

        masiv()
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else 1
    except BaseException:
        import traceback

        traceback.print_exc()
    sys.stderr.flush()
    sys.stdout.flush()
    os._exit(code)


def row(case: Case, outcome: Outcome, length: int) -> str:
    """A row of the table, with at most ``length`` characters of the sentence."""
    said = outcome.said or "(nothing)"
    said = said.removeprefix("error: ").split("arning: ")[-1].replace("|", "\\|")
    verdict = "" if outcome.passes(case) else " **no**"
    if outcome.traceback:
        verdict += " traceback"
    if outcome.left:
        verdict += f" left {', '.join(outcome.left)}"
    if outcome.memory_mb >= MEMORY_LIMIT_MB:
        verdict += f" {outcome.memory_mb:.0f} MB"
    return f"| {case.name} | {outcome.code}{verdict} | {said[:length]}{'…' if len(said) > length else ''} |"


def page(found: list[tuple[Case, Outcome]]) -> str:
    """Counts by group, and a table of the sentences; of those that have the same form, the first one of its group."""
    groups = list(dict.fromkeys(case.group for case, _ in found))
    lines = [
        "| group | cases | as expected | refused (2) | failed (1) | goes on with a word (0) |",
        "|---|---|---|---|---|---|",
    ]
    for group in [*groups, ""]:
        own = [(case, outcome) for case, outcome in found if group in ("", case.group)]
        good = sum(outcome.passes(case) for case, outcome in own)
        codes = [sum(outcome.code == code for _, outcome in own) for code in (2, 1, 0)]
        lines.append(f"| {group or '**all**'} | {len(own)} | {good} | {codes[0]} | {codes[1]} | {codes[2]} |")
    for group in groups:
        lines += ["", f"### {group[0].upper()}{group[1:]}", "", "| case | exit | says |", "|---|---|---|"]
        known: set[str] = set()
        for case, outcome in found:
            form = re.sub(r"(\S*/)+|[^a-z ]", "", outcome.said)[:45]
            if case.group == group and (form not in known or not outcome.passes(case)):
                lines.append(row(case, outcome, 48))
            known |= {form} if case.group == group else set()
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path(tempfile.gettempdir()) / "masiv-bad-inputs")
    parser.add_argument("--only", default="", help="cases whose group or name contains this")
    parser.add_argument("--out", type=Path, help="write the tables there")
    options_ = parser.parse_args()
    prepare(options_.work)
    import torch  # noqa: F401

    import masiv.cli.main  # what every command imports, once
    import masiv.pipeline.video
    import masiv.synth.synthesise  # noqa: F401

    found = []
    for case in cases():
        outcome = run(case, options_.work) if options_.only in f"{case.group}: {case.name}" else None
        if outcome is not None:
            found.append((case, outcome))
            print(f"{outcome.seconds:5.1f} s {outcome.memory_mb:5.0f} MB {row(case, outcome, 160)}", flush=True)
    passed = sum(outcome.passes(case) for case, outcome in found)
    print(f"{passed} of {len(found)}")
    if options_.out is not None:
        options_.out.write_text(page(found), encoding="utf-8")
    sys.exit(0 if passed == len(found) else 1)


if __name__ == "__main__":
    main()
