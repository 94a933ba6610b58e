"""What arrives within one cycle → Measurement. The same for a bus and for a recorded log: no clock, no port."""

from __future__ import annotations

from collections import deque

from canprobe.bus.port import TimedFrame
from canprobe.cell.drives import DriveGroup
from canprobe.cell.measurement import Measurement
from canprobe.cell.tactile import TactileReceiver

SYNCS_REMEMBERED = 240
"""Where the SYNC has no counter."""


class Intake:
    """Routes the PDOs of one cycle to the drives and the sensor, and says what they know together.

    Args:
        drives: the arm's drives; None in a scene without an arm.
        tactile: the sensor's receiver; None in a scene without a sensor.
        sync_overflow: of the SYNC counter (1019h); so many SYNCs are remembered.
    """

    def __init__(self, drives: DriveGroup | None, tactile: TactileReceiver | None, sync_overflow: int) -> None:
        self.drives = drives
        self.tactile = tactile
        self.number = -1
        self._feedback = drives.feedback_ids if drives is not None else frozenset()
        self._taxels = frozenset(tactile.cob_ids) if tactile is not None else frozenset()
        self._sync_times: deque[int] = deque(maxlen=sync_overflow)
        self._sync_stamps: deque[int] = deque(maxlen=sync_overflow)

    def begin(self, number: int, t_ns: int, sync_ns: int) -> None:
        """A SYNC is out.

        Args:
            number: of its cycle.
            t_ns: its deadline, ns since the first one.
            sync_ns: when it went out, on the clock of the frames.
        """
        self.number = number
        self._sync_times.append(t_ns)
        self._sync_stamps.append(sync_ns)
        if self.drives is not None:
            self.drives.begin(number, sync_ns, t_ns)

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
            else:
                rest.append(frame)
        return rest

    @property
    def complete(self) -> bool:
        """No drive's TPDO of this cycle is outstanding."""
        return self.drives is None or self.drives.complete

    def end(self) -> None:
        """The collection window is over: what comes now is late."""
        if self.drives is not None:
            self.drives.end_collect()

    def measure(self, counter: int) -> Measurement:
        """The cell at this SYNC.

        Args:
            counter: of the SYNC; 0 where it has none.
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
        )
