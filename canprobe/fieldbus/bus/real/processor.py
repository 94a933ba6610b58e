"""Requests of a process in real time to its machine: priority, one processor, locked memory."""

from __future__ import annotations

import contextlib
import ctypes
import os
from collections.abc import Callable, Iterator
from typing import Any

from canprobe.fieldbus.bus.system import system

NICE_VALUE = -15
"""Nice value that is asked for."""
MASTER_PRIORITY = 40
DEVICE_PRIORITY = 50
"""SCHED_FIFO priorities. Emulated nodes come first, as a real device answers whatever the master does."""
_MCL_CURRENT, _MCL_FUTURE = 1, 2
BLAS_THREADS = (
    "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS",
)  # fmt: skip
"""Variables that a BLAS reads when it is loaded. Matrices here are small: several threads only wait for each other, on
busy processors ten times as long as one thread computes."""


def ask_for_processor() -> bool:
    """Ask to be scheduled before ordinary processes; return whether that was permitted.

    Emulated nodes stand for devices that answer SYNC whatever the master does. On one processor they need precedence,
    else both sides wait for each other.
    """
    with contextlib.suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, 0, NICE_VALUE)
        return True
    return False


@contextlib.contextmanager
def realtime(priority: int, say: Callable[[str], None], *, processor_from_last: int = 0) -> Iterator[None]:
    """Run the block by SCHED_FIFO, on one processor, with the memory locked.

    Each of the three is asked for separately; what is not permitted is left out and reported, with what to type.
    Everything is undone at the end.

    Args:
        priority: SCHED_FIFO priority, 1–99; interrupt threads of a PREEMPT_RT kernel have 50.
        say: function that is called with what was not permitted.
        processor_from_last: 0 for the last processor, 1 for the one before it; ignored where there are not so many.
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
    libc: Any = system.c_library()  # without one mlockall is no attribute
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE):
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    unlock: Callable[[], object] = libc.munlockall
    return unlock
