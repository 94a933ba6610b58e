"""Windows, behind `canprobe.fieldbus.bus.system`: prepared after its documentation, and tried by imitation only."""

from __future__ import annotations

import contextlib
import ctypes
import msvcrt
import os
import signal
import subprocess
from collections.abc import Iterator
from subprocess import Popen
from typing import IO, Any

TERMINATION_SIGNALS = (signal.SIGTERM, signal.SIGBREAK)  # type: ignore[attr-defined]
# the second is TerminateProcess, which nothing can catch
END_SIGNALS = (signal.CTRL_BREAK_EVENT, signal.SIGTERM)  # type: ignore[attr-defined]
KILL = signal.SIGTERM
NON_BLOCKING_PIPES = False
OWN_SESSION: dict[str, Any] = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}  # type: ignore[attr-defined]


def lock(file: IO[Any]) -> None:
    file.seek(0)
    try:
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
    except PermissionError as error:
        raise BlockingIOError(*error.args) from error


def enlarge_pipe(fd: int, size: int) -> None:
    """A pipe keeps its size."""


@contextlib.contextmanager
def interrupts_blocked() -> Iterator[None]:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def end_process(process: Popen[bytes], number: int) -> None:
    process.send_signal(number)


end_session = end_process


def end_with_parent(parent: int, number: int) -> None:
    """A process is not told that its parent has ended."""


def processors() -> int:
    return os.cpu_count() or 1


def is_root() -> bool:
    return False


def soft_limit(name: str) -> str | None:
    return None


def c_library() -> ctypes.CDLL | None:
    return None


def ioctl(fd: object, request: int, argument: bytes) -> bytes:
    raise OSError("there is no SocketCAN here")
