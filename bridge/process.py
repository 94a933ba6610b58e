"""A bridge as the cell sees it: an observer that hands everything to another process and never waits for it.

A crash, a hang or a full queue over there costs samples, which are counted, and nothing else.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import marshal
import os
import select
import shutil
import struct
import subprocess
import sys
import tempfile
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from canprobe.cell.master.controller import Measurement, TactileSample
from canprobe.cell.master.cycle import Observation
from canprobe.cell.master.tactile_frame import TactileFrame
from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.load import SAVED_AS
from canprobe.cell.session.children import with_our_imports
from canprobe.cell.session.session import write_scene
from canprobe.cell.tasks.from_plan import Request
from canprobe.errors import ResultsError, UsageError
from canprobe.fieldbus.bus.port import TimedFrame, elapsed_ns, epoch_now_ns
from canprobe.fieldbus.protocol.tactile import Features, TactileHeader
from canprobe.lab.bridge.sample import SurfacePatch

if TYPE_CHECKING:
    from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate


# One observation ↔ bytes, for the way into a bridge's process: 3 µs where pickle takes 35.
#
# Only what a sample is made of is carried. Both ends are the same program, so that `marshal` will do.


@dataclass(frozen=True, slots=True, eq=False)
class Received:
    """An observation at the other end.

    Attributes:
        t_ns, measurement, frames: as in `Observation`.
        phase: column `phase` of the command, None without one.
        depth: column `depth_at_1n_mm`: indentation at 1 N with which its contact was placed, None without one.
        patch: the estimate of the command.
        dropped: observations that were lost before this one.
    """

    t_ns: int
    measurement: Measurement | None
    phase: float | None
    depth: float | None
    patch: SurfacePatch | None
    frames: list[TimedFrame]
    dropped: int


def pack_observation(observation: Observation, dropped: int = 0) -> bytes:
    """One observation as bytes.

    Args:
        observation: as the cell hands it out.
        dropped: how many were lost before it.
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
            observation.frames,
            dropped,
        )
    )


def _number(value: object) -> float | None:
    """A plain float of whatever a controller has put there; None where it is no number."""
    return float(value) if isinstance(value, int | float | np.number) else None


def unpack_observation(data: bytes) -> Received:
    """The inverse of `pack_observation`."""
    t_ns, measurement, phase, depth, estimate, frames, dropped = marshal.loads(data)
    return Received(
        t_ns,
        _unpack_measurement(measurement) if measurement is not None else None,
        phase,
        depth,
        _unpack_estimate(t_ns, *estimate) if estimate is not None else None,
        frames,
        dropped,
    )


def _pack_measurement(m: Measurement) -> Any:
    q = m.q.tobytes() if m.q is not None else None
    tactile = _pack_tactile(m.tactile) if m.tactile is not None else None
    return m.cycle, m.t_ns, q, m.q_age, m.torque_permille, m.statuswords, bool(m.enabled), tactile, m.tactile_age


def _unpack_measurement(parts: Any) -> Measurement:
    cycle, t_ns, q, age, torque, words, enabled, tactile, tactile_age = parts
    q = np.frombuffer(q) if q is not None else None
    tactile = _unpack_tactile(tactile) if tactile is not None else None
    return Measurement(cycle, t_ns, q, age, torque, words, enabled, tactile, tactile_age)


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


# The bounded queue between a cell and a bridge's process: a pipe that never makes the cell wait.
#
# The kernel's buffer is the queue. There is no thread, so that nothing competes with the cycle for the interpreter.

CAPACITY = 1 << 20
"""Bytes asked of the kernel: above a second of a whole cell at 400 Hz. It may grant less."""
PATIENCE_S = 5.0
"""How long a lossless feed waits for a reader that stands still before it, too, drops."""
_LENGTH = struct.Struct("<I")


class Feed:
    """Writes records into a pipe.

    Args:
        fd: the writing end; it becomes non-blocking.
        batch: records that go out by one system call.
        lossless: wait for room, where nobody minds: in virtual time, and from a recorded log.

    Attributes:
        taken: records that were given.
        dropped: of these, those that found the queue full or the reader gone.
        broken: the reader is gone.
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
        with contextlib.suppress(OSError, AttributeError):  # less where the system grants less
            fcntl.fcntl(fd, fcntl.F_SETPIPE_SZ, CAPACITY)

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
        """Send what is waiting, as far as there is room.

        Args:
            patience_s: how long to wait for room; by default not at all, or `PATIENCE_S` where lossless.
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
        """Write a part of what is left; False where there is no room."""
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
            self._lossless = False  # this reader stands still: it is waited for once
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


# The process.

READY_TIMEOUT_S = 60.0
END_TIMEOUT_S = 30.0
"""For everything that is still in the queue, however slow the machine; an interrupt cuts it short."""
CLOSE_TIMEOUT_S = 1.0
"""For the process to end once its bridge is done: a viewer that does not read is not waited for."""
KILL_TIMEOUT_S = 2.0
LATENCY_S = 0.02
"""Samples of this time leave by one system call."""
OBSERVATION, END = b"o", b"e"
"""First byte of a record: what follows."""


