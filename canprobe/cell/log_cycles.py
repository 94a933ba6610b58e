"""A recorded bus → the cycles that a cell makes of it, one after another."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from canprobe.bus.port import TimedFrame
from canprobe.cell.build import make_drives, make_tactile
from canprobe.cell.deadlines import find_deadlines
from canprobe.cell.drives import CommandFrame, DriveGroup, command_frames
from canprobe.cell.intake import SYNCS_REMEMBERED, Intake
from canprobe.cell.measurement import Measurement
from canprobe.cell.recording import STAMP_JITTER_NS, Recording
from canprobe.errors import ProtocolError
from canprobe.planning.model import Plan
from canprobe.protocol.cia402 import known_state
from canprobe.protocol.frame_bits import INTERMISSION_BITS, exact_bits

DRIFT_BLOCK = 400
"""SYNCs over which another logger's clock does not drift by a noticeable share of a period."""
MOST_LOST = 5
"""A SYNC counter that jumps by more was started again."""
ENABLE_OPERATION = 0x000F


@dataclass(frozen=True, slots=True)
class LogCycle:
    """One cycle of a log.

    Attributes:
        measurement: what the cell saw.
        targets: target positions that the drives were last told, counts; None before all six were.
        enabled_by_master: every drive's last controlword asks for operation, as far as any was heard.
    """

    measurement: Measurement
    targets: tuple[int, ...] | None
    enabled_by_master: bool


class LogCycles:
    """Iterates over the cycles of a recording. One object, one pass; what it counted is there afterwards.

    With ``as_taken`` the order of the lines decides what a cycle saw, as in a log that a cell on a real bus wrote: a
    frame is written when it is taken in, so what stands between a SYNC and the RPDOs behind it was seen. Otherwise the
    stamps decide: the cell is taken to have looked at its bus exactly at its looks, until every TPDO was in. That is
    so in lockstep; of a real bus it is an estimate, for a cell wakes up later than it wants to, and a frame that came
    in between then counts one cycle later, or as late.

    Args:
        plan: of the cell.
        recording: the log, in the order that ``as_taken`` wants.
        as_taken: see above.
        on_deadlines: a measurement's time is its cycle's deadline, as a cell has it. False, for another master, of
            whom neither deadlines nor looks are known: it is the stamp of its SYNC, and what came before the next SYNC
            belongs to it.
        drifts: the stamps are another clock's than the master's.

    Attributes:
        start_ns: when the first cycle was due, on the clock of the log. A measurement's time counts from there.
        sync_times_s: time of each SYNC, from there.
        lost_syncs: SYNCs that the log lacks.
    """

    def __init__(
        self, plan: Plan, recording: Recording, *, as_taken: bool, on_deadlines: bool = True, drifts: bool = False
    ) -> None:
        overflow = recording.sync_overflow or plan.sync.overflow or SYNCS_REMEMBERED
        self.drives = make_drives(plan)
        self.tactile = make_tactile(plan, overflow)
        self.sync_times_s: list[float] = []
        self.lost_syncs = 0
        self._intake = Intake(self.drives, self.tactile, overflow)
        self._recording = recording
        self._as_taken = as_taken
        self._overflow = overflow
        self._period_ns = plan.sync.period_ns
        stamps = recording.sync_stamps
        numbers, deadlines = find_deadlines(stamps, plan.sync.period_ns, DRIFT_BLOCK if drifts else None)
        self._times = (numbers * plan.sync.period_ns if on_deadlines else stamps - stamps[0]).tolist()
        self.start_ns = int(stamps[0])
        if on_deadlines:
            self.start_ns = int(np.min(stamps - _wire_times(plan, recording) - numbers * plan.sync.period_ns))
        looks: Sequence[float] = plan.traffic.budget.looks_ns if on_deadlines else (math.inf,)
        waited = (plan.traffic.budget.sync_ns or 0) + STAMP_JITTER_NS  # for the bus, or so its stamp says
        on_time = stamps - deadlines <= waited
        self._looks = _looks(recording, np.where(on_time, deadlines, stamps), looks)
        axes = self.drives.axes if self.drives is not None else ()
        self._commands = {frame.cob_id: frame for frame in command_frames(axes)}
        self._targets: list[int | None] = [None] * len(axes)
        self._words: dict[int, int] = {}

    def __iter__(self) -> Iterator[LogCycle]:
        recording, intake = self._recording, self._intake
        frames, syncs, stamps = recording.frames, recording.syncs.tolist(), recording.sync_stamps.tolist()
        intake.route(frames[: syncs[0]])
        position, counter_before = syncs[0], 0
        for k, (first, last) in enumerate(zip(syncs, [*syncs[1:], len(frames)], strict=True)):
            counter = frames[first][1][0] if frames[first][1] else 0
            for ago in range(self._lost(counter_before, counter), 0, -1):
                self.lost_syncs += 1
                self._begin(self._times[k] - ago * self._period_ns, stamps[k] - ago * self._period_ns)
            self._begin(self._times[k], stamps[k])
            counter_before = counter
            seen = self._collect_taken(first, last) if self._as_taken else self._collect(k, position)
            measurement = intake.measure(counter)
            if self.drives is not None and not measurement.enabled:
                _check_states(self.drives)
            if self._as_taken:
                intake.route(frames[seen:last])
            position = seen
            self._follow(frames[first:last])
            targets = self._known_targets()
            if self.drives is not None and targets is not None:
                self.drives.aim(targets)
            yield LogCycle(measurement, targets, self._enabled_by_master())

    def _begin(self, t_ns: int, stamp_ns: int) -> None:
        self._intake.begin(self._intake.number + 1, t_ns, stamp_ns)
        self.sync_times_s.append(t_ns * 1e-9)

    def _lost(self, before: int, counter: int) -> int:
        """How many SYNCs are missing in the log between two counters; they too have their number and their time."""
        lost = (counter - before - 1) % self._overflow if before and counter else 0
        return lost if lost <= MOST_LOST else 0

    def _collect(self, k: int, position: int) -> int:
        frames, intake = self._recording.frames, self._intake
        for end in self._looks[k]:
            if end > position:
                intake.route(frames[position:end])
                position = end
            if intake.complete:
                break
        intake.end()
        return position

    def _collect_taken(self, first: int, last: int) -> int:
        frames, commands = self._recording.frames, self._commands
        end = next((i for i in range(first + 1, last) if frames[i][0] in commands), last)
        self._intake.route(frames[first + 1 : end])
        self._intake.end()
        return end

    def _follow(self, frames: list[TimedFrame]) -> None:
        for can_id, data, _ in frames:
            frame = self._commands.get(can_id)
            if frame is not None:
                self._take_command(frame, data)

    def _take_command(self, frame: CommandFrame, data: bytes) -> None:
        for axis, layout, picks in frame.parts:
            for value, pick in zip(layout.unpack(data), picks, strict=True):
                if pick:
                    self._targets[axis] = value
                else:
                    self._words[axis] = value

    def _known_targets(self) -> tuple[int, ...] | None:
        known = tuple(target for target in self._targets if target is not None)
        return known if known and len(known) == len(self._targets) else None

    def _enabled_by_master(self) -> bool:
        return all(word & ENABLE_OPERATION == ENABLE_OPERATION for word in self._words.values())


