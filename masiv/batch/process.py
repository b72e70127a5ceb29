"""One stage of a batch in a process of its own: what crashes or runs out of memory there ends that process alone."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from masiv.batch.plan import Stage
from masiv.files import atomic_folder
from masiv.folder_lock import LOCK_FILE
from masiv.runtime import ONE_THREAD

POLL_S = 0.5
STOPPED = "stopped"
"""Message of a stage that was asked to stop."""
_IN_PROCESS = "import sys; from masiv.cli.supervisor import run; run(int(sys.argv.pop(1)))"


@dataclass(frozen=True)
class StageResult:
    """message: why it failed, empty if it did not; data: what the command prints with --json; host: where it ran."""

    key: str
    seconds: float
    message: str
    data: dict[str, Any] = field(default_factory=dict)
    host: str = ""


def run_stage(stage: Stage, threads: int, log: Path, stop: Path) -> StageResult:
    """Run ``stage`` on ``threads`` threads, its messages in ``log``; it ends early if the file ``stop`` appears, and
    with this process. What went wrong is in the result."""
    began = time.monotonic()
    host = os.uname().nodename if hasattr(os, "uname") else os.environ.get("COMPUTERNAME", "")
    try:
        if stage.copy_of is not None and not stage.folder.exists():
            _copy_run(stage.copy_of, stage.folder)
        code, text = _run(stage, threads, log, stop)
    except OSError as error:
        return StageResult(stage.key, time.monotonic() - began, str(error), host=host)
    seconds = time.monotonic() - began
    if stop.exists() and code:
        return StageResult(stage.key, seconds, STOPPED, host=host)
    try:
        data = json.loads(text.strip().splitlines()[-1])
    except (IndexError, ValueError):
        data = {}
    if code:
        return StageResult(stage.key, seconds, str(data.get("error") or f"exit code {code}, see {log}"), host=host)
    return StageResult(stage.key, seconds, "", data, host)


def _run(stage: Stage, threads: int, log: Path, stop: Path) -> tuple[int, str]:
    """Exit code and standard output of the command."""
    environment = {**os.environ, **dict.fromkeys(ONE_THREAD, str(threads))}
    command = [sys.executable, "-c", _IN_PROCESS, str(os.getpid()), *stage.command, "--json"]
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as messages:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=messages, env=environment
        )
    try:
        while True:
            try:
                out, _ = process.communicate(timeout=POLL_S)
                return process.returncode, out.decode(errors="replace")
            except subprocess.TimeoutExpired:
                if stop.exists():
                    process.terminate()
    finally:
        if process.poll() is None:
            process.terminate()
            process.wait()


def _copy_run(source: Path, target: Path) -> None:
    """A copy of the run folder ``source``, complete or not at all, without its lock."""
    with atomic_folder(target) as temporary:
        shutil.copytree(source, temporary, ignore=shutil.ignore_patterns(LOCK_FILE, "*.tmp*"), dirs_exist_ok=True)
