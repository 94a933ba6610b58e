"""The pipe between a cell and a bridge's process: one observation ↔ bytes, and a bounded queue that never waits.

An observation is packed in 3 µs where pickle takes 35: only the parts that a sample needs are carried, and both ends
are the same program, so that `marshal` is enough. The kernel's buffer is the queue. There is no thread, so that nothing
competes with the cycle for the interpreter.
"""

from __future__ import annotations

import marshal
import os
import select
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from canprobe.cell.master.controller import Measurement
from canprobe.cell.master.observers import Observation
from canprobe.cell.master.tactile_frame import TactileFrame, TactileSample
from canprobe.fieldbus.bus.port import TimedFrame
from canprobe.fieldbus.bus.system import system
from canprobe.fieldbus.protocol.tactile import Features, TactileHeader
from canprobe.lab.bridge.sample import SurfacePatch
from canprobe.mechanics.types import Floats

if TYPE_CHECKING:
    from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate

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
    measurement, command = observation.measurement, observation.command
    columns = command.columns if command is not None else {}
    estimate = command.estimate if command is not None else None
    return marshal.dumps(
        (
            observation.t_ns,
            _pack_measurement(measurement) if measurement is not None else None,
            _number(columns.get("phase")),
            _number(columns.get("depth_at_1n_mm")),
            _pack_estimate(estimate) if estimate is not None else None,
            ahead.tobytes() if isinstance(ahead := columns.get("explored_ahead_mm"), np.ndarray) else None,
            observation.frames,
            dropped,
        )
    )


def _number(value: object) -> float | None:
    """A controller's value as a float; None where it is no number."""
    return float(value) if isinstance(value, int | float | np.number) else None


def unpack_observation(data: bytes) -> Received:
    """The inverse of `pack_observation`."""
    t_ns, measurement, phase, depth, estimate, ahead, frames, dropped = marshal.loads(data)
    return Received(
        t_ns,
        _unpack_measurement(measurement) if measurement is not None else None,
        phase,
        depth,
        _unpack_estimate(t_ns, *estimate) if estimate is not None else None,
        np.frombuffer(ahead).reshape(-1, 3) if ahead is not None else None,
        frames,
        dropped,
    )


def _pack_measurement(m: Measurement) -> Any:
    q = m.q.tobytes() if m.q is not None else None
    tactile = _pack_tactile(m.tactile) if m.tactile is not None else None
    parts = m.cycle, m.t_ns, q, m.q_age, m.torque_permille, m.statuswords, bool(m.enabled), tactile, m.tactile_age
    return *parts, m.carrier


def _unpack_measurement(parts: Any) -> Measurement:
    cycle, t_ns, q, age, torque, words, enabled, tactile, tactile_age, carrier = parts
    q = np.frombuffer(q) if q is not None else None
    tactile = _unpack_tactile(tactile) if tactile is not None else None
    return Measurement(cycle, t_ns, q, age, torque, words, enabled, tactile, tactile_age, carrier)


def _pack_tactile(sample: TactileSample) -> Any:
    frame = sample.frame
    features = (frame.features.pack(), frame.features.peak) if frame.features is not None else None
    image = frame.header.pack(), frame.taxels.shape, frame.taxels.tobytes()
    return sample.t_sample_ns, sample.cycle, sample.t_sigma_s, image, frame.window, features, frame.t_ns


def _unpack_tactile(parts: Any) -> TactileSample:
    t_sample_ns, cycle, t_sigma_s, (header, shape, taxels), window, features, t_ns = parts
    image = np.frombuffer(taxels, np.uint8).reshape(shape)
    found = Features.unpack(*features) if features is not None else None
    frame = TactileFrame(TactileHeader.unpack(header), image, window, found, t_ns)
    return TactileSample(frame, t_sample_ns, cycle, t_sigma_s)


def _pack_estimate(estimate: SurfaceEstimate) -> Any:
    arrays = (estimate.T_frame_contact, estimate.K, estimate.covariance)
    observed = tuple(bool(one) for one in estimate.observed)
    return *(np.ascontiguousarray(array, np.float64).tobytes() for array in arrays), observed


def _unpack_estimate(t_ns: int, T: bytes, K: bytes, covariance: bytes, observed: tuple[bool, bool]) -> SurfacePatch:
    T_base_contact, C = np.frombuffer(T).reshape(4, 4), np.frombuffer(covariance).reshape(3, 3)
    return SurfacePatch(t_ns, T_base_contact, np.frombuffer(K).reshape(2, 2), C, observed)


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
