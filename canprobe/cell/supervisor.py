"""Runs the table of conditions over a cell, guards its joints, and lifts the probe off where the task cannot."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from canprobe.bus.port import ControllerState, PortCounters
from canprobe.cell.conditions import COUNTED, CYCLE_CHECKS, TOUCH_CHECKS
from canprobe.cell.controller import Command, Measurement, TactileSample
from canprobe.cell.drives import DriveGroup
from canprobe.cell.supervision import TOUCH_FORCE, Condition, Contact, Limits, Reaction, Seen
from canprobe.errors import CanprobeError
from canprobe.robot.chain import forward_jacobian
from canprobe.robot.inverse import lifting_step
from canprobe.robot.model import ArmModel, units_to_joints

if TYPE_CHECKING:
    from canprobe.touch.patch.image import Patch


# How long the force has been more than what the array tells.


class HiddenForce:
    """Times an unbroken run of samples whose force is only a lower bound.

    Attributes:
        hidden_s: how long the run is, s; 0 outside one.
    """

    __slots__ = ("_since_ns", "hidden_s")

    def __init__(self) -> None:
        self.hidden_s = 0.0
        self._since_ns: int | None = None

    def add(self, hidden: bool, t_ns: int) -> None:
        """Take one sample.

        Args:
            hidden: its force is only a lower bound, and nothing else tells the true one.
            t_ns: when it was taken.
        """
        if not hidden:
            self._since_ns, self.hidden_s = None, 0.0
        elif self._since_ns is None:
            self._since_ns = t_ns
        else:
            self.hidden_s = (t_ns - self._since_ns) * 1e-9


# What the joints may be told, and what they can have done.

Vector = NDArray[np.float64]
MEASURED_SHARE = 1.5
"""Measured motion above this share of the speed limit is no motion of the arm; SYNCs may be late by a period."""
COUNTS = 2
"""Encoder counts by which two readings may differ at rest."""
_ROUNDING = 1e-9
_NUMBERS = "fiu"
"""Kinds of arrays that can be angles."""


@dataclass(frozen=True, slots=True)
class GuardedTarget:
    """A joint target as it may be sent (n,), rad or m; or why it may not."""

    q: Vector | None
    limit: str | None = None


def outside_workspace(tip: Vector, workspace: Vector) -> str | None:
    """What is wrong with the tip's position (3,), m, in a box (2, 3), m; None where it is inside."""
    below, above = tip < workspace[0], tip > workspace[1]
    if not (below | above).any():
        return None
    axis = int(np.flatnonzero(below | above)[0])
    border = workspace[int(above[axis]), axis]
    return f"the probe's tip at {'xyz'[axis]} = {1e3 * tip[axis]:.1f} mm, workspace ends at {1e3 * border:.1f} mm"


