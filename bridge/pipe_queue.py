"""The bounded queue between a cell and a bridge's process: a pipe that never makes the cell wait.

The kernel's buffer is the queue. There is no thread, so that nothing competes with the cycle for the interpreter.
"""

from __future__ import annotations

import os
import select
import struct
from collections.abc import Iterator
from typing import BinaryIO

from canprobe.fieldbus.bus.system import system

CAPACITY = 1 << 20
"""Requested size of the kernel's buffer, bytes: above a second of a whole cell at 400 Hz. The kernel may grant less."""
PATIENCE_S = 5.0
"""Time that a lossless feed waits for a stalled reader before it drops records too, s."""
_LENGTH = struct.Struct("<I")


class Feed:
    """Writes records into a pipe.

    Args:
        fd: file descriptor of the writing end; it becomes non-blocking.
        batch: number of records that one system call writes.
        lossless: whether to wait for room, as in virtual time and from a recorded log.

    Attributes:
        taken: number of records that were given.
        dropped: number of these that found the queue full or the reader gone.
        broken: whether the reader is gone.
    """

    def __init__(self, fd: int, *, batch: int = 1, lossless: bool = False) -> None:
        self.taken = 0
        self.dropped = 0
        self.broken = False
        self._fd = fd
        self._batch = batch
        self._lossless = lossless
        self._waiting: list[bytes] = []
        self._rest = memoryview(b"")
        self._leaving = 0
        os.set_blocking(fd, False)
        system.enlarge_pipe(fd, CAPACITY)

    def put(self, record: bytes) -> None:
        """Take one record; it is dropped and counted where the queue is full."""
        self.taken += 1
        if self.broken:
            self.dropped += 1
            return
        if len(self._waiting) >= self._batch:  # the batch before could not leave
            self.flush()
            if len(self._waiting) >= self._batch:
                self.dropped += 1
                return
        self._waiting.append(_LENGTH.pack(len(record)) + record)
        if len(self._waiting) >= self._batch:
            self.flush()

    def flush(self, patience_s: float | None = None) -> None:
        """Send the waiting records, as far as there is room.

        Args:
            patience_s: longest wait for room, s; by default 0, or `PATIENCE_S` where lossless.
        """
        patience = (PATIENCE_S if self._lossless else 0.0) if patience_s is None else patience_s
        while not self.broken and (self._rest or self._waiting):
            if not self._rest:
                self._rest = memoryview(b"".join(self._waiting))
                self._leaving = len(self._waiting)
                self._waiting.clear()
            if not self._write() and not (patience and self._wait(patience)):
                return

    def _write(self) -> bool:
        """Write a part of the rest; False where there is no room."""
        try:
            self._rest = self._rest[os.write(self._fd, self._rest) :]
        except BlockingIOError:
            return False
        except BrokenPipeError:
            self.broken = True
            self.dropped += self._leaving + len(self._waiting)
        return True

    def _wait(self, patience_s: float) -> bool:
        _, writable, _ = select.select([], [self._fd], [], patience_s)
        if not writable:
            self._lossless = False  # this reader is stalled: it is waited for only once
        return bool(writable)

    def close(self) -> None:
        """Close the pipe: the reader comes to its end. Twice is allowed."""
        if self._fd >= 0:
            self.broken = True
            os.close(self._fd)
            self._fd = -1


def read_records(stream: BinaryIO) -> Iterator[bytes]:
    """The records of a feed at the other end, until it is closed; a torn one at the end is left out."""
    while len(head := stream.read(_LENGTH.size)) == _LENGTH.size:
        (length,) = _LENGTH.unpack(head)
        record = stream.read(length)
        if len(record) < length:
            return
        yield record
