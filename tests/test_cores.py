"""As many threads as the scheduler, or a container, may give."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from masiv.cores import available_cores

TAICHI = (
    "import os, torch; from masiv import runtime; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))}); "
    "runtime.start(); print(runtime.threads(), torch.get_num_threads())"
)


def limited(folder, files):
    for name, text in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    return available_cores(folder)


@pytest.fixture
def eight(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)


@pytest.mark.parametrize(
    ("files", "cores"),
    [
        ({}, 8),
        ({"cpu.max": "max 100000\n"}, 8),
        ({"cpu.max": "250000 100000\n"}, 3),
        ({"cpu.max": "10000 100000\n"}, 1),
        ({"cpu.max": "6400000 100000\n"}, 8),
        ({"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, 8),
        ({"cpu/cpu.cfs_quota_us": "200000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 2),
        ({"cpu.max": "?"}, 8),
    ],
)
def test_a_container_limits_them(tmp_path, eight, files, cores):
    assert limited(tmp_path, files) == cores


def test_where_there_is_no_affinity_all_cores_count(tmp_path, monkeypatch):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 6)
    assert limited(tmp_path, {}) == 6


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system has no affinity")
def test_taichi_and_torch_take_no_more_threads_than_the_affinity_has_cores():
    environment = {k: v for k, v in os.environ.items() if not k.endswith(("_NUM_THREADS", "_MAX_NUM_THREADS"))}
    command = [sys.executable, "-c", TAICHI]
    ended = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    assert ended.stdout.split() == ["1", "1"]
