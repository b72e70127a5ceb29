"""Simulations in a process of their own, so that the page answers while one runs. The last request wins."""

from __future__ import annotations

import itertools
import multiprocessing
import os
import pickle
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from masiv.errors import MasivError
from masiv.simulation.rollout import Rollout
from masiv.view.variation import Job, Variation
from masiv.workers import initialize_process, interrupts_not_inherited

END_S = 5.0
"""Time for the process to end, after which it is killed."""


class _Superseded(Exception):
    """There is a newer request."""


class Simulations:
    """Simulate variations of ``job`` one after the other, in a process that starts with the first request.

    A request replaces those before it: one that runs is broken off at its next frame. Then one of these is called, in
    a thread: progress(done, total) in frames; finished(variation, rollout); failed(variation, sentence). Use as a
    context: at its end the process is gone.
    """

    def __init__(
        self,
        job: Job,
        arch: str,
        *,
        progress: Callable[[int, int], None],
        finished: Callable[[Variation, Rollout], None],
        failed: Callable[[Variation, str], None],
    ) -> None:
        self._job = pickle.dumps(job)
        self._arch = arch
        self._progress, self._finished, self._failed = progress, finished, failed
        self._lock = threading.Lock()
        self._numbers = itertools.count()
        self._latest: tuple[int, Variation] | None = None
        self._connection: Connection | None = None
        self._process: Any = None
        self._closed = False

    def __enter__(self) -> Simulations:
        return self

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._closed = True
            process, connection = self._process, self._connection
        if connection is not None:
            connection.close()
        if process is not None:
            process.terminate()
            process.join(END_S)
            if process.is_alive():
                process.kill()
                process.join()

    def ask(self, variation: Variation) -> None:
        """Simulate ``variation`` instead of what was asked before."""
        with self._lock:
            if self._closed:
                return
            if self._connection is None:
                self._start()
            assert self._connection is not None
            self._latest = next(self._numbers), variation
            try:
                self._connection.send_bytes(pickle.dumps(self._latest))
            except OSError:  # it has just died, and the thread that reads says so
                pass

    def _start(self) -> None:
        spawn = multiprocessing.get_context("spawn")  # Taichi's threads do not survive a fork
        self._connection, theirs = spawn.Pipe()
        arguments = (theirs, self._job, self._arch, os.getpid())
        self._process = spawn.Process(target=_simulate_requests, args=arguments, daemon=True, name="masiv-view")
        with interrupts_not_inherited():
            self._process.start()
        theirs.close()
        threading.Thread(target=self._read, args=(self._connection,), daemon=True).start()

    def _read(self, connection: Connection) -> None:
        while True:
            try:
                kind, number, *content = pickle.loads(connection.recv_bytes())
            except (EOFError, OSError):
                break
            with self._lock:
                latest = self._latest
            if latest is None or number != latest[0]:
                continue
            if kind == "progress":
                self._progress(*content)
            elif kind == "finished":
                self._finished(latest[1], content[0])
            else:
                self._failed(latest[1], content[0])
        with self._lock:
            if self._closed:
                return
            self._connection, latest = None, self._latest
        if latest is not None:
            self._failed(
                latest[1],
                "the process that simulates has died, perhaps for lack of memory; the next change starts another",
            )


def _simulate_requests(connection: Connection, job: bytes, arch: str, parent: int) -> None:
    """Answer requests until the connection ends. Messages are pickled here: see ``masiv.workers``."""
    initialize_process(arch, parent)
    work: Job = pickle.loads(job)
    while True:
        try:
            number, variation = _newest(connection)
            _answer(connection, work, number, variation)
        except _Superseded:
            continue
        except (EOFError, OSError):
            return


def _newest(connection: Connection) -> tuple[int, Variation]:
    request = connection.recv_bytes()
    while connection.poll():
        request = connection.recv_bytes()
    return pickle.loads(request)


def _answer(connection: Connection, job: Job, number: int, variation: Variation) -> None:
    def progress(stage: str, done: int, total: int, note: str = "") -> None:
        if connection.poll():
            raise _Superseded
        connection.send_bytes(pickle.dumps(("progress", number, done, total)))

    try:
        answer: tuple = ("finished", number, job.run(variation, progress))
    except MasivError as error:
        answer = ("failed", number, str(error))
    connection.send_bytes(pickle.dumps(answer))
