"""What a command says: text or one JSON object on stdout; progress and errors on stderr; the exit code."""

from __future__ import annotations

import functools
import json
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from typing import Any, NoReturn

import typer

from masiv.errors import InputError, MasivError, of_system

from .supervisor import interrupted_by

FAILED, BAD_INPUT, INTERRUPTED = 1, 2, 130
PLAIN_EVERY_S = 15.0


def command(function: Callable[..., tuple[dict[str, Any], str]]) -> Callable[..., None]:
    """Make a typer command of a function that returns (what --json prints, what a person reads).

    Its parameter ``as_json`` says which of the two. MasivError ends with one sentence and exit code 1,
    InputError with 2.
    """

    @functools.wraps(function)
    def wrapped(*args: Any, **kwargs: Any) -> None:
        as_json = bool(kwargs.get("as_json"))
        try:
            with _quiet_stdout(as_json), _one_line_warnings():
                data, text = function(*args, **kwargs)
        except KeyboardInterrupt:
            fail("interrupted; the same command goes on from the last checkpoint", INTERRUPTED, as_json)
        except Exception as error:
            if interrupted_by:
                raise
            _fail_with(error, as_json)
        else:
            if as_json:
                from masiv.files import plain

                text = json.dumps(plain(data), allow_nan=False)
            print(text)

    return wrapped


def _fail_with(error: Exception, as_json: bool) -> NoReturn:
    """Say what ``error`` means, and exit with its code."""
    if isinstance(error, (MasivError, OSError, MemoryError)):
        told = error if isinstance(error, MasivError) else of_system(error)
        fail(str(told), BAD_INPUT if isinstance(told, InputError) else FAILED, as_json)
    import traceback

    traceback.print_exception(error)
    fail(f"unexpected {type(error).__name__}: {error}; this is a bug, please report the lines above", FAILED, as_json)


def fail(message: str, code: int, as_json: bool) -> NoReturn:
    """Print what went wrong, in one sentence, and exit with ``code``."""
    print(f"error: {message}", file=sys.stderr)
    if as_json:
        print(json.dumps({"error": message}))
    sys.stdout.flush()
    raise typer.Exit(code)


_stdout: list[int] = []
"""The descriptor of stdout while ``_quiet_stdout`` keeps it from libraries."""


def announce(data: dict[str, Any], text: str, as_json: bool) -> None:
    """Print the result of a command that goes on: ``data`` with --json, else ``text``."""
    if as_json:
        with os.fdopen(os.dup(_stdout[-1] if _stdout else 1), "w") as stdout:
            print(json.dumps(data), file=stdout)
    else:
        print(text, flush=True)


@contextmanager
def _quiet_stdout(quiet: bool) -> Iterator[None]:
    """Send what libraries print on stdout to stderr, so that stdout holds the one JSON object alone."""
    if not quiet:
        yield
        return
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    _stdout.append(kept)
    try:
        with redirect_stdout(sys.stderr):  # what Python prints; the descriptor is for compiled code
            yield
    finally:
        _stdout.pop()
        os.dup2(kept, 1)
        os.close(kept)


@contextmanager
def _one_line_warnings() -> Iterator[None]:
    """Print what masiv warns of (a UserWarning) as one line, without the place in the code."""
    with warnings.catch_warnings():
        shown = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *place: Any) -> None:
            if category is UserWarning:
                print(f"warning: {message}", file=sys.stderr)
            else:
                shown(message, category, *place)

        warnings.showwarning = show
        yield


@contextmanager
def progress_bar() -> Iterator[Callable[..., None]]:
    """A ``masiv.progress.Progress`` on stderr: bars with the time left on a terminal, else a line now and then."""
    if sys.stderr.isatty():
        yield from _bars()
    else:
        yield _plain_lines()


def _bars() -> Iterator[Callable[..., None]]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("[bold]{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("ETA"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=Console(stderr=True)) as bars:
        tasks: dict[str, Any] = {}

        def report(stage: str, done: int, total: int, note: str = "") -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total, note=note)
            bars.update(tasks[stage], completed=done, total=total, note=note)

        yield report


def _plain_lines() -> Callable[..., None]:
    began: dict[str, tuple[float, int]] = {}
    said: dict[str, float] = {}
    last: dict[str, tuple[int, int, str]] = {}

    def report(stage: str, done: int, total: int, note: str = "") -> None:
        now = time.monotonic()
        start, first = began.setdefault(stage, (now, done))
        recent = now - said.get(stage, now - PLAIN_EVERY_S) < PLAIN_EVERY_S
        if recent and (done < total or last.get(stage) == (done, total, note)):
            return
        last[stage] = done, total, note
        said[stage] = now
        left = (now - start) * (total - done) / (done - first) if done > first else None
        eta = "" if left is None or done >= total else f", {left:.0f} s left"
        print(f"{stage} {done}/{total}{eta} {note}".rstrip(), file=sys.stderr, flush=True)

    return report
