"""A recorded bus → the cycles that a cell makes of it, the scene's task stepped through them, and contacts."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.array import make_tactile
from canprobe.cell.controller import Measurement
from canprobe.cell.cycle import SYNCS_REMEMBERED, Intake
from canprobe.cell.drives import CONTROLWORD, TARGET, CommandFrame, DriveGroup, command_frames, make_drives, rest_counts
from canprobe.cell.lift_off import WayBack
from canprobe.cell.supervision import HOLD_CYCLES, TOUCH_FORCE
from canprobe.errors import ProtocolError
from canprobe.planning.model import Plan
from canprobe.protocol.cia402 import known_state
from canprobe.protocol.frame_bits import INTERMISSION_BITS, exact_bits
from canprobe.recorded.recording import STAMP_JITTER_NS, Recording, find_deadlines
from canprobe.robot.model import ArmModel, joints_to_units
from canprobe.scene.setup import Touch
from canprobe.tasks.from_plan import make_sensing, make_shape_tracker, make_task
from canprobe.tasks.shape import ShapeTracker
from canprobe.tasks.touch import TouchTask

DRIFT_BLOCK = 400
"""SYNCs over which another logger's clock drifts by a small share of a period only."""
MOST_LOST = 5
"""A SYNC counter that jumps by more was restarted."""
ENABLE_OPERATION = 0x000F


@dataclass(frozen=True, slots=True)
class LogCycle:
    """One cycle of a log.

    Attributes:
        measurement: of the cell.
        targets: last target positions sent to the drives, counts; None before every drive has one.
        enabled_by_master: the last controlword of every drive, where there is one, enables operation.
    """

    measurement: Measurement
    targets: tuple[int, ...] | None
    enabled_by_master: bool


class LogCycles:
    """Iterates over the cycles of a recording. One object, one pass; its counts are complete afterwards.

    With ``as_taken`` the order of the lines decides which frames a cycle received, as in a log that a cell on a real
    bus wrote: a frame is written when it is received, so the frames between a SYNC and the RPDOs behind it belong to
    that cycle. Otherwise the stamps decide: the cell is assumed to have read its bus exactly at its looks, until every
    TPDO was in. That is exact in lockstep. On a real bus it is an estimate: a cell wakes up late, and a frame that
    comes in between counts one cycle later, or as late.

    Args:
        plan: of the cell.
        recording: the log, in the order that ``as_taken`` wants.
        as_taken: see above.
        on_deadlines: a measurement's time is its cycle's deadline, as in a cell. False for another master, whose
            deadlines and looks are unknown: it is the stamp of its SYNC, and all frames before the next SYNC belong to
            the cycle.
        drifts: the stamps are another clock's than the master's.

    Attributes:
        start_ns: deadline of the first cycle on the clock of the log; a measurement's time counts from there.
        sync_times_s: time of each SYNC, from there.
        lost_syncs: SYNCs that are missing in the log.
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
        waited = (plan.traffic.budget.sync_ns or 0) + STAMP_JITTER_NS  # for the bus, by its stamp
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
            for can_id, data, _ in frames[first:last]:
                if (frame := self._commands.get(can_id)) is not None:
                    self._take_command(frame, data)
            targets = self._known_targets()
            if self.drives is not None and targets is not None:
                self.drives.aim(targets)
            enabled = all(word & ENABLE_OPERATION == ENABLE_OPERATION for word in self._words.values())
            yield LogCycle(measurement, targets, enabled)

    def _begin(self, t_ns: int, stamp_ns: int) -> None:
        self._intake.begin(self._intake.number + 1, t_ns, stamp_ns)
        self.sync_times_s.append(t_ns * 1e-9)

    def _lost(self, before: int, counter: int) -> int:
        """How many SYNCs are missing in the log between two counters; they have a number and a time too."""
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

    def _take_command(self, frame: CommandFrame, data: bytes) -> None:
        for axis, layout, picks in frame.parts:
            for value, pick in zip(layout.unpack(data), picks, strict=True):
                if pick == TARGET:
                    self._targets[axis] = value
                elif pick == CONTROLWORD:
                    self._words[axis] = value

    def _known_targets(self) -> tuple[int, ...] | None:
        known = tuple(target for target in self._targets if target is not None)
        return known if known and len(known) == len(self._targets) else None


def _check_states(drives: DriveGroup) -> None:
    """A statusword without a state comes from another mapping, or from a faulty drive."""
    for axis, word in zip(drives.axes, drives.statuswords, strict=True):
        if known_state(word) is None:
            raise ProtocolError(f"node {axis.node_id}: statusword {word:#06x} is no CiA 402 state")


def _wire_times(plan: Plan, recording: Recording) -> NDArray[np.int64]:
    """From each SYNC's deadline to its stamp (n,), ns: a lockstep log with a bit rate stamps the ends of frames."""
    bus = plan.setup.bus
    if bus.interface != "lockstep" or not bus.timed or bus.fd is True:
        return np.zeros(len(recording.syncs), np.int64)
    syncs = (recording.frames[i] for i in recording.syncs.tolist())
    bits = np.array([exact_bits(can_id, data) - INTERMISSION_BITS for can_id, data, _ in syncs])
    return bits * 1_000_000_000 // bus.bitrate


