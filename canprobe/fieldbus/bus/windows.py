"""Windows, behind `canprobe.fieldbus.bus.system`: prepared after its documentation, and tried by imitation only."""

from __future__ import annotations

import contextlib
import ctypes
import msvcrt
import os
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from queue import Empty, SimpleQueue
from subprocess import Popen
from typing import IO, Any

TERMINATION_SIGNALS = (signal.SIGTERM, signal.SIGBREAK)  # type: ignore[attr-defined]
# the second is TerminateProcess, which nothing can catch
END_SIGNALS = (signal.CTRL_BREAK_EVENT, signal.SIGTERM)  # type: ignore[attr-defined]
KILL = signal.SIGTERM
NON_BLOCKING_PIPES = False
OWN_SESSION: dict[str, Any] = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}  # type: ignore[attr-defined]
monotonic_ns = time.perf_counter_ns  # before Python 3.13 the other one has steps of 15.6 ms; time.sleep has none
_LOCKED_BYTE = 0x7FFFFFFE  # nobody else can read a byte that is locked: one behind the end of the file
_FIRST_LOOK_S = 0.05
"""Longest time of the first look at a stream: what was typed before it counts as typed, a closed stream as closed."""
_READ: dict[int, SimpleQueue[bytes]] = {}
"""What a thread reads, by descriptor: only a socket says here whether it has anything, and two would share a line."""
_WRITERS: dict[int, threading.Thread] = {}
_BROKEN: set[int] = set()
"""Threads that write a piece, for whose reader nobody waits; and descriptors that nobody reads any more."""


def lock(file: IO[Any]) -> None:
    place = file.tell()
    file.seek(_LOCKED_BYTE)
    try:
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
    except PermissionError as error:
        raise BlockingIOError(*error.args) from error
    finally:
        file.seek(place)


def _read(descriptor: int, came: SimpleQueue[bytes]) -> None:
    data = b"-"
    while data:
        try:
            data = os.read(descriptor, 4096)
        except OSError:
            data = b""
        came.put(data)


def typed(descriptor: int) -> tuple[bytes, bool]:
    found, patience_s = b"", 0.0
    if (came := _READ.get(descriptor)) is None:
        came, patience_s = _READ.setdefault(descriptor, SimpleQueue()), _FIRST_LOOK_S
        threading.Thread(target=_read, args=(descriptor, came), daemon=True).start()
    with contextlib.suppress(Empty):
        while data := came.get(timeout=patience_s):
            found, patience_s = found + data, 0.0
        came.put(b"")  # the end is there at the next look, too
        return found, False
    return found, True


def _write(descriptor: int, data: bytes) -> None:
    try:
        while data:
            data = data[os.write(descriptor, data) :]
    except OSError:
        _BROKEN.add(descriptor)


def write_some(descriptor: int, data: bytes, patience_s: float) -> int:
    if (writer := _WRITERS.get(descriptor)) is not None:
        writer.join(patience_s)
        if writer.is_alive():
            return 0
    if descriptor in _BROKEN:
        raise BrokenPipeError("nobody reads any more")
    if data:
        writer = _WRITERS[descriptor] = threading.Thread(target=_write, args=(descriptor, data), daemon=True)
        writer.start()
    return len(data)


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
