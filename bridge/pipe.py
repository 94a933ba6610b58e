"""The pipe between a cell and a bridge's process: one observation ↔ bytes, and a bounded queue that never waits.

Both ends are the same program, so that `pickle` is enough: it takes 20 to 50 µs of a cycle, when its commands are out.
The kernel's buffer is the queue. There is no thread, so that nothing competes with the cycle for the interpreter.
"""

from __future__ import annotations

import os
import pickle
import select
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np

from canprobe.cell.master.controller import Measurement
from canprobe.cell.master.observers import Observation
from canprobe.fieldbus.bus.port import TimedFrame
from canprobe.fieldbus.bus.system import system
from canprobe.lab.bridge.sample import SurfacePatch
from canprobe.mechanics.types import Floats

CAPACITY = 1 << 20
"""Requested size of the kernel's buffer, bytes: above a second of a whole cell at 400 Hz. The kernel may grant less."""
PATIENCE_S = 5.0
"""Time that a lossless feed waits for a stalled reader before it drops records too, s."""
_LENGTH = struct.Struct("<I")


@dataclass(frozen=True, slots=True, eq=False)
class Received:
    """An observation at the other end.

    Attributes:
        t_ns, measurement, frames: fields of the `Observation`.
        phase: column `phase` of the command, None without one.
        depth: column `depth_at_1n_mm`: indentation at 1 N with which its contact was placed, None without one.
        patch: estimate of the command.
        ahead: column `explored_ahead_mm`: path ahead of an exploration (n, 3), None without one.
        dropped: number of observations that were lost before this one.
    """

    t_ns: int
    measurement: Measurement | None
    phase: float | None
    depth: float | None
    patch: SurfacePatch | None
    ahead: Floats | None
    frames: list[TimedFrame]
    dropped: int


def pack_observation(observation: Observation, dropped: int = 0) -> bytes:
    """One observation as bytes.

    Args:
        observation: observation from the cell.
        dropped: number of observations that were lost before it.
    """
    t_ns, command = observation.t_ns, observation.command
    columns = command.columns if command is not None else {}
    patch = None
    if command is not None and (found := command.estimate) is not None:
        observed = bool(found.observed[0]), bool(found.observed[1])
        patch = SurfacePatch(t_ns, found.T_frame_contact, found.K, found.covariance, observed)
    phase, depth = (_number(columns.get(name)) for name in ("phase", "depth_at_1n_mm"))
    found_ahead = columns.get("explored_ahead_mm")
    ahead = found_ahead if isinstance(found_ahead, np.ndarray) else None
    received = Received(t_ns, observation.measurement, phase, depth, patch, ahead, observation.frames, dropped)
    return pickle.dumps(received, pickle.HIGHEST_PROTOCOL)


def _number(value: object) -> float | None:
    """A controller's value as a float; None where it is no number."""
    return float(value) if isinstance(value, int | float | np.number) else None


def unpack_observation(data: bytes) -> Received:
    """The inverse of `pack_observation`."""
    received: Received = pickle.loads(data)
    return received


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
        self.taken = self.dropped = 0
        self.broken = False
        self._fd, self._batch, self._lossless = fd, batch, lossless
        self._waiting: list[bytes] = []
        self._rest = memoryview(b"")
        self._leaving = 0
        os.set_blocking(fd, False)
        system.enlarge_pipe(fd, CAPACITY)

    def put(self, record: bytes) -> None:
        """Take one record; it is dropped and counted where the queue is full."""
        self.taken += 1
        if len(self._waiting) >= self._batch:  # the batch before could not leave
            self.flush()
        if self.broken or len(self._waiting) >= self._batch:
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
