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
_READ: dict[int, _Reading] = {}
_WRITTEN: dict[int, _Writing] = {}
"""Threads of the streams, by descriptor: two readers of a terminal would take each other's lines."""


def lock(file: IO[Any]) -> None:
    place = file.tell()
    file.seek(_LOCKED_BYTE)
    try:
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
    except PermissionError as error:
        raise BlockingIOError(*error.args) from error
    finally:
        file.seek(place)


class _Reading(threading.Thread):
    """Reads a stream as long as there is one: here only a socket says whether it has anything to read."""

    def __init__(self, descriptor: int) -> None:
        super().__init__(daemon=True)
        self.came, self.is_open = SimpleQueue[bytes](), True
        self._descriptor = descriptor
        self.start()

    def run(self) -> None:
        data = b"-"
        while data:
            try:
                data = os.read(self._descriptor, 4096)
            except OSError:
                data = b""
            self.came.put(data)


def typed(descriptor: int) -> tuple[bytes, bool]:
    found, patience_s = b"", 0.0
    if (reading := _READ.get(descriptor)) is None:
        reading, patience_s = _READ.setdefault(descriptor, _Reading(descriptor)), _FIRST_LOOK_S
    while reading.is_open:
        try:
            data = reading.came.get(timeout=patience_s)
        except Empty:
            break
        found, reading.is_open, patience_s = found + data, bool(data), 0.0
    return found, reading.is_open


class _Writing(threading.Thread):
    """Writes a piece, for whose reader nobody waits."""

    def __init__(self, descriptor: int, data: bytes) -> None:
        super().__init__(daemon=True)
        self.error: OSError | None = None
        self._descriptor, self._data = descriptor, data
        self.start()

    def run(self) -> None:
        try:
            while self._data:
                self._data = self._data[os.write(self._descriptor, self._data) :]
        except OSError as error:
            self.error = error


def write_some(descriptor: int, data: bytes, patience_s: float) -> int:
    if (writing := _WRITTEN.get(descriptor)) is not None:
        writing.join(patience_s)
        if writing.is_alive():
            return 0
        if writing.error is not None:
            raise writing.error
    if data:
        _WRITTEN[descriptor] = _Writing(descriptor, data)
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
