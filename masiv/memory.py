"""Memory that a stage took, and that there is. Light: no torch, no taichi."""

from __future__ import annotations

import ctypes
import threading
import time
from contextlib import suppress
from pathlib import Path

import psutil

from masiv.cores import CONTROL_GROUPS

INTERVAL_S = 0.5
"""Between two samples of the memory that a stage takes."""
MAX_SHARE = 0.02
"""Of the time of a core that samples may take, at most."""
GROWTH = 1.01
"""Resident memory that is this many times larger than any before is a new peak."""


def taken_bytes() -> float:
    """Memory [bytes] of this process and of those that it started: what each has for itself, and once what they share.

    Libraries that two processes map are in memory once, so the sum of their resident sets would count them twice.
    """
    return _taken(_processes())


def available_bytes(control_groups: Path = CONTROL_GROUPS) -> float:
    """Memory [bytes] that this machine still has, or the container that this process runs in, if that has less.

    control_groups: folder of the limits (cgroup v2, or v1 with its controller ``memory``).
    """
    left = float(psutil.virtual_memory().available)
    for maximum, used, cache in (
        ("memory.max", "memory.current", "inactive_file"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "total_inactive_file"),
    ):
        with suppress(OSError, ValueError, KeyError):  # no such file, or "max": no limit
            limit = int((control_groups / maximum).read_text())
            statistics = (control_groups / maximum).with_name("memory.stat").read_text()
            taken_back = int(dict(line.split() for line in statistics.splitlines())[cache])
            left = min(left, limit - int((control_groups / used).read_text()) + taken_back)
    return max(left, 0.0)


def return_freed() -> None:
    """Give memory that this process has freed back to the system, which the C library would keep for its next use.

    Of glibc (``malloc_trim``); other C libraries do so themselves, or cannot be asked.
    """
    with suppress(AttributeError, OSError, TypeError):  # TypeError: Windows has no library of the process itself
        ctypes.CDLL(None).malloc_trim(0)


def _processes() -> list[psutil.Process]:
    own = psutil.Process()
    return [own, *own.children(recursive=True)]


def _taken(processes: list[psutil.Process]) -> float:
    private, shared = 0.0, 0.0
    for process in processes:
        with suppress(psutil.Error):  # it has ended
            found = process.memory_full_info()
            private += found.uss
            shared = max(shared, found.rss - found.uss)
    return private + shared


def _resident(processes: list[psutil.Process]) -> float:
    total = 0.0
    for process in processes:
        with suppress(psutil.Error):
            total += process.memory_info().rss
    return total


class PeakMemory:
    """The largest ``taken_bytes`` while this context is entered, sampled by a thread; ``bytes`` after it."""

    def __init__(self, interval: float = INTERVAL_S) -> None:
        self.bytes = 0.0
        self._interval = interval
        self._left = threading.Event()
        self._thread = threading.Thread(target=self._sample, name="masiv-memory", daemon=True)

    def __enter__(self) -> PeakMemory:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._left.set()
        self._thread.join()

    def _sample(self) -> None:
        resident = 0.0
        while True:
            began = time.perf_counter()
            processes = _processes()
            now = _resident(processes)
            if now > GROWTH * resident:  # what is shared takes the system longer to count
                resident = now
                self.bytes = max(self.bytes, _taken(processes))
            cost = time.perf_counter() - began  # grows with the processes of the machine
            if self._left.wait(max(self._interval, cost / MAX_SHARE)):
                return
