"""What is recorded of a cell: frames of the planned nodes, whatever their master was, or the folder of a run.

Of the frames come the cell's measurements and the contacts in them. Of the folder come the measurements of its master,
and the scene's task is stepped through them again.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.master.array import make_tactile
from canprobe.cell.master.carrier import make_carrier
from canprobe.cell.master.controller import Measurement
from canprobe.cell.master.cycle import SYNCS_REMEMBERED, Intake
from canprobe.cell.master.drives import make_drives
from canprobe.cell.master.tactile_frame import TactileFrame, TactileSample
from canprobe.cell.planning.model import Plan
from canprobe.cell.results.run_files import LOG, TACTILE, is_recorded, needed, read_log, read_summary, read_tactile
from canprobe.cell.rows import joint_positions
from canprobe.cell.scene.setup import Setup, Touch
from canprobe.cell.tasks.from_plan import make_sensing, make_shape_tracker, make_task
from canprobe.cell.tasks.probing import LEAVING
from canprobe.cell.tasks.shape import ShapeTracker
from canprobe.cell.tasks.touch import TouchTask
from canprobe.errors import ProtocolError, UsageError
from canprobe.fieldbus.bus.clock_steps import RecordedBus
from canprobe.fieldbus.bus.port import TimedFrame, is_bus_error
from canprobe.fieldbus.protocol.cia402 import DriveState, known_state
from canprobe.fieldbus.protocol.frames import SYNC_ID, is_sync, long_syncs_text
from canprobe.fieldbus.protocol.tactile import Features, TactileHeader, TactileMode
from canprobe.mechanics.touch.stops import TOUCH_FORCE

RATE_TOLERANCE = 0.2
"""Share by which the recorded SYNC period may differ from the scene's."""
STAMP_JITTER_NS = 300_000
"""Stamps that go back by no more are jitter: the lines are in the order of the bus."""


@dataclass(slots=True)
class Recording:
    """The frames of one channel that the cell receives or sends.

    Attributes:
        bus: reader of the log, with the steps of its clock and the frames that candump lost.
        channel: channel of the nodes.
        frames: SYNC, TPDOs and RPDOs of the planned nodes, (can_id, data, t_ns).
        heard: number of TPDOs by their identifier.
        other: number of other frames on this channel.
        malformed: number of PDOs of a wrong length, left out.
        long_syncs: number of SYNCs of more than a byte by their length.
        error_frames: bus errors on all channels.
    """

    bus: RecordedBus
    channel: str
    frames: list[TimedFrame] = field(default_factory=list)
    heard: Counter[int] = field(default_factory=Counter)
    other: int = 0
    malformed: int = 0
    long_syncs: Counter[int] = field(default_factory=Counter)
    error_frames: int = 0

    @property
    def syncs(self) -> list[int]:
        """Indices of the SYNCs among the frames."""
        return [i for i, frame in enumerate(self.frames) if frame[0] == SYNC_ID]

    @property
    def sync_stamps(self) -> NDArray[np.int64]:
        """Time of each SYNC (n,), ns."""
        return np.array([t_ns for can_id, _, t_ns in self.frames if can_id == SYNC_ID], np.int64)

    @property
    def sync_overflow(self) -> int | None:
        """Value after which the SYNC counter restarts; None without a counter, or where it did not restart twice."""
        counters = [data[0] for can_id, data, _ in self.frames if can_id == SYNC_ID and data]
        last = [a for a, b in pairwise(counters) if b < a]
        return max(counters) if last and last.count(max(counters)) >= 2 else None


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
    channels = _read(bus, plan)
    recording = max(channels, key=lambda one: (one.heard.total(), len(one.frames)), default=Recording(bus, ""))
    recording.error_frames = sum(one.error_frames for one in channels)
    _check_heard(path, plan, recording)
    recording.frames = _in_bus_order(recording.frames)
    _check_syncs(path, recording, plan)
    return recording