class JointGuard:
    """Range, speed and workspace of the joint targets; speed of the measured joints.

    Args:
        limits: of the plan; without an arm nothing is guarded.

    Attributes:
        slowed: targets that were too far away for one cycle.
    """

    def __init__(self, limits: Limits) -> None:
        self.slowed = 0
        self._limits = limits
        self._speed, self._count = _numbers(limits.joint_speed), _numbers(limits.count)
        self._range = list(zip(_numbers(limits.joint_low), _numbers(limits.joint_high), strict=True))
        self._target: list[float] | None = None
        self._q: list[float] | None = None
        self._t_ns = 0

    def measure(self, measurement: Measurement) -> str | None:
        """What a joint did since the last cycle that none can do; None where all is well or nothing new is known."""
        if measurement.q is None or not self._speed or not self._count or any(measurement.q_age):
            return None
        before, self._q = self._q, measurement.q.tolist()
        passed_s = (measurement.t_ns - self._t_ns + self._limits.period_ns) * 1e-9
        self._t_ns = measurement.t_ns
        if before is None:
            return None
        moved = [abs(q - was) for q, was in zip(self._q, before, strict=True)]
        share = MEASURED_SHARE * passed_s
        beyond = [
            m - share * speed - COUNTS * count for m, speed, count in zip(moved, self._speed, self._count, strict=True)
        ]
        if max(beyond) <= 0.0:
            return None
        joint = beyond.index(max(beyond))
        way = self._limits.joints[joint].text(moved[joint])
        return f"joint {joint + 1} reports a motion of {way} in one cycle, more than it can make"

    def command(self, q_target: Vector, measurement: Measurement) -> GuardedTarget:
        """The target that may be sent for ``q_target`` (n,), rad or m."""
        limits = self._limits
        if not self._range or not self._speed:
            return GuardedTarget(q_target)
        try:
            given = np.asanyarray(q_target)
        except (TypeError, ValueError):
            given = np.array(None)
        if given.dtype.kind not in _NUMBERS or isinstance(given, np.ma.MaskedArray):
            return GuardedTarget(
                None, f"the controller's joint target is {q_target!r}: expected {len(self._range)} angles, rad"
            )
        target = np.asarray(given, dtype=np.float64)
        wanted = target.tolist() if target.shape == (len(self._range),) else [math.nan]
        if not all(map(math.isfinite, wanted)):
            return GuardedTarget(
                None, f"the controller's joint target is {target}: expected {len(self._range)} finite angles, rad"
            )
        inside = [low <= q <= high for q, (low, high) in zip(wanted, self._range, strict=True)]
        if not all(inside):
            joint = inside.index(False)
            at = self._limits.joints[joint].text(wanted[joint])
            return GuardedTarget(None, f"joint {joint + 1} at {at}, its stop")
        if limits.workspace is not None and limits.T_base_tip_of is not None:
            left = outside_workspace(limits.T_base_tip_of(target)[:3, 3], limits.workspace)
            if left is not None:
                return GuardedTarget(None, left)
        return self._within_speed(q_target, wanted, measurement)

    def _within_speed(self, q_target: Vector, wanted: list[float], measurement: Measurement) -> GuardedTarget:
        last = self._target
        if last is None and measurement.q is not None:
            last = measurement.q.tolist()
        if last is not None:
            steps = [q - was for q, was in zip(wanted, last, strict=True)]
            share = max([abs(step) / speed for step, speed in zip(steps, self._speed, strict=True)])
            share /= self._limits.period_ns * 1e-9
            if share > 1.0 + _ROUNDING:
                self.slowed += 1
                self._target = [was + step / share for was, step in zip(last, steps, strict=True)]
                return GuardedTarget(np.array(self._target))
        self._target = wanted
        return GuardedTarget(q_target)


def _numbers(values: Vector | None) -> list[float]:
    """As plain floats: a handful is done with before numpy has begun."""
    return [] if values is None else [float(v) for v in values]


# Runs the table of conditions over a cell, cycle by cycle. Pure: no clock, no port, so a log can be supervised too.

NOTED_ONCE = ("error_frames", "frames_dropped", "estimator")
"""Conditions that the cell lives with and tells once; the others are told by the summary's figures."""
SECOND_NS = 1_000_000_000
LOOK_NS = 20_000_000
"""Between two looks at where the probe presses: less than a millimetre of a retreat."""
MEMORY = 0.25
"""Share of a force that the array may show when it is gone: creep, 5 % a decade, of a press of a quarter of an hour."""
CLEAR = 3e-3
"""m, straight back along the pole: half a retreat, and more than `MEMORY` of 50 N presses the softest pad in."""


class Press:
    """Whether what the array shows is a press, or what it remembers of one.

    After a long press the array creeps back for as long as it was pressed. By its size alone that is a light touch. But
    a press needs the probe to be there: once it has gone straight back from where it pressed last, further than any pad
    is pressed in, the rest is memory, and only what comes on top of it is a new press.
    """

    def __init__(self) -> None:
        self._T_base_tip: Vector | None = None
        self._highest = 0.0
        self._remembered = 0.0

    def look(self, force: float, T_base_tip: Vector) -> None:
        """Take the array's force, N, and where the probe's tip is (4, 4)."""
        if self.holds(force) and force >= MEMORY * self._highest:
            self._T_base_tip, self._highest = T_base_tip, max(force, self._highest)
        elif self._T_base_tip is None:
            self._remembered = min(force, self._remembered)
        elif self._is_clear(T_base_tip[:3, 3] - self._T_base_tip[:3, 3]):
            self._T_base_tip, self._highest, self._remembered = None, 0.0, force

    def holds(self, force: float) -> bool:
        """Whether a force that the array shows, N, is a press."""
        return force >= TOUCH_FORCE + (self._remembered if self._T_base_tip is None else 0.0)

    def _is_clear(self, way: Vector) -> bool:
        assert self._T_base_tip is not None
        pole = self._T_base_tip[:3, 2]
        back = -float(way @ pole)
        return back > CLEAR and float(np.linalg.norm(way + back * pole)) < back


