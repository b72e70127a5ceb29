"""The process that a user starts. It runs the command in a child, so that a signal ends both in time.

Compiled code (a kernel that is being compiled, a long rollout) does not let Python handle a signal, so the process that
computes cannot promise when it ends. This one can: it passes SIGTERM and SIGINT on, waits, and then kills. If it is
killed itself, the child ends with it (``masiv.parent``).
"""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType
from typing import NoReturn

from masiv.parent import end_with_parent

GRACE_S = 3
"""Time to clean up, after which the command is killed."""
SIGNALS = (signal.SIGTERM, signal.SIGINT)


interrupted_by: list[int] = []
"""The signal that ends the command of this process, if there is one. Other errors after it are its consequences: an
import that it breaks off raises an ImportError."""


class Interrupted(BaseException):
    """A signal asks the command to end. Typer would keep a KeyboardInterrupt to itself."""


def run(started_by: int | None = None) -> None:
    """The entry point of ``masiv``. Exit code of the command; 128 + the signal that ended it. started_by: a process
    with which this one is to end."""
    if not hasattr(os, "fork"):
        if started_by is not None:
            end_with_parent(started_by)
        code = _command()
        if code:
            _say(code - 128)
        sys.exit(code)
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    watched, alive = os.pipe()
    parent = os.getpid()
    child = os.fork()
    if child:
        # Only now: a thread that loads a library while this process forks leaves the loader locked in the child.
        if started_by is not None:
            end_with_parent(started_by)
        sys.exit(_supervised(child))
    os.close(alive)
    end_with_parent(parent, lambda: os.read(watched, 1))
    sys.exit(_command())


def _command() -> int:
    """Run the command in this process, which ends with its exit code. Returns one only if a signal interrupted it."""
    try:
        for number in SIGNALS:
            signal.signal(number, _interrupt)
        if hasattr(signal, "pthread_sigmask"):
            signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
        from .main import run as command

        command()
    except BaseException:
        if not interrupted_by:
            raise
        return 128 + interrupted_by[0]
    finally:
        _ignore_signals()
    return 0


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    _ignore_signals()
    interrupted_by.append(number)
    sys.unraisablehook = lambda _: None  # where it is raised in a destructor, nothing can be done but wait for the end
    raise Interrupted


def _ignore_signals() -> None:
    """Once is enough: another one must not disturb the end."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def _supervised(child: int) -> int:
    """Wait for ``child``, and pass signals on to it. Returns the exit code."""
    received: list[int] = []

    def kill(*_: object) -> None:
        os.kill(child, signal.SIGKILL)

    def forward(number: int, frame: FrameType | None) -> None:
        if received:  # the user has asked twice
            kill()
        received.append(number)
        os.kill(child, number)
        signal.alarm(GRACE_S)

    signal.signal(signal.SIGALRM, kill)
    for number in SIGNALS:
        signal.signal(number, forward)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    _, status = os.waitpid(child, 0)  # a zombie until here, so the signals found it
    signal.alarm(0)
    _ignore_signals()
    code = os.waitstatus_to_exitcode(status)
    if code < 0 or code - 128 in SIGNALS:
        number = received[0] if received else abs(code) % 128
        _say(number)
        return 128 + number
    return 128 + received[0] if received and code else code  # a command that failed has said why


def _say(number: int) -> None:
    """Why the command ended, in one line. It is said here alone: the child may be killed while it ends."""
    message = f"{_reason(number)}; the same command goes on from the last checkpoint"
    print(f"error: {message}", file=sys.stderr)
    if "--json" in sys.argv:
        import json

        print(json.dumps({"error": message}), flush=True)


def _reason(number: int) -> str:
    """What the signal ``number`` means for a person."""
    if number in SIGNALS:
        return {signal.SIGTERM: "terminated", signal.SIGINT: "interrupted"}[signal.Signals(number)]
    memory = ", perhaps for lack of memory" if number == signal.SIGKILL else ""
    return f"killed by {signal.Signals(number).name}{memory}"


if __name__ == "__main__":
    from importlib import import_module

    import_module("masiv.cli.supervisor").run()  # the module that ``console`` imports, too: this one is another
