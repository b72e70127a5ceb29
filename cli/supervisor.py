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
GOES_ON = "the same command goes on from the last checkpoint"


class Interrupted(BaseException):
    """A signal asks the command to end. number: of the signal. Typer would keep a KeyboardInterrupt to itself."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def run() -> None:
    """The entry point of ``masiv``. Exit code of the command; 128 + the signal that ended it."""
    if not hasattr(os, "fork"):
        _command()
        return
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    watched, alive = os.pipe()
    parent = os.getpid()
    child = os.fork()
    if child:
        sys.exit(_supervised(child))
    os.close(alive)
    end_with_parent(parent, lambda: os.read(watched, 1))
    _command()


def _command() -> None:
    """Run the command in this process."""
    for number in SIGNALS:
        signal.signal(number, _interrupt)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    try:
        from .main import run as command

        command()
    except Interrupted as error:  # before or after the command itself, which says it
        _say(error.number)
        sys.exit(128 + error.number)


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    for other in SIGNALS:  # once is enough: another one must not disturb the end
        signal.signal(other, signal.SIG_IGN)
    raise Interrupted(number)


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
    for number in (*SIGNALS, signal.SIGALRM):
        signal.signal(number, signal.SIG_IGN)
    code = os.waitstatus_to_exitcode(status)
    if code < 0:
        _say(received[0] if received else -code)
        return 128 + (received[0] if received else -code)
    return 128 + received[0] if received and code else code


def _say(number: int) -> None:
    """Why the command ended, in one line, as ``console.fail`` does."""
    message = f"{reason(number)}; {GOES_ON}"
    print(f"error: {message}", file=sys.stderr)
    if "--json" in sys.argv:
        import json

        print(json.dumps({"error": message}), flush=True)


def reason(number: int) -> str:
    """What the signal ``number`` means for a person."""
    if number in SIGNALS:
        return {signal.SIGTERM: "terminated", signal.SIGINT: "interrupted"}[signal.Signals(number)]
    memory = ", perhaps for lack of memory" if number == signal.SIGKILL else ""
    return f"killed by {signal.Signals(number).name}{memory}"


if __name__ == "__main__":
    run()
