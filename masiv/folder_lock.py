"""A lock on a folder: one process at a time changes what is in it, on this machine or on another that shares the disk.

The file ``lock.json`` says who holds it and since when. It appears with its content, by a hard link, so that a process
that is killed leaves either a whole lock or none. Whoever comes next finds out whether the holder is alive: on the same
machine by its process, on another one by its sign of life, the modification time of the file.
"""

from __future__ import annotations

import getpass
import json
import os
import socket
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, fields
from datetime import datetime, timezone
from pathlib import Path

from masiv.errors import InputError

LOCK_FILE = "lock.json"
SIGN_OF_LIFE_S = 20.0
STALE_S = 300.0
"""A holder on another machine without a sign of life for so long is taken for dead. Compiled code can delay one."""

_held: dict[Path, int] = {}
"""Locks of this process, and how often each was taken."""


@dataclass(frozen=True)
class Holder:
    """Who holds a lock. started: when the process began, in the units of this system; None where it is not known."""

    host: str
    pid: int
    user: str
    command: str
    since: str
    started: int | None = None

    @classmethod
    def this_process(cls) -> Holder:
        command = " ".join([Path(sys.argv[0]).name, *sys.argv[1:2]])
        since = datetime.now(timezone.utc).isoformat(timespec="seconds")
        return cls(socket.gethostname(), os.getpid(), _user(), command, since, _started(os.getpid()))

    def __str__(self) -> str:
        return f"{self.command}, process {self.pid} of {self.user} on {self.host}, since {self.since}"


@contextmanager
def locked(folder: Path) -> Iterator[bool]:
    """Hold the lock of ``folder``, which exists, while the block runs. A process may take it several times.

    Gives whether it was taken over from a process that had died, of which it warns. Raises InputError if the holder is
    alive, and names it, and if nothing can be written to ``folder``.
    """
    path = folder.resolve() / LOCK_FILE
    taken_over = False
    if path not in _held:
        taken_over = _acquire(path)
        _held[path] = 0
    _held[path] += 1
    stop = threading.Event()
    if _held[path] == 1:
        threading.Thread(target=_show_life, args=(path, stop), daemon=True).start()
    try:
        yield taken_over
    finally:
        stop.set()
        _held[path] -= 1
        if not _held[path]:
            del _held[path]
            with suppress(OSError):
                path.unlink()


def _acquire(path: Path) -> bool:
    taken_over = False
    mine = path.with_name(f"lock.{os.getpid()}.tmp.json")
    try:
        mine.write_text(json.dumps(asdict(Holder.this_process()), indent=1), encoding="utf-8")
        try:
            while not _linked(mine, path):
                taken_over |= _remove_dead(path, now=mine.stat().st_mtime)
        finally:
            mine.unlink()
    except OSError as error:
        raise InputError(f"{path.parent} cannot be written: {error.strerror}") from error
    return taken_over


def _linked(mine: Path, path: Path) -> bool:
    try:
        os.link(mine, path)
    except FileExistsError:
        return False
    except OSError:  # a disk without hard links
        try:
            with path.open("x", encoding="utf-8") as file:
                file.write(mine.read_text(encoding="utf-8"))
        except FileExistsError:
            return False
    return True


def _remove_dead(path: Path, now: float) -> bool:
    """Remove the lock of a dead process, and say whether there was one. Raises InputError if its holder is alive.

    now: the time by the clock of the disk.
    """
    try:
        text, silent_s = path.read_text(encoding="utf-8"), now - path.stat().st_mtime
    except FileNotFoundError:
        return False
    holder = _read(text)
    if silent_s < STALE_S if holder is None else _alive(holder, silent_s):
        who = f"a process that {path.name} does not name" if holder is None else str(holder)
        raise InputError(
            f"{path.parent} is in use by {who}, last sign of life {max(silent_s, 0):.0f} s ago: wait until it ends, or "
            f"delete {path} if it has"
        )
    # Another process may have taken it over at this moment: the lock that was read is the one that goes.
    aside = path.with_name(f"lock.taken.{os.getpid()}.tmp.json")
    try:
        os.rename(path, aside)
    except FileNotFoundError:
        return False
    dead = aside.read_text(encoding="utf-8") == text
    if dead:
        warnings.warn(
            f"{path.parent} was locked by {holder or 'a process'}, which has ended: the lock is taken over",
            stacklevel=2,
        )
    else:
        with suppress(FileExistsError):
            os.link(aside, path)
    aside.unlink()
    return dead


def _read(text: str) -> Holder | None:
    try:
        return Holder(**{field.name: json.loads(text)[field.name] for field in fields(Holder)})
    except (ValueError, KeyError, TypeError):
        return None


def _alive(holder: Holder, silent_s: float) -> bool:
    """Whether the process of ``holder`` runs, as far as this machine can tell."""
    if holder.host != socket.gethostname() or os.name != "posix":
        return silent_s < STALE_S
    try:
        os.kill(holder.pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # of another user
        pass
    except OverflowError:
        return False
    began = _started(holder.pid)
    return None in (began, holder.started) or began == holder.started  # else another process has the number now


def _started(pid: int) -> int | None:
    """When the process ``pid`` began [ticks since the machine started]; -1 if it has ended; None if not known."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    state, *rest = stat.rpartition(")")[2].split()  # proc(5): the name in brackets may hold spaces
    return -1 if state in "ZX" else int(rest[18])


def _show_life(path: Path, stop: threading.Event) -> None:
    while not stop.wait(SIGN_OF_LIFE_S):
        with suppress(OSError):
            os.utime(path)


def _user() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):  # a container's user without a name
        return str(os.getuid()) if hasattr(os, "getuid") else "unknown"