@dataclass(frozen=True, slots=True)
class Finding:
    """A condition that holds, and the error that names what is wrong."""

    condition: Condition
    error: CanprobeError


class Supervisor:
    """The checks of the table and what they have to remember.

    Args:
        seen: the cell; brought up to date by :meth:`step`.
        patch_from: the patch of a tactile sample, for controllers that do not guard their contact; None without touch.

    Attributes:
        counts: how often each condition that the cell lives with has happened.
        first: cycle in which each condition was seen first.
    """

    def __init__(self, seen: Seen, patch_from: Callable[[TactileSample], Patch] | None = None) -> None:
        self.seen = seen
        self.counts: dict[str, int] = {condition.key: 0 for condition in COUNTED}
        self.first: dict[str, int] = {}
        self._patch_from = patch_from
        self._force = 0.0
        self._sample: TactileSample | None = None
        self._press = Press()
        self._look_ns = 0
        self._hidden, self._off_pad = HiddenForce(), HiddenForce()
        self._untouched = math.isfinite(seen.limits.preload_max)
        self._joints = JointGuard(seen.limits)
        period_ns = seen.limits.period_ns
        self._late = deque((t_ns, 0) for t_ns in range(-SECOND_NS, 0, period_ns))  # before its first it was in time
        self._late_sum = 0
        self._active_ns = 0
        self._enabling = tuple(condition for condition in CYCLE_CHECKS if condition.enabling)
        self._counters = [condition.count for condition in COUNTED if condition.count is not None]
        self._counted = [0] * len(COUNTED)

    def step(
        self,
        measurement: Measurement,
        *,
        sync_ns: int,
        overruns: int,
        counters: PortCounters,
        controller_state: ControllerState,
        log_failure: str | None = None,
    ) -> None:
        """Take in one cycle."""
        seen = self.seen
        self._count_late(overruns - seen.overruns, measurement.t_ns)
        seen.overruns = overruns
        seen.gap_ns = sync_ns - seen.sync_ns if seen.sync_ns else 0
        seen.measurement, seen.sync_ns, seen.counters = measurement, sync_ns, counters
        if controller_state is not ControllerState.PASSIVE:
            self._active_ns = measurement.t_ns
        seen.passive_ns = measurement.t_ns - self._active_ns
        seen.controller_state, seen.log_failure = controller_state, log_failure
        seen.speeding = self._joints.measure(measurement)
        self._sample = measurement.tactile or self._sample
        if self._untouched:
            self._untouched = not measurement.enabled
            if measurement.tactile is not None:
                seen.preload = max(seen.preload, self.felt())
        if measurement.t_ns >= self._look_ns:
            self._look_ns = measurement.t_ns + LOOK_NS
            self._look()
        counts = [count(seen) for count in self._counters]
        if counts != self._counted:
            self._note(counts, measurement.cycle)

    def _count_late(self, late: int, t_ns: int) -> None:
        """Late cycles are longer than others: the last second has fewer of them."""
        cycles = self._late
        cycles.append((t_ns, late))
        self._late_sum += late
        while cycles[0][0] <= t_ns - SECOND_NS:
            self._late_sum -= cycles.popleft()[1]
        self.seen.late_share = self._late_sum / len(cycles)

    def _note(self, counts: list[int], cycle: int) -> None:
        self._counted = counts
        for condition, count in zip(COUNTED, counts, strict=True):
            if count != self.counts[condition.key]:
                self.counts[condition.key] = count
                self.first.setdefault(condition.key, cycle)

    def finding(self, *, enabling: bool = False) -> Finding | None:
        """The first condition of the table that holds now; a hold only where nothing worse is found."""
        hold: Finding | None = None
        for condition in self._enabling if enabling else CYCLE_CHECKS:
            error = condition.check(self.seen)  # type: ignore[misc]  # CYCLE_CHECKS have one
            if error is None:
                continue
            self.first.setdefault(condition.key, self.seen.measurement.cycle)
            if condition.reaction is not Reaction.HOLD:
                return Finding(condition, error)
            hold = hold or Finding(condition, error)
        return hold

    def must_stop(self) -> bool:
        """Something holds for which nothing may move any more."""
        return any(c.reaction is Reaction.STOP and c.check(self.seen) is not None for c in CYCLE_CHECKS)  # type: ignore[misc]

    def felt(self) -> float:
        """The force of the last tactile sample, N; 0 where nothing can press."""
        if self._sample is None or self._patch_from is None:
            return 0.0
        return self._patch_from(self._sample).force

    def pressing(self) -> float:
        """The force with which the probe presses on something, N; 0 where the array only remembers that it did."""
        self._look()
        force = self.felt()
        return force if self._press.holds(force) else 0.0

    def _look(self) -> None:
        q, T_base_tip_of = self.seen.measurement.q, self.seen.limits.T_base_tip_of
        if self._sample is not None and q is not None and T_base_tip_of is not None:
            self._press.look(self.felt(), T_base_tip_of(q))

    def guard_contact(self, measurement: Measurement) -> Finding | None:
        """What must not go on in a touch, whatever the controller thinks of it."""
        if self._patch_from is not None and measurement.tactile is not None:
            patch = self._patch_from(measurement.tactile)
            self._force = patch.force
            self._hidden.add(patch.saturated, measurement.tactile.t_sample_ns)
            self._off_pad.add(patch.off_pad and patch.force > TOUCH_FORCE / 2, measurement.tactile.t_sample_ns)
        return touch_finding(
            Contact(
                self.seen.limits,
                self._force,
                measurement.tactile_age,
                hidden_s=self._hidden.hidden_s,
                off_pad_s=self._off_pad.hidden_s,
            )
        )

    def guard_target(self, command: Command) -> tuple[Command, Finding | None]:
        """The command that may be sent: a target too far away is approached, one out of bounds is left out."""
        if command.q_target is None:
            return command, None
        guarded = self._joints.command(command.q_target, self.seen.measurement)
        self.seen.slowed = self._joints.slowed
        if guarded.limit is not None:
            held = Command(None, command.done, command.stop_reason, command.columns)
            return held, touch_finding(Contact(self.seen.limits, 0.0, None, limit=guarded.limit))
        if guarded.q is command.q_target:
            return command, None
        return Command(guarded.q, command.done, command.stop_reason, command.columns), None

    def notes(self) -> list[str]:
        """What happened and was lived with, a line each."""
        return [
            f"{condition.what}: {self.counts[condition.key]}, the first in cycle {self.first[condition.key]}"
            for condition in COUNTED
            if condition.key in NOTED_ONCE and self.counts[condition.key]
        ]


