"""A process that ends when the one that started it does, in whatever way that ends (SIGKILL, out of memory)."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable

_PR_SET_PDEATHSIG = 1
"""Of <sys/prctl.h>: the signal that a process gets when the thread that started it ends."""
POLL_S = 1.0


def end_with_parent(parent: int, wait: Callable[[], object] | None = None) -> None:
    """Kill this process when its parent, the process ``parent``, ends. Call it first thing, before slow imports.

    Linux does it (prctl), also while this process compiles. Elsewhere a thread does: wait returns when the parent has
    ended (None: a check every second), and compiled code that does not let other threads run delays it.
    """
    if sys.platform == "linux":
        _ask_linux()
    if os.name == "posix" and os.getppid() != parent:  # it ended before it was watched
        os._exit(1)
    threading.Thread(target=_watch, args=(wait or (lambda: _wait_for(parent)),), daemon=True).start()


def _ask_linux() -> None:
    import ctypes

    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def _wait_for(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(POLL_S)


def _watch(wait: Callable[[], object]) -> None:
    wait()
    os._exit(1)
