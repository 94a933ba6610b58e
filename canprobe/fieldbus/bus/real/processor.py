"""What a process in real time needs of its machine: priority, memory, and interrupts between two cycles only."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import gc
import os
from collections.abc import Callable, Iterator

# The processor's favour and the memory's, where they can be had.

FAVOURED = -15
"""Nice value asked for."""
MASTER_PRIORITY = 40
DEVICE_PRIORITY = 50
"""SCHED_FIFO priorities. Emulated nodes come first: a real device answers whatever the master is busy with."""
_MCL_CURRENT, _MCL_FUTURE = 1, 2
BLAS_THREADS = (
    "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS",
)  # fmt: skip
"""Variables that a BLAS reads when it is loaded. Matrices here are small: threads only wait for each other, on busy
processors ten times as long as one thread computes."""


def ask_for_processor() -> bool:
    """Ask to be scheduled before ordinary processes; True where that was permitted.

    Emulated nodes stand for devices of their own, which answer SYNC whatever the master is busy with. On one processor
    that takes a favour, else both sides wait for each other.
    """
    with contextlib.suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, 0, FAVOURED)
        return True
    return False


@contextlib.contextmanager
def realtime(priority: int, say: Callable[[str], None], *, processor_from_last: int = 0) -> Iterator[None]:
    """Within the block this process is scheduled by SCHED_FIFO, on one processor, with its memory locked.

    Each of the three is asked for by itself; what is not permitted is reported, with the way to it, and left out.
    Everything is given back at the end.

    Args:
        priority: SCHED_FIFO priority, 1–99; interrupt threads of a PREEMPT_RT kernel have 50.
        say: called with what was not permitted.
        processor_from_last: 0 for the last processor, 1 for the one before it; no choice where there are not so many.
    """
    wishes: tuple[tuple[Callable[[], Callable[[], object]], str, str], ...] = (
        (lambda: _fifo(priority), f"SCHED_FIFO priority {priority}", "run as root, or allow it: ulimit -r 50"),
        (lambda: _pinned(processor_from_last), "processor of its own", "see taskset -p"),
        (_locked, "locked memory", "run as root, or allow it: ulimit -l unlimited"),
    )
    with contextlib.ExitStack() as stack:
        for ask, what, way in wishes:
            try:
                stack.callback(ask())
            except (OSError, AttributeError) as error:
                say(f"real time: no {what}: {getattr(error, 'strerror', None) or 'not on this system'}; {way}")
        yield


def _fifo(priority: int) -> Callable[[], None]:
    policy, before = os.sched_getscheduler(0), os.sched_getparam(0)
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    return lambda: os.sched_setscheduler(0, policy, before)


def _pinned(from_last: int) -> Callable[[], None]:
    before = os.sched_getaffinity(0)
    processors = sorted(before)
    if len(processors) > from_last + 1:
        os.sched_setaffinity(0, {processors[-1 - from_last]})
    return lambda: os.sched_setaffinity(0, before)


def _locked() -> Callable[[], object]:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    unlock: Callable[[], object] = libc.munlockall
    return unlock


# Keeps the garbage collector and page faults out of cycles.

BYTES_PER_CYCLE = 4 << 10
"""A cycle that keeps its frames, log rows and truth grows by 1 to 3 KiB."""
LEAST_RESERVE, LARGEST_RESERVE = 4 << 20, 32 << 20
"""Bytes taken in advance; more than a run of 20 s at 400 Hz grows by."""
_SMALL = 480  # bytes; objects up to 512 come from Python's own allocator, larger ones from the C library
_KEEP_EVERY = (256 << 10) // 512


@functools.cache
def reserve_memory(cycles: int) -> tuple[bytes, ...]:
    """Let both allocators take memory from the system now, and keep it.

    A first touch of a page costs a microsecond, and a hundred in a virtual machine that has to ask its host: there a
    second for the largest reserve.

    Args:
        cycles: that are going to keep something; for longer runs the rest is taken on the way.

    Returns:
        What holds the memory, kept until the process ends; a second call has nothing left to do.
    """
    size = min(LEAST_RESERVE + cycles * BYTES_PER_CYCLE, LARGEST_RESERVE)  # half for small objects, half for large ones
    blocks = [bytes(_SMALL) for _ in range(size // 2 // 512)]
    for _ in range(2):  # the first raises glibc's limits above this size, the second then comes out of its heap
        bytearray(size // 2)
    return tuple(blocks[::_KEEP_EVERY])  # an arena with nothing in it would go back to the system


@contextlib.contextmanager
def garbage_collection_paused(*, collect: bool = True) -> Iterator[None]:
    """Within the block nothing is collected: a full collection takes 35 ms with these libraries loaded, 14 cycles.

    What exists at its start is set aside for good measure, so that a collection afterwards is short. The cycle makes no
    reference cycles, so nothing piles up meanwhile.

    Args:
        collect: collect once before; False where no time is lost by collecting later.
    """
    was_enabled = gc.isenabled()
    if collect:
        gc.collect()
        gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        if collect:
            gc.unfreeze()
        if was_enabled:
            gc.enable()