def touch_finding(contact: Contact) -> Finding | None:
    """The first condition of a touch that holds."""
    for condition in TOUCH_CHECKS:
        error = condition.check(contact)  # type: ignore[misc]  # TOUCH_CHECKS have one
        if error is not None:
            return Finding(condition, error)
    return None


# Taking the probe off the object without its task: with the drives that still obey, a short way, back along the pole.
#
# A lost drive stands still, by its own quick stop or because nobody tells it anything else, and where it stands is
# known. The others carry the tool's point away from the object on a straight line, its orientation left open. A drive
# that tells a position it cannot have reached may be moving: then nothing is moved.

WAY = 6e-3
"""m: as far as a touch retreats, and further than the softest pad is pressed in."""
SPEED = 20e-3
"""m/s, the mean; it begins with twice as much, which then falls to zero."""
ARRIVE_S = 0.02
"""For the drives' lag at the end."""


class WayBack:
    """The way of the tool's point off the object, cycle by cycle: what the drives are told, of what the joints are.

    Args:
        model: the arm.
        flange_probe: transform (4, 4) from the probe's centre frame to the flange.
        period_s: of the cycle.
        free: drives (n,) that may turn.
        targets: where the drives were sent last (n,), drive units.
    """

    def __init__(
        self, model: ArmModel, flange_probe: Vector, period_s: float, free: NDArray[np.bool_], targets: Vector
    ) -> None:
        self._model, self._flange_probe, self._period_s = model, flange_probe, period_s
        self._free, self._targets = free, targets
        self._away: Vector | None = None
        self._t = 0.0

    def step(self, measured: Vector) -> Vector | None:
        """Joint targets (n,), rad or m, of this cycle; None at the end of the way, or where it cannot go on.

        Args:
            measured: joint positions (n,), rad or m.
        """
        T, J = forward_jacobian(self._model.chain, measured, self._flange_probe)
        if self._away is None:
            self._away = -T[:3, 2]
        before, self._t = self._gone(self._t), self._t + self._period_s
        if before >= WAY and self._t > WAY / SPEED + ARRIVE_S:
            return None
        move = self._away * (self._gone(self._t) - before)
        if move.any():
            units = lifting_step(self._model, J[:3], move, self._free)
            if units is None:
                return None
            self._targets = self._targets + units
        return units_to_joints(self._model, self._targets)

    @staticmethod
    def cycles(period_s: float) -> int:
        """How many there are at most."""
        return math.ceil((WAY / SPEED + ARRIVE_S) / period_s) + 1

    @staticmethod
    def _gone(t: float) -> float:
        """Way after ``t`` seconds, m."""
        return WAY * (1.0 - max(1.0 - t * SPEED / WAY, 0.0) ** 2)