def _read(bus: RecordedBus, plan: Plan) -> list[Recording]:
    """The frames of each channel, in their order in the log."""
    lengths: dict[int, int] = {pdo.cob_id: pdo.layout.length for pdo in plan.pdos}
    answers = {pdo.cob_id for pdo in plan.pdos if pdo.direction == "tpdo"}
    may_be_longer = {pdo.cob_id for pdo in plan.pdos if pdo.direction == "tpdo" and pdo.kind == "drive"}
    raw = {(frames.channel, frames.can_id) for frames in plan.raw}  # their formats say what is in them
    channels: dict[str, Recording] = {}
    main, *others = [bus.channel for bus in plan.buses]
    for t_ns, on, can_id, data in bus:
        if on in others and can_id == SYNC_ID:
            continue  # the cell sends one SYNC to all its buses
        name = main if on in others else on
        channel = channels.get(name)
        if channel is None:
            channel = channels[name] = Recording(bus, name)
        if is_sync(can_id, data) or (on if on in others else main, can_id) in raw:
            channel.frames.append((can_id, data, t_ns))
        elif (length := lengths.get(can_id)) is None:
            channel.other += 1
            if can_id == SYNC_ID:
                channel.long_syncs[len(data)] += 1
            channel.error_frames += is_bus_error(can_id)
        elif len(data) < length or (len(data) > length and can_id not in may_be_longer):
            channel.malformed += 1
        else:
            channel.frames.append((can_id, data, t_ns))
            channel.heard[can_id] += can_id in answers
    for name, count in bus.xl.items():
        if name in channels:
            channels[name].other += count
    return list(channels.values())


def _in_bus_order(frames: list[TimedFrame]) -> list[TimedFrame]:
    """Frames with stamps that never go back: small jitter of a logger is removed, larger jumps are sorted."""
    stamps = np.array([frame[2] for frame in frames], np.int64)
    latest = np.maximum.accumulate(stamps)
    if int((latest - stamps).max(initial=0)) > STAMP_JITTER_NS:
        return sorted(frames, key=lambda frame: frame[2])
    return [(can_id, data, t_ns) for (can_id, data, _), t_ns in zip(frames, latest.tolist(), strict=True)]


def _check_heard(path: Path, plan: Plan, channel: Recording) -> None:
    silent = []
    for node in plan.nodes:
        missing = [pdo for pdo in plan.pdos_of(node.node_id, "tpdo") if not channel.heard[pdo.cob_id]]
        if missing:
            ids = ", ".join(f"{pdo.cob_id:03X}h" for pdo in missing)
            silent.append(f"node {node.node_id} ({node.name}) was never heard: no TPDO {ids}")
    if silent:
        where = f"{path}: on {channel.channel}" if channel.channel else f"{path}: no frame at all;"
        wrong = f" ({channel.malformed} PDOs of a wrong length)" if channel.malformed else ""
        raise UsageError("\n".join(f"{where} {line}{wrong}" for line in silent))


