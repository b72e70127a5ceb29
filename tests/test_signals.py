"""Every process ends in time, whatever ends the first one."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc").is_dir(), reason="finds processes in /proc"),
]

IN_TIME_S = 30
"""5 s are promised, and measured by benchmarks/kills.py; here a process that hangs is told from a busy machine."""
BALLS = Path(__file__).parent / "golden" / "balls"
MASIV = "from masiv.cli.supervisor import run; run()"
IN_COMPILED_CODE = """
import ctypes, masiv.cli.main, masiv.cli.supervisor
def stuck():
    print("stuck", flush=True)
    ctypes.PyDLL(None).sleep(60)  # a PyDLL keeps the interpreter's lock, as Taichi does while it compiles
masiv.cli.main.run = stuck
masiv.cli.supervisor.run()
"""
WORKERS = """
import multiprocessing, sys, time
from masiv.workers import Workers
if __name__ == "__main__":
    with Workers(2) as workers:
        workers.start()
        if sys.argv[1] == "working":
            list(workers.map(time.sleep, [(0.5,)] * 4))
            waits = [workers.submit(time.sleep, (60,)) for _ in range(2)]
        print(*(p.pid for p in multiprocessing.active_children()), flush=True)
        time.sleep(60)
"""
GRADIENT_WORKER = """
import time
from masiv import runtime
from masiv.splat.data_parallel import GradientWorker
runtime.start("cpu")
with GradientWorker() as worker:
    print(worker._process.pid, flush=True)
    time.sleep(60)
"""


def started(*command) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, *map(str, command)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def line(process) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def assert_ended(pids) -> None:
    end = time.monotonic() + IN_TIME_S
    while any(map(runs, pids)) and time.monotonic() < end:
        time.sleep(0.05)
    assert not [pid for pid in pids if runs(pid)]


def assert_one_line(process, number: int, code: int, word: str) -> None:
    pids = [process.pid, *children(process.pid)]
    assert len(pids) == 2
    process.send_signal(number)
    _, said = process.communicate(timeout=IN_TIME_S)
    assert process.returncode == code, said
    lines = [text for text in said.splitlines() if text.startswith("error: ")]
    assert lines == [f"error: {word}; the same command goes on from the last checkpoint"]
    assert "Traceback" not in said
    assert_ended(pids)


@pytest.mark.parametrize(("number", "code", "word"), [(15, 143, "terminated"), (2, 130, "interrupted")])
@pytest.mark.parametrize("moment", ["process", "run.yaml", "running"])
def test_a_signal_ends_a_command_with_one_line(tmp_path, number, code, word, moment):
    process = started("-c", MASIV, "identify", BALLS, "--out", tmp_path / "run")
    record = tmp_path / "run/run.yaml"
    while not children(process.pid) or (moment != "process" and not record.exists()):
        time.sleep(0.01)
    while moment == "running" and "state: running" not in record.read_text():
        time.sleep(0.01)
    assert_one_line(process, number, code, word)
    assert not list(tmp_path.rglob("*.tmp*"))
    assert not (tmp_path / "run/lock.json").exists()


@pytest.mark.parametrize(("number", "code", "word"), [(15, 143, "terminated"), (2, 130, "interrupted")])
def test_a_signal_ends_compiled_code_that_does_not_let_python_run(number, code, word):
    process = started("-c", IN_COMPILED_CODE)
    assert line(process) == "stuck"
    assert_one_line(process, number, code, word)


def test_a_command_that_the_system_kills_is_told_of():
    process = started("-c", IN_COMPILED_CODE)
    assert line(process) == "stuck"
    os.kill(children(process.pid)[0], signal.SIGKILL)
    _, said = process.communicate(timeout=IN_TIME_S)
    assert process.returncode == 137
    assert "killed by SIGKILL, perhaps for lack of memory" in said


def test_a_killed_command_takes_the_computing_process_with_it():
    process = started("-c", IN_COMPILED_CODE)
    assert line(process) == "stuck"
    pids = children(process.pid)
    process.kill()
    assert_ended(pids)
    process.communicate()


@pytest.mark.parametrize("moment", ["starting", "working"])
def test_workers_end_with_a_killed_parent(tmp_path, moment):
    script = tmp_path / "script.py"
    script.write_text(WORKERS)
    process = started(script, moment)
    pids = [int(pid) for pid in line(process).split()]
    assert len(pids) == 2
    process.kill()
    assert_ended(pids)
    process.communicate()


@pytest.mark.parametrize("moment", ["starting", "working"])
def test_ctrl_c_ends_workers_without_a_word_of_theirs(tmp_path, moment):
    """A terminal sends SIGINT to all processes of the command."""
    script = tmp_path / "script.py"
    script.write_text(WORKERS)
    process = started(script, moment)
    pids = [int(pid) for pid in line(process).split()]
    for pid in (*pids, process.pid):
        os.kill(pid, signal.SIGINT)
    _, said = process.communicate(timeout=IN_TIME_S)
    assert said.count("Traceback") == said.count("KeyboardInterrupt\n") == 1
    assert_ended(pids)


def test_the_second_process_of_reconstruct_ends_with_a_killed_parent():
    process = started("-c", GRADIENT_WORKER)
    pid = int(line(process))
    process.kill()
    assert_ended([pid])
    process.communicate()