def _looks(recording: Recording, sent_ns: NDArray[np.int64], delays_ns: Sequence[float]) -> list[list[int]]:
    """Index of the frame at which each look of each cycle ends; the delays count from the sending of its SYNC."""
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


# The lift-off at the end of a log: its cause need not be on the bus, so its targets identify it.

Vector = NDArray[np.float64]
TARGET_TOLERANCE = 1
"""Counts that a replayed target may differ from the recorded one by rounding."""
SHORTEST = 8
"""Cycles that distinguish a lift-off from a task: by then it has moved most of a millimetre."""
UNTOLD = 2
"""Cycles after a lift-off without new targets: its last one, and the first of the stop."""


class LoggedWayBack:
    """Finds the lift-off among the last cycles of a controller, and its targets.

    Args:
        plan: of the cell.

    Attributes:
        steps: its cycles with their joint targets (n,), rad or m; empty without a lift-off.
    """

    def __init__(self, plan: Plan) -> None:
        arm = plan.setup.arm
        assert arm is not None
        self.steps: list[tuple[LogCycle, Vector]] = []
        self._model = arm.model
        self._flange_probe = plan.setup.probe.T_flange_probe
        self._period_s = plan.sync.period_ns * 1e-9

    def cycles_before(self, cycles: Iterable[LogCycle]) -> Iterator[LogCycle]:
        """The cycles of the controller; those of a lift-off at their end are `steps` afterwards."""
        last: deque[LogCycle] = deque()
        for cycle in cycles:
            last.append(cycle)
            if len(last) > WayBack.cycles(self._period_s) + 1:
                yield last.popleft()
        rest = list(last)
        for first in range(1, len(rest) - SHORTEST + 1):
            steps = self._steps_from(rest[first - 1], rest[first:])
            if steps is not None:
                self.steps, rest = steps, rest[:first]
                break
        yield from rest

    def _steps_from(self, before: LogCycle, cycles: list[LogCycle]) -> list[tuple[LogCycle, Vector]] | None:
        """The targets of a lift-off in these cycles; None where the recorded ones differ."""
        if before.targets is None:
            return None
        targets, free = np.array(before.targets, dtype=float), np.ones(len(before.targets), dtype=bool)
        way = WayBack(self._model, self._flange_probe, self._period_s, free, targets)
        steps: list[tuple[LogCycle, Vector]] = []
        for i, cycle in enumerate(cycles):
            q = way.step(cycle.measurement.q) if cycle.measurement.q is not None else None
            if q is None or cycle.targets is None or worst_count(self._model, q, cycle.targets) > TARGET_TOLERANCE:
                ended = len(cycles) - i <= UNTOLD and all(c.targets == cycles[i - 1].targets for c in cycles[i:])
                return steps if ended and i >= SHORTEST else None
            steps.append((cycle, q))
        return steps


def worst_count(model: ArmModel, q: Vector, targets: tuple[int, ...]) -> int:
    """Largest difference of joint positions (n,), rad or m, and recorded motor targets, counts."""
    return int(_count_differences(model, q, targets).max())


def _count_differences(model: ArmModel, q: Vector, targets: tuple[int, ...]) -> Vector:
    return np.abs(np.round(joints_to_units(model, q)) - targets)


# The contacts of the run: by the scene's task, or from the images alone.

OWN_RESTS = 2.5
"""Median difference, in `rest_counts`, up to which the task drove: 0.5 mm or 0.2 deg. A lost line changes some."""
PARTED_RESTS = 12.5
"""Difference, in `rest_counts`, from which the recorded targets are not the task's: 2 mm or 1 deg."""
PARTED_S = 0.1
"""Time at that difference after which they stay apart: the servo corrects the effect of a lost line sooner."""


