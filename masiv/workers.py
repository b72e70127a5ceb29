"""Tasks in several processes, each with its own Taichi on one thread.

A rollout of a few thousand particles gains little from a second thread, and two rollouts in two processes take as long
as one. A rollout has the same bits in every process.

Arguments and results are pickled here, since the pickling of ``multiprocessing`` would move the memory of each torch
tensor to a place that both processes share, while a simulation may be reading it.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import tempfile
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import resource_tracker, util
from pathlib import Path
from typing import TYPE_CHECKING, Any

from masiv import runtime
from masiv.errors import InputError, MasivError
from masiv.parent import end_with_parent

if TYPE_CHECKING:
    from masiv.dask_pool import DaskPool

MAX_PROCESSES = 4


def process_count(asked: int) -> int:
    """``asked``, or if that is 0 the cores that Taichi may use, at most ``MAX_PROCESSES``; 1 on a GPU."""
    if runtime.running_arch() != "cpu":
        return 1
    return asked or min(runtime.threads(), MAX_PROCESSES)


def workers_for(processes: int, scheduler: str, key: str = "refine.processes") -> Workers:
    """A pool of as many processes as ``process_count`` says, or the workers of the Dask scheduler at the address
    ``scheduler``, if it is not empty. key: see ``Workers``. Raises InputError if no scheduler answers there."""
    if not scheduler:
        return Workers(process_count(processes), key)
    from masiv.dask_pool import DaskPool

    pool = DaskPool(scheduler, runtime.running_arch())
    return Workers(pool.workers, key, pool)


class TaskError:
    """The result of a task that raised a MasivError: its message, and whether it was an InputError."""

    def __init__(self, error: MasivError) -> None:
        self.reason = str(error)
        self.kind = InputError if isinstance(error, InputError) else MasivError


def unwrap(result: Any) -> Any:
    """``result`` of a task. Raises the MasivError or InputError of a ``TaskError``."""
    if isinstance(result, TaskError):
        raise result.kind(result.reason)
    return result


class Workers:
    """A pool of ``processes`` that run tasks; with 1, tasks run in this process. With a ``dask_pool`` they are the
    workers of a cluster, and all tasks run there.

    Use as a context. A process starts with a task that no idle one can take. If the block raises, they are terminated
    at once, and if this process is killed, they end, too; Ctrl-C reaches this process alone. key: of the configuration,
    that sets their number, for messages. A script that uses more than one process needs
    ``if __name__ == "__main__":``, as always with ``multiprocessing``.
    """

    def __init__(self, processes: int = 1, key: str = "refine.processes", dask_pool: DaskPool | None = None) -> None:
        self.processes = processes
        self.key = key
        self._dask = dask_pool
        self._pool: ProcessPoolExecutor | None = None
        self._started: set[Any] = set()

    def __reduce__(self) -> tuple:
        """A pool stays in its process: what is sent to another one works on one process there."""
        return Workers, ()

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._dask is not None:
            self._dask.close()
        if self._pool is None:
            return
        if kind is not None:
            for process in self._started:
                process.terminate()
        self._pool.shutdown(cancel_futures=True)
        self._pool = None

    def start(self) -> None:
        """Start all processes, if there are several, and return at once: they need seconds until the first task."""
        if self.processes > 1 and self._dask is None:
            for _ in range(self.processes):
                self._submit_here(_do_nothing)

    def map(self, function: Callable, tasks: Iterable[tuple], *, shared: tuple = ()) -> Iterator[Any]:
        """``function(*shared, *task)`` of each task, in order, or ``TaskError``.

        ``shared`` is pickled once for all tasks, and each task in another process gets its own copy. The function and
        its arguments must be picklable. Raises MasivError if a process dies.
        """
        tasks = list(tasks)
        if self._here or len(tasks) == 1:
            yield from (run_task(function, (*shared, *task)) for task in tasks)
            return
        with tempfile.TemporaryDirectory(prefix="masiv-") as folder:
            pickled: Any = pickle.dumps(shared, pickle.HIGHEST_PROTOCOL)
            if self._dask is not None:
                pickled = self._dask.share(pickled)
            else:
                path = Path(folder) / "shared.pickle"
                path.write_bytes(pickled)
                pickled = path
            futures = [self._submit(function, task, pickled) for task in tasks]
            try:
                for future in futures:
                    yield self._result(future)
            finally:
                for future in futures:
                    future.cancel()

    def submit(self, function: Callable, task: tuple) -> Callable[[], Any]:
        """Start ``function(*task)`` in another process. Returns a function that waits for its result.

        With one process the task runs in that function. Raises MasivError if the process died.
        """
        if self._here:
            return lambda: run_task(function, task)
        future = self._submit(function, task, None)
        return lambda: self._result(future)

    @property
    def on_this_machine(self) -> bool:
        """Whether tasks run where this process does, and see its files."""
        return self._dask is None

    @property
    def _here(self) -> bool:
        """Whether tasks run in this process."""
        return self.processes == 1 and self._dask is None

    def _submit(self, function: Callable, task: tuple, shared: Any) -> Future[bytes]:
        """shared: where the pickled arguments are that come first."""
        arguments = pickle.dumps((function, task)), shared
        if self._dask is not None:
            return self._dask.submit(_run_pickled_task, *arguments)
        return self._submit_here(_run_pickled_task, *arguments)

    def _result(self, future: Future[bytes]) -> Any:
        try:
            return pickle.loads(future.result())
        except BrokenProcessPool as died:
            raise MasivError(f"a worker process died, perhaps for lack of memory: set {self.key} to 1") from died

    def _submit_here(self, function: Callable, *arguments: Any) -> Future:
        """Run ``function(*arguments)`` in a process of this machine: a new one if none is idle and more may start."""
        if self._pool is None:
            spawn = multiprocessing.get_context("spawn")  # Taichi's threads do not survive a fork
            start = (runtime.running_arch(), os.getpid())
            self._pool = ProcessPoolExecutor(self.processes, spawn, initialize_process, start)
        others = set(multiprocessing.active_children()) - self._started
        try:
            with interrupts_not_inherited():
                return self._pool.submit(function, *arguments)
        finally:  # an interruption, too, has to find those that have started
            self._started = set(multiprocessing.active_children()) - others


@contextmanager
def interrupts_not_inherited() -> Iterator[None]:
    """Processes that start in this block never get SIGINT, which a terminal sends to all; not even while they import.
    This process gets it when the block ends."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    if hasattr(resource_tracker, "ensure_running"):
        resource_tracker.ensure_running()  # its start would unblock the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def initialize_process(arch: str, parent: int) -> None:
    """Let a new process end with the process ``parent``, limit it to one thread and start Taichi.

    The variables act on libraries that the caller's script has not imported yet, the calls on torch and Taichi.
    """
    started_by = multiprocessing.parent_process()
    assert started_by is not None
    end_with_parent(parent, started_by.join)
    ti = runtime.start_on_one_thread(arch)
    # Such a process does not call the functions of ``atexit``. This one writes the cache of compiled kernels.
    util.Finalize(None, ti.reset, exitpriority=1)


def _do_nothing() -> None:
    pass


def _run_pickled_task(pickled: bytes, shared: Path | bytes | None) -> bytes:
    """``run_task`` in another process. shared: the pickled arguments that come first, or a file with them."""
    function, task = pickle.loads(pickled)
    first = () if shared is None else pickle.loads(shared if isinstance(shared, bytes) else shared.read_bytes())
    return pickle.dumps(run_task(function, (*first, *task)))


def run_task(function: Callable, task: tuple) -> Any:
    """``function(*task)``, or a ``TaskError`` if that raises a MasivError."""
    try:
        return function(*task)
    except MasivError as error:
        return TaskError(error)
