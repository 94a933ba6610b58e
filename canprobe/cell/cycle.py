"""The cycle: SYNC → collect TPDOs → Measurement → controller → RPDOs. It knows a port and a clock, nothing else."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, MutableSequence
from dataclasses import dataclass, field

from canprobe.bus.clock import elapsed_ns
from canprobe.bus.port import Port, TimedFrame
from canprobe.cell.drives import DriveGroup
from canprobe.cell.intake import SYNCS_REMEMBERED, Intake
from canprobe.cell.measurement import Command, Measurement
from canprobe.cell.tactile import TactileReceiver
from canprobe.cell.watch import NodeWatch
from canprobe.protocol.frames import NmtState, pack_heartbeat
from canprobe.protocol.sync import SyncCounter, pack_sync

TIMED_CYCLES = 5
"""The computing time of every fifth cycle is taken: in a virtual machine reading a clock costs as much as sending. What
comes back every 2, 4 or 16 cycles, as images and answers do, then has its share in the sample."""


@dataclass(frozen=True, slots=True)
class CycleSettings:
    """Times of the cycle.

    Attributes:
        period_ns: from SYNC to SYNC.
        sync_overflow: of the SYNC counter (1019h).
        heartbeat_ns: between two heartbeats of the master, however late its cycles are.
        master_id: node id of the master's heartbeat.
        looks_ns: times after SYNC went out at which TPDOs are looked for, until all are in; then they are late.
        on_arrival: on a clock that goes on by itself: do not wait for the next look once all are in. Before the first
            look nobody is woken by them: a real bus brings one after the other, and most are in by then.
    """

    period_ns: int
    sync_overflow: int
    heartbeat_ns: int
    master_id: int
    looks_ns: tuple[int, ...]
    on_arrival: bool


@dataclass(slots=True)
class CycleStatistics:
    """What the cycle counted and timed.

    Attributes:
        overruns: SYNCs that went out more than half a period late.
        period_error_ns: of every SYNC behind its deadline.
        response_ns: from the last TPDO in to the RPDOs out, of every cycle of `TIMED_CYCLES`.
        compute_ns: the same with what the controller does once the RPDOs are out.
    """

    overruns: int = 0
    period_error_ns: MutableSequence[int] = field(default_factory=list)
    response_ns: MutableSequence[int] = field(default_factory=list)
    compute_ns: MutableSequence[int] = field(default_factory=list)

    @classmethod
    def of_last(cls, cycles: int | None) -> CycleStatistics:
        """With the times of the last cycles only; None for all."""
        if cycles is None:
            return cls()
        return cls(0, deque(maxlen=cycles), deque(maxlen=cycles), deque(maxlen=cycles))


class Cycle:
    """One cycle at a time, on absolute deadlines.

    Args:
        port: the bus.
        settings: times.
        drives: the arm's drives; None in a scene without an arm.
        tactile: the sensor's receiver; None in a scene without a sensor.
        watch: sees heartbeats and EMCYs.
        other: takes what nobody here expects (SDO answers).
        kept: cycles whose times are kept; None for all.
    """

    def __init__(
        self,
        port: Port,
        settings: CycleSettings,
        *,
        drives: DriveGroup | None,
        tactile: TactileReceiver | None,
        watch: NodeWatch,
        other: Callable[[list[TimedFrame]], None],
        kept: int | None = None,
    ) -> None:
        self.number = -1
        self.statistics = CycleStatistics.of_last(kept)
        self.t_first_ns = port.clock.now_ns() + settings.period_ns
        self.t_ns = 0
        self.sync_ns = 0
        self._heartbeat_ns = 0
        self._port = port
        self._s = settings
        self._drives = drives
        self._intake = Intake(drives, tactile, settings.sync_overflow or SYNCS_REMEMBERED)
        self._watch = watch
        self._other = other
        self._sync = SyncCounter(settings.sync_overflow)
        self._deadline = self.t_first_ns
        self._started_ns = self._sent_ns = 0

    def begin(self) -> Measurement:
        """Sleep to the deadline, send SYNC, collect the answers."""
        port = self._port
        port.clock.sleep_until_ns(self._deadline)
        if not port.stamps_arrival:  # the only way to tell what came before the SYNC from what came after it
            self._route(port.drain())
        counter = self._sync.next()
        self.sync_ns = port.clock.now_ns()
        port.send_batch([pack_sync(counter)], self.sync_ns)
        self._count_lateness()
        self.number += 1
        self.t_ns = self._deadline - self.t_first_ns
        self._intake.begin(self.number, self.t_ns, self.sync_ns)
        self._collect()
        self._started_ns = elapsed_ns() if self.number % TIMED_CYCLES == 0 else 0
        return self._intake.measure(counter or 0)

    def _count_lateness(self) -> None:
        error = self.sync_ns - self._deadline
        self.statistics.period_error_ns.append(error)
        if error > self._s.period_ns // 2:
            self.statistics.overruns += 1
            self._deadline += error // self._s.period_ns * self._s.period_ns

    def _collect(self) -> None:
        port, clock, intake, looks_ns = self._port, self._port.clock, self._intake, self._s.looks_ns
        if self._s.on_arrival and self._drives is not None:
            self._route(port.drain())  # nodes that go first on this processor have answered by now
            if not intake.complete:
                self._collect_on_arrival(self.sync_ns + looks_ns[0], self.sync_ns + looks_ns[-1])
        else:
            for look_ns in looks_ns:
                clock.sleep_until_ns(self.sync_ns + look_ns)
                self._route(port.drain())
                if intake.complete:
                    break
        intake.end()

    def _collect_on_arrival(self, first_ns: int, last_ns: int) -> None:
        """Look at a time, then whenever something comes, until all TPDOs are in or another time is over."""
        port, clock, intake = self._port, self._port.clock, self._intake
        clock.sleep_until_ns(first_ns)
        self._route(port.drain())
        while not intake.complete and clock.now_ns() < last_ns:
            port.wait(last_ns)
            self._route(port.drain())

    def _route(self, frames: list[TimedFrame]) -> None:
        watch = self._watch
        rest = [frame for frame in self._intake.route(frames) if not watch.push(*frame)]
        if rest:
            self._other(rest)

    def skip(self) -> None:
        """Let this cycle be: wait for the end of its period."""
        self._deadline += self._s.period_ns
        self._port.clock.sleep_until_ns(self._deadline)

    def end(self, command: Command | None) -> None:
        """Send the commands of this cycle and set the next deadline."""
        frames = []
        if self._drives is not None:
            if command is not None:
                self._drives.set_target(command.q_target)
            frames = self._drives.frames()
        if self.sync_ns >= self._heartbeat_ns:
            self._heartbeat_ns = self._deadline + self._s.heartbeat_ns
            frames.append(pack_heartbeat(self._s.master_id, NmtState.OPERATIONAL))
        if frames:
            self._port.send_batch(frames)
        self._sent_ns = elapsed_ns() if self._started_ns else 0
        self._deadline += self._s.period_ns

    def count_work(self) -> None:
        """The controller has done all that it does in this cycle."""
        if self._started_ns:
            self.statistics.response_ns.append(self._sent_ns - self._started_ns)
            self.statistics.compute_ns.append(elapsed_ns() - self._started_ns)
