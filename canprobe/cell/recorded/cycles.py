"""A recorded bus → the measurements of its cell, and the contacts in them, for a cell with any master."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from canprobe.cell.master.array import make_tactile
from canprobe.cell.master.controller import Measurement
from canprobe.cell.master.cycle import SYNCS_REMEMBERED, Intake
from canprobe.cell.master.drives import DriveGroup, make_drives
from canprobe.cell.planning.model import Plan
from canprobe.cell.recorded.recording import Recording
from canprobe.cell.scene.setup import Touch
from canprobe.cell.tasks.from_plan import make_sensing, make_shape_tracker
from canprobe.cell.tasks.shape import ShapeTracker
from canprobe.errors import ProtocolError
from canprobe.fieldbus.protocol.cia402 import known_state
from canprobe.mechanics.touch.stops import TOUCH_FORCE

MAX_LOST_SYNCS = 5
"""A SYNC counter that jumps by more was restarted."""


class LogCycles:
    """Iterates over the cycles of a recording. One object, one pass; its counts are complete afterwards.

    The deadlines and looks of the master that sent the SYNCs are unknown: the time of a measurement is the stamp of its
    SYNC, and all frames before the next SYNC belong to its cycle.

    Args:
        plan: plan of the cell.
        recording: frames of the log.

    Attributes:
        start_ns: stamp of the first SYNC; a measurement's time counts from there.
        sync_times_s: time of each SYNC, from there.
        lost_syncs: SYNCs that are missing in the log.
    """

    def __init__(self, plan: Plan, recording: Recording) -> None:
        overflow = recording.sync_overflow or plan.sync.overflow or SYNCS_REMEMBERED
        self.drives = make_drives(plan)
        self.tactile = make_tactile(plan, overflow)
        self.sync_times_s: list[float] = []
        self.lost_syncs = 0
        self.start_ns = int(recording.sync_stamps[0])
        self._intake = Intake(self.drives, self.tactile, overflow)
        self._recording = recording
        self._overflow = overflow
        self._period_ns = plan.sync.period_ns

    def __iter__(self) -> Iterator[Measurement]:
        recording, intake = self._recording, self._intake
        frames, syncs = recording.frames, recording.syncs.tolist()
        intake.route(frames[: syncs[0]])
        counter_before = 0
        for first, end in zip(syncs, [*syncs[1:], len(frames)], strict=True):
            _, data, stamp_ns = frames[first]
            counter = data[0] if data else 0
            for ago in range(self._lost(counter_before, counter), 0, -1):
                self.lost_syncs += 1
                self._begin(stamp_ns - ago * self._period_ns)
            self._begin(stamp_ns)
            counter_before = counter
            intake.route(frames[first + 1 : end])
            intake.end()
            measurement = intake.measure(counter)
            if self.drives is not None and not measurement.enabled:
                _check_states(self.drives)
            yield measurement

    def _begin(self, stamp_ns: int) -> None:
        t_ns = stamp_ns - self.start_ns
        self._intake.begin(self._intake.number + 1, t_ns, stamp_ns)
        self.sync_times_s.append(t_ns * 1e-9)

    def _lost(self, before: int, counter: int) -> int:
        """Number of SYNCs missing in the log between two counters; they get a number and a time too."""
        lost = (counter - before - 1) % self._overflow if before and counter else 0
        return lost if lost <= MAX_LOST_SYNCS else 0


def _check_states(drives: DriveGroup) -> None:
    """Refuse a statusword without a state, which comes from another mapping or a faulty drive."""
    for axis, word in zip(drives.axes, drives.statuswords, strict=True):
        if known_state(word) is None:
            raise ProtocolError(f"node {axis.node_id}: statusword {word:#06x} is no CiA 402 state")


def replay_contacts(plan: Plan, measurements: Iterable[Measurement]) -> tuple[ShapeTracker, int]:
    """Feed every contact, force above the touch threshold, to the scene's estimator.

    Returns:
        The tracker, and the number of contacts without a place, because the joints of their instant are missing.
    """
    assert isinstance(plan.setup.task, Touch)
    sensing = make_sensing(plan.setup.task)
    tracker = make_shape_tracker(plan.setup)
    assert tracker is not None
    for measurement in measurements:
        patch = sensing.step(measurement)
        if patch is None or measurement.tactile is None or patch.force <= TOUCH_FORCE:
            continue
        contact = sensing.contact(measurement.tactile, patch)
        if contact is None:
            continue
        tracker.add(contact)
        estimate = tracker.answer_at_once(measurement.t_ns * 1e-9)
        if estimate is not None and bool(np.all(estimate.observed)):
            sensing.set_kappa(np.asarray(estimate.kappa), estimate.stiffness)
    return tracker, sensing.dropped
