"""Linux and macOS, behind `canprobe.fieldbus.bus.system`."""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import resource
import select
import signal
import time
from collections.abc import Iterator
from subprocess import Popen
from typing import IO, Any

TERMINATION_SIGNALS = (signal.SIGTERM, signal.SIGHUP)
END_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGKILL)  # SIGINT is ignored in the background
KILL = signal.SIGKILL
OWN_SESSION: dict[str, Any] = {"start_new_session": True}
NON_BLOCKING_PIPES = True
monotonic_ns = time.monotonic_ns
_PR_SET_PDEATHSIG = 1
_WRITTEN = 2048
"""Bytes that a stream takes at once where it takes any."""


def lock(file: IO[Any]) -> None:
    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def typed(descriptor: int) -> tuple[bytes, bool]:
    found = b""
    while select.select([descriptor], [], [], 0)[0]:
        try:
            data = os.read(descriptor, 4096)
        except OSError:  # EIO: the terminal has been closed
            data = b""
        if not data:
            return found, False
        found += data
    return found, True


def write_some(descriptor: int, data: bytes, patience_s: float) -> int:
    takes = data and select.select([], [descriptor], [], patience_s)[1]
    return os.write(descriptor, data[:_WRITTEN]) if takes else 0


def enlarge_pipe(fd: int, size: int) -> None:
    with contextlib.suppress(OSError, AttributeError):  # less where the system grants less
        fcntl.fcntl(fd, fcntl.F_SETPIPE_SZ, size)


@contextlib.contextmanager
def interrupts_blocked() -> Iterator[None]:
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_process(process: Popen[bytes], number: int) -> None:
    process.send_signal(number)
    process.send_signal(signal.SIGCONT)  # a stopped process receives the signal only then


def end_session(process: Popen[bytes], number: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, number)


def end_with_parent(parent: int, number: int) -> None:
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)
        if os.getppid() != parent:
            os.kill(os.getpid(), number)


def processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def is_root() -> bool:
    return os.geteuid() == 0


def soft_limit(name: str) -> str | None:
    number = getattr(resource, name, None)
    if number is None:
        return None
    soft = resource.getrlimit(number)[0]
    return "unlimited" if soft == resource.RLIM_INFINITY else str(soft)


def ioctl(fd: Any, request: int, argument: bytes) -> bytes:
    return fcntl.ioctl(fd, request, argument)


def c_library() -> ctypes.CDLL | None:
    return ctypes.CDLL(None, use_errno=True)
