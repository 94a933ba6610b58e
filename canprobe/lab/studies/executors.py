"""Executors that compute cells: a pool of processes on this machine, or the workers of a Dask cluster."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import re
import sys
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import AbstractContextManager
from multiprocessing.process import BaseProcess
from time import perf_counter
from types import ModuleType

from canprobe.errors import StudyError, needed_module
from canprobe.fieldbus.bus.real.processor import BLAS_THREADS
from canprobe.fieldbus.bus.system import system

_DASK_WAIT = "10s"
_GRACE_S = 1.0
"""Time in which workers end by themselves: a run catches SIGTERM, stops, and its worker continues."""


@contextlib.contextmanager
def process_pool(workers: int | None = None) -> Iterator[Executor]:
    """A pool of processes with one BLAS thread each, ended with the block; an exception ends it at once.

    Workers ignore Ctrl-C: this process decides. They end when this process is killed.

    Args:
        workers: number of processes; one for each core that this process may use by default.
    """
    before = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(
        workers or system.processors(),
        multiprocessing.get_context("spawn"),
        initializer=_begin,
        initargs=(os.getpid(),),
    )
    try:
        yield _Deaf(pool)
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)
        _end(set(multiprocessing.active_children()) - before)
        raise
    finally:
        pool.shutdown()


@contextlib.contextmanager
def dask_executor(address: str) -> Iterator[Executor]:
    """The workers of a Dask cluster; they need the same canprobe.

    Args:
        address: address of the scheduler, such as "tcp://10.0.0.1:8786".

    Raises:
        UsageError: package `distributed` is missing.
        StudyError: not an address, or no scheduler answers.
    """
    distributed = needed_module("distributed", "dask", "a Dask cluster needs the package distributed:")
    if not re.search(r":[0-9]+$", address):  # a Client that fails at once takes twenty seconds to end
        raise StudyError(f"Dask scheduler {address}: expected its address and port, as tcp://10.0.0.1:8786")
    try:
        client = distributed.Client(address, timeout=_DASK_WAIT, set_as_default=False)
    except (OSError, ValueError) as error:
        raise StudyError(f"Dask scheduler {address}: expected an answer, got: {error}") from error
    executor = client.get_executor(pure=False)
    try:
        yield executor
        executor.shutdown()
    finally:
        client.close()  # cancels what is under way


class _Deaf(Executor):
    """Submits with SIGINT blocked: workers inherit that from their first instruction on.

    A worker that is started then does not import the script that starts it, which would start its sweep again; cells
    are measured by functions of modules.
    """

    def __init__(self, pool: ProcessPoolExecutor) -> None:
        self._pool = pool

    def submit(self, fn, /, *args, **kwargs):  # type: ignore[no-untyped-def]  # as its base has it
        """See `Executor.submit`."""
        script, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
        try:
            with system.interrupts_blocked():
                return self._pool.submit(fn, *args, **kwargs)
        finally:
            sys.modules["__main__"] = script


def _end(workers: Collection[BaseProcess]) -> None:
    for worker in workers:
        worker.terminate()
    until = perf_counter() + _GRACE_S
    for worker in workers:
        worker.join(max(until - perf_counter(), 0.0))
        worker.kill()
        worker.join()


def _begin(parent: int) -> None:
    """Begin a worker. Nothing in it moves, and whatever it does cannot ignore the signal."""
    os.environ.update(dict.fromkeys(BLAS_THREADS, "1"))  # before numpy is loaded
    system.end_with_parent(parent, system.KILL)


Opener = Callable[[], AbstractContextManager[Executor]]