class BridgeProcess:
    """One bridge in its process.

    Args:
        name: of the bridge.
        plan: of the run.
        out: folder of the run; None where no files are written.
        virtual: the run is not in real time: its feed waits for room, and its time begins at 0.

    Attributes:
        requests: what the other tool asked of the cell, oldest first.
    """

    def __init__(self, name: str, plan: Plan, out: Path | None, *, virtual: bool) -> None:
        self.name = name
        self.requests: deque[Request] = deque(maxlen=100)
        self._folder = Path(tempfile.mkdtemp(prefix="canprobe-"))
        write_scene(plan, self._folder)
        self._config = {
            "scene": str(self._folder / SAVED_AS),
            "out": str(out.resolve()) if out is not None else None,
        }
        self._virtual = virtual
        self._takes_requests = name == "ros2" and bool(plan.scene.bridge and plan.scene.bridge.ros2_commands)
        self._epoch: bytes | None = None
        self._where: str | None = None
        self._error: str | None = None
        self._unwritten = False
        self._received: int | None = None
        self._ends_by_ns: int | None = None
        self._text = b""
        self._poll_in = self._batch = max(1, round(LATENCY_S * plan.scene.cycle.rate_hz))
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed by end
        reader, writer = os.pipe()
        self._process = subprocess.Popen(  # a new session: Ctrl-C is for the cell
            [sys.executable, "-P", "-m", "canprobe.lab.bridge.worker", name],
            env=with_our_imports(),
            stdin=reader,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            start_new_session=True,
        )
        os.close(reader)
        assert self._process.stdout is not None
        self._back = self._process.stdout.fileno()
        os.set_blocking(self._back, False)
        self._feed = Feed(writer, batch=self._batch, lossless=virtual)

    @property
    def pid(self) -> int:
        """Of its process."""
        return self._process.pid

    def await_ready(self) -> str:
        """Wait until the bridge says where it is to be found; at once where it has.

        Raises:
            UsageError: it could not begin; with its own words.
            ResultsError: it could not write where it is to write.
        """
        if self._where is not None:
            return self._where
        self._feed.put(marshal.dumps(self._config))
        self._feed.flush(READY_TIMEOUT_S)
        self._feed.taken = 0
        deadline = elapsed_ns() + round(READY_TIMEOUT_S * 1e9)
        while self._where is None and self._error is None:
            left = _left_s(deadline)
            if left <= 0:
                self._error = f"not ready after {READY_TIMEOUT_S:g} s"
            elif not self._listen(left):
                self._error = self._last_words() or "ended before it began"
        if self._where is None:
            raise (ResultsError if self._unwritten else UsageError)(f"bridge {self.name}: {self._error}")
        return self._where

    def observe(self, observation: Observation) -> None:
        """Hand one observation over, or drop it; where commands are allowed, see now and then whether there is one."""
        if self._epoch is None:
            epoch = 0 if self._virtual else epoch_now_ns() - observation.t_ns
            self._epoch = epoch.to_bytes(8, "little")
        feed = self._feed
        feed.put(OBSERVATION + self._epoch + pack_observation(observation, feed.dropped))
        if self._takes_requests and not feed.broken:
            self._poll_in -= 1
            if self._poll_in <= 0:
                self._poll_in = self._batch
                self._listen(0.0)

    def _listen(self, timeout_s: float) -> bool:
        """Take what came back; False at its end."""
        readable, _, _ = select.select([self._back], [], [], timeout_s)
        if not readable:
            return True
        data = b""
        with contextlib.suppress(BlockingIOError):
            data = os.read(self._back, 1 << 16)
        *lines, self._text = (self._text + data).split(b"\n")
        for line in lines:
            self._take(json.loads(line))
        return bool(data)

    def _take(self, document: dict[str, Any]) -> None:
        self._where = document.get("ready", self._where)
        self._error = document.get("error", self._error)
        self._unwritten = document.get("unwritten", self._unwritten)
        if "done" in document:
            self._received = document["done"]["received"]
            self._ends_by_ns = elapsed_ns() + round(CLOSE_TIMEOUT_S * 1e9)
        if "request" in document and self._takes_requests:
            try:
                self.requests.append(Request(**document["request"]))
            except (UsageError, TypeError) as error:  # it is not carried out, and the cell goes on
                self._error = f"refused: {error}"

    # the end

    def status(self) -> dict[str, Any]:
        """What stands in the summary: samples handed over and dropped, where it is, and what went wrong."""
        feed = self._feed
        dropped = feed.dropped if self._received is None else feed.taken - self._received
        return {"samples": feed.taken, "dropped": dropped, "where": self._where, "error": self._error}

    def end(self, summary: str | None) -> dict[str, Any]:
        """Hand over the last samples and the summary, and wait for the process, within bounds.

        Args:
            summary: content of `summary.json`, or None.

        Returns:
            `status`, with what was lost until the very end.
        """
        deadline = elapsed_ns() + round(END_TIMEOUT_S * 1e9)
        try:
            self._feed.flush(_left_s(deadline))
            taken, dropped = self._feed.taken, self._feed.dropped
            self._feed.put(END + (summary or "").encode())
            self._feed.flush(_left_s(deadline))
            self._feed.taken, self._feed.dropped = taken, max(dropped, self._feed.dropped - 1)
            self._feed.close()
            self._wait(deadline)
        finally:
            self.kill()
        return self.status()

    def _wait(self, deadline_ns: int) -> None:
        """Wait until the process has ended, or its time is up."""
        while (left := _left_s(min(deadline_ns, self._ends_by_ns or deadline_ns))) > 0:
            if not self._listen(left):
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._process.wait(max(left, 0.1))
                break
        if self._received is None and self._error is None:
            code = self._process.poll()
            self._error = self._last_words() or (
                f"did not end within {END_TIMEOUT_S:g} s" if code is None else f"ended with status {code}"
            )

    def kill(self) -> None:
        """Make sure that nothing is left of the process. Twice is allowed."""
        self._feed.close()
        if self._process.poll() is None:
            self._process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(KILL_TIMEOUT_S)
        if self._process.stdout is not None:
            self._process.stdout.close()
        shutil.rmtree(self._folder, ignore_errors=True)
        self._errors.close()

    def _last_words(self) -> str:
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else ""


def _left_s(deadline_ns: int) -> float:
    return max((deadline_ns - elapsed_ns()) * 1e-9, 0.0)
