"""The cycle: SYNC → collect TPDOs → Measurement → controller → RPDOs → observers."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, MutableSequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from canprobe.cell.master.controller import Command, Measurement
from canprobe.cell.master.watch import NodeWatch
from canprobe.cell.planning.model import HEARTBEAT_PRODUCED_MS, MASTER_NODE_ID, Plan
from canprobe.fieldbus.bus.clock import elapsed_ns
from canprobe.fieldbus.bus.port import Port, TimedFrame
from canprobe.fieldbus.protocol.frames import NmtState, SyncCounter, pack_heartbeat, pack_sync

if TYPE_CHECKING:
    from canprobe.cell.master.array import ArrayReceiver
    from canprobe.cell.master.carrier import CarrierReceiver
    from canprobe.cell.master.drives import DriveGroup

SYNCS_REMEMBERED = 240
"""Number of SYNCs that are remembered where SYNC has no counter."""


class Intake:
    """Routes the PDOs of one cycle to the drives and the array, and makes the measurement from them.

    Args:
        drives, tactile: drives of the arm, and receiver of the array; None in a scene without one.
        sync_overflow: overflow of the SYNC counter (1019h), and number of SYNCs that are remembered.
        carrier: receiver of the carrier's position; None where the object stands still.
    """

    def __init__(
        self,
        drives: DriveGroup | None,
        tactile: ArrayReceiver | None,
        sync_overflow: int,
        carrier: CarrierReceiver | None = None,
    ) -> None:
        self.drives = drives
        self.tactile = tactile
        self.carrier = carrier
        self._carrier_id = carrier.cob_id if carrier is not None else None
        self.number = -1
        self._feedback = drives.feedback_ids if drives is not None else frozenset()
        self._taxels = frozenset(tactile.cob_ids) if tactile is not None else frozenset()
        self._sync_times: deque[int] = deque(maxlen=sync_overflow)
        self._sync_stamps: deque[int] = deque(maxlen=sync_overflow)

    def begin(self, number: int, t_ns: int, sync_ns: int) -> None:
        """Begin the cycle of a SYNC that was sent.

        Args:
            number: number of its cycle.
            t_ns: deadline of the SYNC, ns since the first one.
            sync_ns: time when it was sent, on the clock of the frames.
        """
        self.number = number
        self._sync_times.append(t_ns)
        self._sync_stamps.append(sync_ns)
        if self.drives is not None:
            self.drives.begin(number, sync_ns, t_ns)
        if self.carrier is not None:
            self.carrier.begin(t_ns, sync_ns)

    def route(self, frames: list[TimedFrame]) -> list[TimedFrame]:
        """Take the PDOs among ``frames``; the others are returned."""
        rest: list[TimedFrame] = []
        feedback, taxels = self._feedback, self._taxels
        for frame in frames:
            can_id, data, t_ns = frame
            if can_id in feedback:
                self.drives.push(can_id, data, t_ns)  # type: ignore[union-attr]
            elif can_id in taxels:
                self.tactile.push(can_id, data, t_ns)  # type: ignore[union-attr]
            elif can_id == self._carrier_id:
                self.carrier.push(data, t_ns)  # type: ignore[union-attr]
            else:
                rest.append(frame)
        return rest

    @property
    def complete(self) -> bool:
        """Whether all drives, and the encoder of the carrier, have sent their TPDOs of this cycle."""
        return (self.drives is None or self.drives.complete) and (self.carrier is None or self.carrier.complete)

    def end(self) -> None:
        """End the collection: a TPDO that comes now is late."""
        if self.drives is not None:
            self.drives.end_collect()

    def measure(self, counter: int) -> Measurement:
        """The measurement of the cell at this SYNC.

        Args:
            counter: counter of the SYNC; 0 where it has none.
        """
        drives, tactile, times = self.drives, self.tactile, self._sync_times
        sample = tactile.take(self.number, counter, times, self._sync_stamps) if tactile is not None else None
        age = self.number - (tactile.newest_cycle or 0) if tactile is not None else None
        if drives is None:
            return Measurement(self.number, times[-1], enabled=True, tactile=sample, tactile_age=age)
        return Measurement(
            cycle=self.number,
            t_ns=times[-1],
            q=drives.joints() if drives.heard_all else None,
            q_age=drives.ages(),
            torque_permille=tuple(drives.torque_permille),
            statuswords=tuple(drives.statuswords),
            enabled=drives.enabled,
            tactile=sample,
            tactile_age=age,
            carrier=self.carrier.position if self.carrier is not None else None,
        )


TIMED_CYCLES = 5
"""The computing time of every fifth cycle is taken: in a virtual machine reading a clock costs as much as sending.
Images and answers, which come every 2, 4 or 16 cycles, then have their share in the sample."""


@dataclass(slots=True)
class CycleStatistics:
    """Counts and times of the cycle.

    Attributes:
        overruns: number of SYNCs that were sent more than half a period late.
        period_error_ns: delay of every SYNC behind its deadline.
        response_ns: time from the last TPDO to the RPDOs, of one cycle in `TIMED_CYCLES`.
        compute_ns: that time and the work of the controller after the RPDOs.
    """

    overruns: int = 0
    period_error_ns: MutableSequence[int] = field(default_factory=list)
    response_ns: MutableSequence[int] = field(default_factory=list)
    compute_ns: MutableSequence[int] = field(default_factory=list)

    @classmethod
    def of_last(cls, cycles: int | None) -> CycleStatistics:
        """Make statistics that keep the times of the last cycles only; None: of all."""
        if cycles is None:
            return cls()
        return cls(0, deque(maxlen=cycles), deque(maxlen=cycles), deque(maxlen=cycles))


class Cycle:
    """One cycle at a time, on absolute deadlines.

    `send_sync`, `collect` and `send_commands` are all that it does on the bus; a cycle without a bus overrides them.

    Args:
        port: the bus.
        plan: plan with the period of SYNC and the looks for TPDOs; after the last look a TPDO is late.
        drives, tactile: drives of the arm, and receiver of the array; None in a scene without one.
        watch: takes heartbeats and EMCYs.
        other: takes all other frames, such as SDO answers.
        on_arrival: whether the cycle goes on when the last TPDO arrives, in real time. Before the first look arrivals
            do not wake the process: a real bus brings one after the other, and most are in by then.
        kept: number of cycles whose times are kept; None for all.
        before: cycle of a cell that this one comes after; number, time and statistics go on from it.
        carrier: receiver of the carrier's position; None where the object stands still.

    Attributes:
        begun: a SYNC was sent, and the commands of its cycle were not.
    """

    def __init__(
        self,
        port: Port,
        plan: Plan,
        *,
        drives: DriveGroup | None,
        tactile: ArrayReceiver | None,
        watch: NodeWatch,
        other: Callable[[list[TimedFrame]], None],
        on_arrival: bool,
        kept: int | None = None,
        before: Cycle | None = None,
        carrier: CarrierReceiver | None = None,
    ) -> None:
        now_ns, period_ns = port.clock.now_ns(), plan.sync.period_ns
        self.number: int = -1 if before is None else before.number
        self.statistics: CycleStatistics = CycleStatistics.of_last(kept) if before is None else before.statistics
        self.t_first_ns: int = now_ns + period_ns if before is None else before.t_first_ns
        self.t_ns = 0
        self.sync_ns = 0
        self.late_ns = 0
        self._heartbeat_ns = 0
        self._port = port
        self._period_ns = period_ns
        self._looks_ns = plan.budget.looks_ns
        self._on_arrival = on_arrival
        self._drives, self._tactile = drives, tactile
        self._intake = Intake(drives, tactile, plan.sync.overflow or SYNCS_REMEMBERED, carrier)
        self._watch = watch
        self._other = other
        self._sync = SyncCounter(plan.sync.overflow)
        self.begun = False
        self._deadline = self.t_first_ns + ((now_ns - self.t_first_ns) // period_ns + 1) * period_ns
        self._started_ns = self._sent_ns = 0

    def begin(self) -> Measurement:
        """Sleep to the deadline, send SYNC, collect the answers."""
        self._port.clock.sleep_until_ns(self._deadline)
        counter = self._sync.next()
        self.send_sync(counter)
        self.late_ns = late_ns = self.sync_ns - self._deadline
        self.statistics.period_error_ns.append(late_ns)
        if late_ns > self._period_ns // 2:
            self.statistics.overruns += 1
            # overdue SYNCs are left out: made up for in a row, they would give the targets less than a period each
            self._deadline += late_ns // self._period_ns * self._period_ns
        self.number += 1
        self.begun = True
        self.t_ns = self._deadline - self.t_first_ns
        self._intake.begin(self.number, self.t_ns, self.sync_ns)
        self.collect()
        self._intake.end()
        self._started_ns = elapsed_ns() if self.number % TIMED_CYCLES == 0 else 0
        return self._intake.measure(counter or 0)

    def send_sync(self, counter: int | None) -> None:
        """Send SYNC, and note its time as `sync_ns`."""
        port = self._port
        if not port.stamps_arrival:  # the only way to separate frames before the SYNC from those after it
            self._route(port.drain())
        self.sync_ns = port.clock.now_ns()
        port.send_batch([pack_sync(counter)], self.sync_ns)

    def collect(self) -> None:
        """Take the TPDOs of this cycle, until all are in or they are late."""
        port, clock, intake, looks_ns = self._port, self._port.clock, self._intake, self._looks_ns
        if self._on_arrival and self._drives is not None:
            self._route(port.drain())  # nodes that go first on this processor have answered by now
            if intake.complete:
                return
            last_ns = self.sync_ns + looks_ns[-1]
            clock.sleep_until_ns(self.sync_ns + looks_ns[0])
            self._route(port.drain())
            while not intake.complete and clock.now_ns() < last_ns:  # each arrival wakes it
                port.wait(last_ns)
                self._route(port.drain())
        else:
            for look_ns in looks_ns:
                clock.sleep_until_ns(self.sync_ns + look_ns)
                self._route(port.drain())
                if intake.complete:
                    break

    def _route(self, frames: list[TimedFrame]) -> None:
        watch = self._watch
        rest = [frame for frame in self._intake.route(frames) if not watch.push(*frame)]
        if rest:
            self._other(rest)

    def skip(self) -> None:
        """Skip this cycle: wait for the end of its period."""
        self.begun = False
        self._deadline += self._period_ns
        self._port.clock.sleep_until_ns(self._deadline)

    def end(self, command: Command | None) -> None:
        """Send the commands of this cycle and set the next deadline."""
        if self._drives is not None and command is not None:
            self._drives.targets.set(command.q_target)
        self.begun = False
        self.send_commands()
        self._sent_ns = elapsed_ns() if self._started_ns else 0
        self._deadline += self._period_ns

    def send_commands(self) -> None:
        """Send the RPDOs of this cycle, and the heartbeat when it is due."""
        frames = self._drives.targets.frames() if self._drives is not None else []
        if self.sync_ns >= self._heartbeat_ns:
            self._heartbeat_ns = self._deadline + HEARTBEAT_PRODUCED_MS * 1_000_000
            frames.append(pack_heartbeat(MASTER_NODE_ID, NmtState.OPERATIONAL))
        if frames:
            self._port.send_batch(frames)
        if self._tactile is not None and (requests := self._tactile.requests(self.number)):
            self._port.send_on(self._tactile.channel, requests)

    def count_work(self) -> None:
        """Take the computing time: the work of the controller in this cycle is done."""
        if self._started_ns:
            self.statistics.response_ns.append(self._sent_ns - self._started_ns)
            self.statistics.compute_ns.append(elapsed_ns() - self._started_ns)
