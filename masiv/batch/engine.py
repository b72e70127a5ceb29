"""Where the stages of a batch run: threads of this process that wait for processes, or a Dask cluster."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager

from masiv.errors import InputError
from masiv.workers import interrupts_not_inherited

MISSING = "needs Dask: pip install 'masiv[batch]'"
CONNECT_S = 10


@contextmanager
def engine(workers: int, scheduler: str | None) -> Iterator[Executor]:
    """An executor of stages: workers of the Dask scheduler at the address ``scheduler``, or ``workers`` of this
    machine, in a Dask cluster of its own where Dask is installed. On leaving, what has not begun is cancelled.
    Raises InputError for a scheduler that does not answer, or without Dask."""
    try:
        from distributed import Client, LocalCluster
    except ImportError as error:
        if scheduler is not None:
            raise InputError(f"--scheduler {scheduler} {MISSING}") from error
        with _waiting_threads(workers) as executor:
            yield executor
        return
    cluster = None
    if scheduler is None:
        with interrupts_not_inherited():
            cluster = LocalCluster(
                n_workers=workers, threads_per_worker=1, memory_limit=None, silence_logs=logging.CRITICAL,
                dashboard_address=":0",
            )  # fmt: skip
    try:
        client = Client(cluster or scheduler, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(f"--scheduler {scheduler}: no Dask scheduler answers there ({error})") from error
    try:
        yield client.get_executor(pure=False)
    finally:
        client.close()
        if cluster is not None:
            cluster.close()


@contextmanager
def _waiting_threads(workers: int) -> Iterator[Executor]:
    executor = ThreadPoolExecutor(workers)
    try:
        yield executor
    finally:
        executor.shutdown(cancel_futures=True)