def _check_syncs(path: Path, recording: Recording, plan: Plan) -> None:
    where, stamps = f"{path}: on {recording.channel}", recording.sync_stamps
    if len(stamps) < 2:
        longer = long_syncs_text(recording.long_syncs)
        but = f" of 0 or 1 byte, but {longer}" if longer else ""
        raise UsageError(f"{where} {len(stamps)} SYNC (080h){but}; a replay goes from SYNC to SYNC")
    steps = np.diff(stamps)
    if 3 * (twice := np.count_nonzero(steps < STAMP_JITTER_NS)) > len(steps):
        raise UsageError(
            f"{where} {twice} of {len(stamps)} SYNCs (080h) have the stamp of the one before: was every"
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
    """Iterates over the cycles of a recorded bus. One object, one pass; its counts are complete afterwards.

    The deadlines and looks of the master that sent the SYNCs are unknown: the time of a measurement is the stamp of its
    SYNC, and all frames before the next SYNC belong to its cycle.

    Args:
        plan: plan of the cell.
        path: the log.

    Attributes:
        recording: frames of the log.
        start_ns: stamp of the first SYNC; a measurement's time counts from there.
        sync_times_s: time of each SYNC, from there.
        lost_syncs: SYNCs that are missing in the log.

    Raises:
        UsageError: as `read_recording`, and for an external arm, whose poses are not in a log.
    """

    def __init__(self, plan: Plan, path: Path) -> None:
        self.recording = recording = read_recording(path, plan)
        if plan.setup.arm is not None and plan.setup.arm.external is not None:
            raise UsageError(f"{plan.setup.name}: the poses of an external arm are not in a log of the bus")
        overflow = recording.sync_overflow or plan.sync.overflow or SYNCS_REMEMBERED
        self.drives = make_drives(plan)
        self.tactile = make_tactile(plan, overflow)
        carrier = make_carrier(plan)
        self.sync_times_s: list[float] = []
        self.lost_syncs = 0
        self.start_ns = int(recording.sync_stamps[0])
        self._intake = Intake(self.drives, self.tactile, overflow, carrier)
        self._overflow = overflow
        self._period_ns = plan.sync.period_ns

    def __iter__(self) -> Iterator[Measurement]:
        intake, frames, syncs = self._intake, self.recording.frames, self.recording.syncs
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
            if self.drives is not None and not measurement.enabled:  # another mapping, or a faulty drive
                for axis, word in zip(self.drives.axes, self.drives.statuswords, strict=True):
                    if known_state(word) is None:
                        raise ProtocolError(f"node {axis.node_id}: statusword {word:#06x} is no CiA 402 state")
            yield measurement

    def _begin(self, stamp_ns: int) -> None:
        t_ns = stamp_ns - self.start_ns
        self._intake.begin(self._intake.number + 1, t_ns, stamp_ns)
        self.sync_times_s.append(t_ns * 1e-9)

    def _lost(self, before: int, counter: int) -> int:
        """Number of SYNCs missing in the log between two counters; they get a number and a time too."""
        lost = (counter - before - 1) % self._overflow if before and counter else 0
        return lost if lost <= MAX_LOST_SYNCS else 0


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


@dataclass(frozen=True, slots=True)
class RunFolder:
    """The measurements in the folder of a run.

    Attributes:
        path: the folder.
        log, tactile: the columns of ``log.npz`` and ``tactile.npz``.
    """

    path: Path
    log: Mapping[str, NDArray[Any]]
    tactile: Mapping[str, NDArray[Any]]

    @property
    def start_s(self) -> float:
        """Time of the first cycle, s, on the run's clock."""
        return float(self.log["t_s"][0])

    @property
    def times_ns(self) -> NDArray[np.int64]:
        """Time of each cycle (n,), ns, since the first."""
        return self._ns(self.log["t_s"])

    @property
    def times_s(self) -> NDArray[np.float64]:
        """Time of each cycle (n,), s, since the first; equal to the times of the run's estimates to the last bit."""
        return self.times_ns.astype(np.float64) * 1e-9

    def measurements(self) -> Iterator[Measurement]:
        """The measurement of each cycle in the cell; times count from the first cycle."""
        log, samples = self.log, self._samples()
        rows = len(log["t_s"])
        joints = joint_positions(log)
        if joints is None:
            joints = np.full((rows, 1), np.nan)
        ages, words = (
            np.nan_to_num(log.get(name, np.zeros((rows, 0)))).astype(int) for name in ("q_age", "statusword")
        )
        torques = log.get("torque_permille", np.zeros((rows, 0)))
        tactile_ages = log.get("tactile_age", np.full(rows, np.nan))
        carried = log.get("carrier_rad", log.get("carrier_m", np.full(rows, np.nan))).tolist()
        for k, t_ns in enumerate(self.times_ns.tolist()):
            statuswords = tuple(words[k].tolist())
            yield Measurement(
                cycle=k,
                t_ns=t_ns,
                q=joints[k].copy() if np.isfinite(joints[k]).all() else None,
                q_age=tuple(ages[k].tolist()),
                torque_permille=tuple(torques[k].tolist()),
                statuswords=statuswords,
                enabled=all(known_state(word) is DriveState.OPERATION_ENABLED for word in statuswords),
                tactile=samples.get(t_ns),
                tactile_age=int(tactile_ages[k]) if np.isfinite(tactile_ages[k]) else None,
                carrier=carried[k] if np.isfinite(carried[k]) else None,
            )

    def _samples(self) -> dict[int, TactileSample]:
        """The tactile samples by the time of the cycle in which they were usable."""
        columns = self.tactile
        if not columns:
            return {}
        used, sampled = self._ns(columns["t_s"]).tolist(), self._ns(columns["t_sample_s"]).tolist()
        sigmas = columns["t_sigma_s"].tolist()
        triggers = np.searchsorted(self.times_ns, sampled).tolist()
        rows = zip(columns["taxels"], columns["window"].tolist(), columns["features"].tolist(), strict=True)
        return {
            used[i]: TactileSample(_frame(taxels, tuple(window), features), sampled[i], triggers[i], sigmas[i])
            for i, (taxels, window, features) in enumerate(rows)
        }

    def _ns(self, times_s: NDArray[np.float64]) -> NDArray[np.int64]:
        return np.round((times_s - self.start_s) * 1e9).astype(np.int64)


def _frame(taxels: NDArray[np.uint8], window: tuple[int, int, int, int], features: list[float]) -> TactileFrame:
    """A tactile frame that the cell used; its header has only what the file states."""
    sent = None
    if np.isfinite(features).all():
        force, row, col, rr, rc, cc, peak = features
        sent = Features(force, row, col, rr, rc, cc, int(peak))
    whole = TactileMode.IMAGE if window[2] == len(taxels) else TactileMode.WINDOW
    mode = whole if sent is None else TactileMode.FEATURES
    header = TactileHeader(0, 0, window[0], window[1], mode, False, 0, window=window[2])
    return TactileFrame(header, taxels, window, sent, 0)


def read_run(folder: Path, setup: Setup) -> RunFolder | None:
    """The measurements of a run; None where the folder has none.

    Args:
        folder: folder of the run.
        setup: setup of its scene.

    Raises:
        UsageError: when a file is of another version of canprobe, or cannot be read.
    """
    read_summary(folder)
    log, tactile = folder / LOG, folder / TACTILE
    if not is_recorded(log) or not is_recorded(tactile):
        return None
    columns, images = read_log(log, setup), read_tactile(tactile, setup)
    needed(columns, ("q_age", *(("q_rad",) if joint_positions(columns) is None else ())), log)
    if not len(columns["t_s"]):
        raise UsageError(f"{log}: expected a row for each cycle, got none: the run was stopped before its first")
    return RunFolder(folder, columns, images)


def replay_task(plan: Plan, run: RunFolder) -> TouchTask | None:
    """Step the scene's task through the measurements of a run, as the cell did.

    Returns:
        The task at its end; None where the phases of the run differ: it had another scene or controller, or got
        requests from another tool.
    """
    task = make_task(plan)
    assert isinstance(task, TouchTask)
    phases = run.log.get("phase", np.full(len(run.log["t_s"]), np.nan)).tolist()
    if not np.isfinite(phases).any():
        return None
    for measurement, phase in zip(run.measurements(), phases, strict=True):
        if not np.isfinite(phase):  # the cell enabled, held, lifted off or stopped: it did not step its controller
            continue
        task.step(measurement)
        if phase in LEAVING and task.phase not in LEAVING:  # the cell asked it to let go
            return task
        if phase != task.phase:
            return None
        task.update()
    return task
