"""Simulations side by side: processes that each have a Taichi of their own, on one thread.

A rollout of a few thousand particles gains little from a second thread, and two rollouts in two processes take as
long as one. A rollout is the same to the bit, wherever it runs.

What a process is given, and what it gives back, are copies. multiprocessing's own pickling would move the memory of
every torch tensor among them to one place that both processes share, in a thread of its own, under a simulation that
may be reading it.
"""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from masiv import runtime
from masiv.errors import InputError, MasivError

ONE_THREAD = {
    "TI_CPU_MAX_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
AT_MOST = 4


def processes_wanted(asked: int) -> int:
    """``asked``, or where that is 0 one process a core that Taichi may use, four at most; one on a GPU."""
    if runtime.running_arch() != "cpu":
        return 1
    return asked or min(runtime.threads(), AT_MOST)


class TaskError:
    """What a task that raised a MasivError gives: what it said, and whether the input was to blame."""

    def __init__(self, failed: MasivError) -> None:
        self.reason = str(failed)
        self.kind = InputError if isinstance(failed, InputError) else MasivError


def unwrap(found: Any) -> Any:
    """``found``, unless it is ``TaskError``. Raises MasivError, InputError where the input was to blame."""
    if isinstance(found, TaskError):
        raise found.kind(found.reason)
    return found


class Workers:
    """``processes`` (1: this one) that run tasks. Use as a context; the processes start with the first tasks. key: of
    the configuration, where their number comes from.

    A script that uses more than one needs ``if __name__ == "__main__":`` around what it does, as ever with processes.
    """

    def __init__(self, processes: int = 1, key: str = "refine.processes") -> None:
        self.processes = processes
        self.key = key
        self._pool: Any = None

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def begin(self) -> None:
        """Start the processes, where there are several, and go on: they take seconds to be ready for a task."""
        if self.processes > 1:
            self._started()

    def map(self, function: Callable, tasks: Iterable[tuple]) -> Iterator[Any]:
        """``function(*task)`` of each, in order, or ``TaskError``. The function and its arguments must be picklable.

        Raises MasivError where a process dies."""
        tasks = list(tasks)
        if self.processes == 1 or len(tasks) == 1:
            yield from (run_task(function, task) for task in tasks)
            return
        futures = [self._submitted(function, task) for task in tasks]
        try:
            for future in futures:
                yield self._result(future)
        finally:
            for future in futures:
                future.cancel()

    def submit(self, function: Callable, task: tuple) -> Callable[[], Any]:
        """Begin ``function(*task)`` in another process and go on. Returns a function that waits for its result.
        Where there is no other process the task runs then. Raises MasivError where the process has died."""
        if self.processes == 1:
            return lambda: run_task(function, task)
        future = self._submitted(function, task)
        return lambda: self._result(future)

    def _submitted(self, function: Callable, task: tuple) -> Any:
        """The future of ``function(*task)`` in another process."""
        return self._started().submit(_run_pickled_task, pickle.dumps((function, task)))

    def _result(self, future: Any) -> Any:
        from concurrent.futures.process import BrokenProcessPool

        try:
            return pickle.loads(future.result())
        except BrokenProcessPool as died:
            raise MasivError(f"a worker process died, of too little memory perhaps: set {self.key} to 1") from died

    def _started(self) -> Any:
        if self._pool is None:
            import multiprocessing
            from concurrent.futures import ProcessPoolExecutor

            spawn = multiprocessing.get_context("spawn")  # Taichi's threads do not survive a fork
            self._pool = ProcessPoolExecutor(self.processes, spawn, _start, (runtime.running_arch(),))
            with _environment(ONE_THREAD):  # which a process reads when it starts
                for _ in range(self.processes):
                    self._pool.submit(_nothing)
        return self._pool


@contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _start(arch: str) -> None:
    import multiprocessing.util

    import torch

    ti = runtime.start(arch)
    torch.set_num_threads(1)
    # What atexit has is not called in such a process; this writes the kernel cache.
    multiprocessing.util.Finalize(None, ti.reset, exitpriority=1)


def _nothing() -> None:
    pass


def _run_pickled_task(pickled: bytes) -> bytes:
    """``run_task`` in another process."""
    return pickle.dumps(run_task(*pickle.loads(pickled)))


def run_task(function: Callable, task: tuple) -> Any:
    """``function(*task)``, or ``TaskError`` where that raises a MasivError."""
    try:
        return function(*task)
    except MasivError as failed:
        return TaskError(failed)