@dataclass(frozen=True, slots=True)
class TaskReplay:
    """The scene's task on the recorded measurements, and its targets beside the recorded ones.

    Attributes:
        task: the task, at its end.
        compared: number of cycles with recorded targets and the task's.
        differing: of these, with a difference of more than ``TARGET_TOLERANCE``.
        median_rests: the median of the differences, in `rest_counts`.
        worst_counts: the largest difference.
        lifted_s: when the cell began to lift off, which ended the task's replay (s); else None.
        parted_s: when the recorded targets had departed from the task's, which ended its replay (s); else None.
    """

    task: TouchTask
    compared: int
    differing: int
    median_rests: float
    worst_counts: int
    lifted_s: float | None
    parted_s: float | None

    @property
    def drove(self) -> bool:
        """Most recorded targets, to the end, are those of this task, and its scan had a contact."""
        came_to_scan = self.task.shape is not None and bool(self.task.shape.samples)
        return came_to_scan and self.parted_s is None and self.median_rests <= OWN_RESTS


def controller_cycles(cycles: Iterable[LogCycle]) -> Iterator[LogCycle]:
    """The cycles in which a cell steps its controller: while all drives are, and shall be, in operation enabled."""
    started = False
    for cycle in cycles:
        if not started:
            started = cycle.measurement.q is not None and cycle.measurement.enabled
        elif cycle.measurement.enabled and cycle.enabled_by_master:
            yield cycle
        else:
            return


def replay_task(plan: Plan, cycles: Iterable[LogCycle]) -> TaskReplay:
    """Step the scene's task through recorded cycles and compare its targets with the recorded ones.

    It ends early where the targets are those of another controller.
    """
    task = make_task(plan)
    assert isinstance(task, TouchTask)
    way_back = LoggedWayBack(plan)
    comparison = _Comparison(plan)
    for cycle in way_back.cycles_before(controller_cycles(cycles)):
        if max(cycle.measurement.q_age, default=0) >= HOLD_CYCLES:
            continue  # a late drive: the cell held, and did not step its controller
        command = task.step(cycle.measurement)
        comparison.add(cycle, command.q_target)
        if command.done or command.stop_reason is not None or comparison.parted_s is not None:
            break
    else:
        for cycle, q in way_back.steps:
            comparison.add(cycle, q)
    differences = comparison.differences
    return TaskReplay(
        task,
        compared=len(differences),
        differing=sum(d > TARGET_TOLERANCE for d in differences),
        median_rests=float(np.median(comparison.rests)) if differences else math.inf,
        worst_counts=max(differences, default=0),
        lifted_s=way_back.steps[0][0].measurement.t_ns * 1e-9 if way_back.steps else None,
        parted_s=comparison.parted_s,
    )


class _Comparison:
    """Recorded targets beside those of the replay."""

    def __init__(self, plan: Plan) -> None:
        assert plan.setup.arm is not None
        self.parted_s: float | None = None
        self._model = plan.setup.arm.model
        self._patience = round(PARTED_S * 1e9 / plan.sync.period_ns)
        self._rest = np.array(rest_counts(self._model))
        self.differences: list[int] = []
        self.rests: list[float] = []
        self._away = 0

    def add(self, cycle: LogCycle, q: Vector | None) -> None:
        """One cycle, and the joint targets (n,), rad or m, of the replay."""
        if cycle.targets is None or q is None:
            return
        differences = _count_differences(self._model, q, cycle.targets)
        self.differences.append(int(differences.max()))
        self.rests.append(float((differences / self._rest).max()))
        self._away = self._away + 1 if self.rests[-1] > PARTED_RESTS else 0
        if self._away > self._patience:
            self.parted_s = cycle.measurement.t_ns * 1e-9


def replay_contacts(plan: Plan, cycles: Iterable[LogCycle]) -> tuple[ShapeTracker, int]:
    """Feed every contact of a log, force above the touch threshold, to the scene's estimator.

    Returns:
        The tracker; and how many contacts could not be placed, as the joints of their instant are missing.
    """
    assert isinstance(plan.setup.task, Touch)
    sensing = make_sensing(plan.setup.task)
    tracker = make_shape_tracker(plan.setup)
    assert tracker is not None
    for cycle in cycles:
        measurement = cycle.measurement
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
