"""Tasks on the workers of a Dask scheduler, in place of processes of this machine."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from masiv import runtime
from masiv.errors import InputError, MasivError

CONNECT_S = 10
INSTALL = "pip install 'masiv[batch]'"


class DaskPool:
    """The workers of the scheduler at ``address``, each of one thread. Their Taichi starts on ``arch`` with the first
    task. A worker that dies is replaced, and its task runs elsewhere.

    Raises InputError without Dask, if no scheduler answers, if it has no workers, or workers of several threads:
    Taichi runs on one thread of a process.
    """

    def __init__(self, address: str, arch: str) -> None:
        try:
            from distributed import Client
        except ImportError as error:
            raise InputError(f"the scheduler {address} needs Dask: {INSTALL}") from error
        try:
            self.client = Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(f"no Dask scheduler answers at {address}: {error}") from error
        threads: dict[str, int] = self.client.nthreads()  # type: ignore[assignment]
        self.arch = arch
        self.workers = len(threads)
        if not threads or max(threads.values()) > 1:
            self.close()
            what = f"has a worker of {max(threads.values())} threads" if threads else "has no workers"
            raise InputError(f"the scheduler {address} {what}: start some with dask worker {address} --nthreads 1")

    def share(self, data: bytes) -> Any:
        """``data``, which tasks get as an argument, sent once to each worker that needs it."""
        # A key of its own: under that of its content it may be released for an earlier call that shared the same.
        return self.client.scatter(data, hash=False)

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Start ``function(*arguments)`` on a worker. The result raises MasivError if workers died of it."""
        return _Result(self.client.submit(_on_worker, self.arch, function, *arguments, pure=False))  # type: ignore[return-value]

    def close(self) -> None:
        """Cancel what has not begun, and let go of the scheduler."""
        self.client.close()


class _Result:
    def __init__(self, future: Any) -> None:
        self._future = future

    def result(self) -> Any:
        from distributed import KilledWorker

        try:
            return self._future.result()
        except KilledWorker as died:
            raise MasivError(f"a task of the Dask scheduler failed, since its workers died: {died}") from died

    def cancel(self) -> None:
        self._future.cancel()


def _on_worker(arch: str, function: Callable[..., Any], *arguments: Any) -> Any:
    runtime.start_on_one_thread(arch)
    return function(*arguments)
