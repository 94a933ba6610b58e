"""A recorded bus: the frames of the planned nodes, the measurements of their cell, and the contacts in them.

The cell may have had any master.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.master.array import make_tactile
from canprobe.cell.master.controller import Measurement
from canprobe.cell.master.cycle import SYNCS_REMEMBERED, Intake
from canprobe.cell.master.drives import DriveGroup, make_drives
from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.setup import Touch
from canprobe.cell.tasks.from_plan import make_sensing, make_shape_tracker
from canprobe.cell.tasks.shape import ShapeTracker
from canprobe.errors import ProtocolError, UsageError
from canprobe.fieldbus.bus.clock_steps import RecordedBus
from canprobe.fieldbus.bus.port import TimedFrame, is_bus_error
from canprobe.fieldbus.protocol.cia402 import known_state
from canprobe.fieldbus.protocol.frames import SYNC_ID, is_sync, long_syncs_text
from canprobe.mechanics.touch.stops import TOUCH_FORCE

RATE_TOLERANCE = 0.2
"""Share by which the recorded SYNC period may differ from the scene's."""
STAMP_JITTER_NS = 300_000
"""Stamps that go back by no more are jitter: the lines are in the order of the bus."""


@dataclass(frozen=True, slots=True)
class Recording:
    """The frames of one channel that the cell receives or sends.

    Attributes:
        path: path of the log.
        channel: channel of the nodes.
        frames: SYNC, TPDOs and RPDOs of the planned nodes, (can_id, data, t_ns).
        times: their stamps (n,), ns.
        syncs: indices of the SYNCs among them.
        other: number of other frames on this channel.
        malformed: number of PDOs of a wrong length, left out.
        error_frames: bus errors on all channels.
        bus: reader of the log, with the steps of its clock and the frames that candump lost.
    """

    path: Path
    channel: str
    frames: list[TimedFrame]
    times: NDArray[np.int64]
    syncs: NDArray[np.int64]
    other: int
    malformed: int
    error_frames: int
    bus: RecordedBus

    @property
    def sync_stamps(self) -> NDArray[np.int64]:
        """Time of each SYNC (n,), ns."""
        return self.times[self.syncs]

    @property
    def sync_overflow(self) -> int | None:
        """Value after which the SYNC counter restarts; None without a counter, or where it did not restart twice."""
        counters = [data[0] for _, data, _ in map(self.frames.__getitem__, self.syncs) if data]
        last = [a for a, b in pairwise(counters) if b < a]
        return max(counters) if last and last.count(max(counters)) >= 2 else None


@dataclass(slots=True)
class _RecordedChannel:
    """Frames and counts of one channel so far."""

    frames: list[TimedFrame] = field(default_factory=list)
    heard: set[int] = field(default_factory=set)
    answers: int = 0
    other: int = 0
    malformed: int = 0
    long_syncs: Counter[int] = field(default_factory=Counter)


def read_recording(path: Path, plan: Plan) -> Recording:
    """Read the frames of a plan's nodes from a log, sorted into the order of the bus.

    Args:
        path: the log; it may hold other nodes, other channels and error frames. The buses of a plan with several of
            them have the plan's names in the log, and are read as one.
        plan: plan with the identifiers and lengths.

    Raises:
        UsageError: when there is no such file, a line is torn, a node sent no TPDO, or SYNCs are missing or of another
            rate.
    """
    bus = RecordedBus(path)
    channels, error_frames = _read(bus, plan)
    name = max(channels, key=lambda c: (channels[c].answers, len(channels[c].frames)), default="")
    chosen = channels.get(name, _RecordedChannel())
    _check_heard(path, plan, name, chosen)
    frames = _in_bus_order(chosen.frames)
    syncs = [i for i, frame in enumerate(frames) if frame[0] == SYNC_ID]
    times = np.array([frame[2] for frame in frames], np.int64)
    recording = Recording(
        path, name, frames, times, np.array(syncs, np.int64), chosen.other, chosen.malformed, error_frames, bus
    )
    _check_syncs(recording, plan, chosen.long_syncs)
    return recording


