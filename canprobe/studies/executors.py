"""Where cells are computed: a pool of processes on this machine, or the workers of a Dask cluster."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import re
import signal
from collections.abc import Collection, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from multiprocessing.process import BaseProcess
from time import perf_counter

from canprobe.child import end_with_parent
from canprobe.errors import StudyError, UsageError

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
"""What tells a BLAS how many threads to use, when it is loaded."""
_DASK_WAIT = "10s"
_GRACE_S = 1.0
"""For workers to end by themselves: what they compute may hear SIGTERM as a wish to stop a run, and go on."""


@contextlib.contextmanager
def process_pool(workers: int | None = None) -> Iterator[Executor]:
    """A pool of processes with one BLAS thread each, ended with the block: at once where it is left by an exception.

    Workers never hear Ctrl-C (it is this process that decides), and end when this process is killed.

    Args:
        workers: processes; one for each core that this process may use by default.
    """
    before = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(
        workers or len(os.sched_getaffinity(0)),
        multiprocessing.get_context("spawn"),
        initializer=end_with_parent,
        initargs=(os.getpid(),),
    )
    try:
        with _environment(dict.fromkeys(THREADS, "1")):  # workers start when cells are submitted
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
        address: of the scheduler, such as "tcp://10.0.0.1:8786".

    Raises:
        UsageError: package `distributed` is not there.
        StudyError: that is no address, or no scheduler answers.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise UsageError("--dask needs the package distributed: pip install 'canprobe[dask]'") from error
    if not re.search(r":[0-9]+$", address):  # a Client that fails at once takes twenty seconds to end
        raise StudyError(f"--dask {address}: expected the address and port of a Dask scheduler, as tcp://10.0.0.1:8786")
    try:
        client = Client(address, timeout=_DASK_WAIT, set_as_default=False)
    except (OSError, ValueError) as error:
        raise StudyError(f"--dask {address}: expected a Dask scheduler there, got: {error}") from error
    executor = client.get_executor(pure=False)
    try:
        yield executor
        executor.shutdown()
    finally:
        client.close()  # cancels what is under way


class _Deaf(Executor):
    """Submits with SIGINT blocked: workers that this starts inherit it, from their first instruction on."""

    def __init__(self, pool: ProcessPoolExecutor) -> None:
        self._pool = pool

    def submit(self, fn, /, *args, **kwargs):  # type: ignore[no-untyped-def]  # as its base has it
        """See `Executor.submit`."""
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            return self._pool.submit(fn, *args, **kwargs)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end(workers: Collection[BaseProcess]) -> None:
    for worker in workers:
        worker.terminate()
    until = perf_counter() + _GRACE_S
    for worker in workers:
        worker.join(max(until - perf_counter(), 0.0))
        worker.kill()
        worker.join()


@contextlib.contextmanager
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