class LiftOff:
    """One way back, cycle by cycle.

    Args:
        drives: the arm; those that do not obey are told to stop from now on.
        model: the arm.
        flange_probe: transform (4, 4) from the probe's centre frame to the flange.
        period_s: of the cycle.
        obeys: whether the node of a drive does what it is told, as far as NMT and EMCY tell.
    """

    def __init__(
        self,
        drives: DriveGroup,
        model: ArmModel,
        flange_probe: Vector,
        period_s: float,
        obeys: Callable[[int], bool],
    ) -> None:
        self._drives, self._obeys = drives, obeys
        self._free = self._obeying()
        self._way = WayBack(model, flange_probe, period_s, self._free, drives.targets())
        self._force_known_from: int | None = None
        self._highest = 0.0

    def _obeying(self) -> NDArray[np.bool_]:
        """Drives (n,) that are heard, enabled, and not the ones that something is wrong with."""
        drives = self._drives
        heard = zip(drives.axes, drives.ages(), drives.enabled_ones(), strict=True)
        return np.array([age == 0 and enabled and self._obeys(axis.node_id) for axis, age, enabled in heard])

    @property
    def possible(self) -> bool:
        """Some drives obey, and none tells what cannot be."""
        return bool(self._free.any()) and not self._drives.disbelieved

    def begin(self) -> None:
        """Tell the drives that do not obey to stop."""
        axes = zip(self._drives.axes, self._free, strict=True)
        self._drives.stopped = frozenset(axis.node_id for axis, free in axes if not free)

    def step(self, measurement: Measurement) -> Vector | None:
        """Joint targets (n,), rad or m, of this cycle; None at the end of the way, or where it cannot go on."""
        if measurement.q is None or self._drives.disbelieved or not self._still_obeyed():
            return None
        return self._way.step(measurement.q)

    def command(self, supervisor: Supervisor) -> Command | None:
        """What the drives are told in this cycle; None at the end, and where the force grows on the way back."""
        measurement, force = supervisor.seen.measurement, supervisor.felt()
        q = self.step(measurement)
        if q is None:
            return None
        command, finding = supervisor.guard_target(Command(q))
        if self._force_known_from is None:
            self._force_known_from = measurement.cycle + supervisor.seen.limits.cycles_to_feel
        if measurement.cycle < self._force_known_from:  # what is felt is from before the way back
            self._highest = max(self._highest, force)
        return None if finding is not None or supervisor.must_stop() or force > self._highest else command

    def _still_obeyed(self) -> bool:
        """A TPDO may be missing now and then; who has left operation does not come back."""
        enabled = np.array(self._drives.enabled_ones())
        late = np.array(self._drives.ages()) >= 3
        return not bool((self._free & (~enabled | late)).any())