def _check_states(drives: DriveGroup) -> None:
    """A log in which a statusword tells no state was made with another mapping, or by a drive out of order."""
    for axis, word in zip(drives.axes, drives.statuswords, strict=True):
        if known_state(word) is None:
            raise ProtocolError(f"node {axis.node_id}: statusword {word:#06x} is no CiA 402 state")


def _wire_times(plan: Plan, recording: Recording) -> NDArray[np.int64]:
    """From each SYNC's deadline to its stamp (n,), ns: a lockstep log with a bit rate has the ends of frames."""
    bus = plan.setup.bus
    if bus.interface != "lockstep" or not bus.timed or bus.fd is True:
        return np.zeros(len(recording.syncs), np.int64)
    syncs = (recording.frames[i] for i in recording.syncs.tolist())
    bits = np.array([exact_bits(can_id, data) - INTERMISSION_BITS for can_id, data, _ in syncs])
    return bits * 1_000_000_000 // bus.bitrate


def _looks(recording: Recording, sent_ns: NDArray[np.int64], delays_ns: Sequence[float]) -> list[list[int]]:
    """Where each look of each cycle ends among the frames; the delays count from when its SYNC was sent."""
    stamps, syncs = recording.sync_stamps, recording.syncs
    following = np.append(syncs[1:], len(recording.frames))
    ends = []
    for delay in delays_ns:
        if math.isinf(delay):
            ends.append(following)
        else:
            instants = np.maximum(sent_ns + int(delay), stamps)
            ends.append(np.searchsorted(recording.times, instants, side="right"))
    clipped = np.clip(np.stack(ends, axis=1), syncs[:, None] + 1, following[:, None])
    return [[int(end) for end in row] for row in clipped]