def _read(bus: RecordedBus, plan: Plan) -> tuple[dict[str, _RecordedChannel], int]:
    lengths: dict[int, int] = {pdo.cob_id: pdo.layout.length for pdo in plan.pdos}
    answers = {pdo.cob_id for pdo in plan.pdos if pdo.direction == "tpdo"}
    may_be_longer = {pdo.cob_id for pdo in plan.pdos if pdo.direction == "tpdo" and pdo.kind == "drive"}
    raw = {(frames.channel, frames.can_id) for frames in plan.raw}  # their formats say what is in them
    channels: dict[str, _RecordedChannel] = {}
    error_frames = 0
    main, *others = [bus.channel for bus in plan.buses]
    for t_ns, on, can_id, data in bus:
        if on in others and can_id == SYNC_ID:
            continue  # the cell sends one SYNC to all its buses
        name = main if on in others else on
        channel = channels.get(name)
        if channel is None:
            channel = channels[name] = _RecordedChannel()
        if is_sync(can_id, data) or (on if on in others else main, can_id) in raw:
            channel.frames.append((can_id, data, t_ns))
        elif (length := lengths.get(can_id)) is None:
            channel.other += 1
            if can_id == SYNC_ID:
                channel.long_syncs[len(data)] += 1
            error_frames += is_bus_error(can_id)
        elif len(data) < length or (len(data) > length and can_id not in may_be_longer):
            channel.malformed += 1
        else:
            channel.frames.append((can_id, data, t_ns))
            if can_id in answers:
                channel.heard.add(can_id)
                channel.answers += 1
    for name, count in bus.xl.items():
        if name in channels:
            channels[name].other += count
    return channels, error_frames


def _in_bus_order(frames: list[TimedFrame]) -> list[TimedFrame]:
    """Frames with stamps that never go back: small jitter of a logger is removed, larger jumps are sorted."""
    stamps = np.array([frame[2] for frame in frames], np.int64)
    latest = np.maximum.accumulate(stamps)
    if int((latest - stamps).max(initial=0)) > STAMP_JITTER_NS:
        return sorted(frames, key=lambda frame: frame[2])
    return [(can_id, data, t_ns) for (can_id, data, _), t_ns in zip(frames, latest.tolist(), strict=True)]


def _check_heard(path: Path, plan: Plan, name: str, channel: _RecordedChannel) -> None:
    silent = []
    for node in plan.nodes:
        missing = [pdo for pdo in plan.pdos_of(node.node_id, "tpdo") if pdo.cob_id not in channel.heard]
        if missing:
            ids = ", ".join(f"{pdo.cob_id:03X}h" for pdo in missing)
            silent.append(f"node {node.node_id} ({node.role}) was never heard: no TPDO {ids}")
    if silent:
        where = f"{path}: on {name}" if name else f"{path}: no frame at all;"
        wrong = f" ({channel.malformed} PDOs of a wrong length)" if channel.malformed else ""
        raise UsageError("\n".join(f"{where} {line}{wrong}" for line in silent))


def _check_syncs(recording: Recording, plan: Plan, long_syncs: Counter[int]) -> None:
    where = f"{recording.path}: on {recording.channel}"
    if len(recording.syncs) < 2:
        longer = long_syncs_text(long_syncs)
        but = f" of 0 or 1 byte, but {longer}" if longer else ""
        raise UsageError(f"{where} {len(recording.syncs)} SYNC (080h){but}; a replay goes from SYNC to SYNC")
    steps = np.diff(recording.sync_stamps)
    if 3 * (twice := np.count_nonzero(steps < STAMP_JITTER_NS)) > len(steps):
        raise UsageError(
            f"{where} {twice} of {len(recording.syncs)} SYNCs (080h) have the stamp of the one before: was every"
            " frame logged twice?"
        )
    period = float(np.median(steps))
    if abs(period - plan.sync.period_ns) > RATE_TOLERANCE * plan.sync.period_ns:
        raise UsageError(
            f"{where} a SYNC every {period * 1e-6:.3f} ms, but scene {plan.setup.name} has one every"
            f" {plan.sync.period_ns * 1e-6:.3f} ms; set cycle.rate_hz"
        )


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
