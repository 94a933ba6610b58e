"""Runs the table of conditions over a cell and guards its joints. Pure: no clock, no port."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from canprobe.cell.master.conditions import BY_KEY, COUNTERS, CYCLE_CHECKS, touch_finding
from canprobe.cell.master.controller import Command, Measurement
from canprobe.cell.master.supervision import CycleState, Finding, Reaction, TouchState
from canprobe.cell.master.tactile_frame import TactileSample
from canprobe.cell.planning.model import Plan
from canprobe.errors import SafetyStop
from canprobe.fieldbus.bus.port import ControllerState
from canprobe.mechanics.robot.chain import forward
from canprobe.mechanics.touch.stops import TOUCH_FORCE
from canprobe.mechanics.types import Floats

if TYPE_CHECKING:
    from canprobe.cell.master.push_witness import PushWitness

MAX_SPEED_SHARE = 1.5
"""Share of the speed limit above which a measured motion is no motion of the arm; SYNCs may be late by a period."""
ENCODER_TOLERANCE_COUNTS = 2
"""Encoder counts by which two readings may differ at rest."""
_ROUNDING = 1e-9
_NUMBER_KINDS = "fiu"
"""Kinds of numpy dtypes that can be joint positions."""


def outside_workspace(tip: Floats, workspace: Floats, name: str = "the probe's tip") -> str | None:
    """A message that a tip of this name, at a position (3,), m, is outside of a box (2, 3), m; None inside."""
    below, above = tip < workspace[0], tip > workspace[1]
    if not (below | above).any():
        return None
    axis = int(np.flatnonzero(below | above)[0])
    border = workspace[int(above[axis]), axis]
    return f"{name} at {'xyz'[axis]} = {1e3 * tip[axis]:.1f} mm, workspace ends at {1e3 * border:.1f} mm"


class JointGuard:
    """Range, speed and workspace of the joint targets; speed of the measured joints.

    Args:
        plan: plan of a cell with an arm.

    Attributes:
        low, high: range of the joint targets (n,), rad or m.
        count: joint motion of one drive unit (n,), rad or m.
        slowed: targets that were too far away for one cycle.
        model: the arm.
        T_flange_tip: transform (4, 4) from the probe's tip, z = pole, to the flange.
    """

    def __init__(self, plan: Plan) -> None:
        arm, probe, safety = plan.setup.needed_arm(), plan.setup.probe, plan.setup.limits
        # a target that a task has clipped to the margin must not be beyond it by its last bit
        model, margin = arm.model, safety.joint_margin - _ROUNDING * arm.model.radian
        self.low, self.high = model.q_min + margin, model.q_max - margin
        self.count = np.abs(model.q_per_unit).sum(axis=1)
        slides = set(model.chain.prismatic)
        self._si = "angles, rad" if slides == {False} else "positions, m" if slides == {True} else "positions, rad or m"
        self.slowed = 0
        self.model, self._workspace, self._period_ns = model, safety.workspace, plan.sync.period_ns
        self._tip, self.T_flange_tip = probe.tip, probe.T_flange_tip
        # plain floats: a handful is compared before numpy has begun
        self._speed: list[float] = (model.qd_max * safety.speed_share).tolist()
        self._counts: list[float] = self.count.tolist()
        self._range: list[tuple[float, float]] = list(zip(self.low.tolist(), self.high.tolist(), strict=True))
        self._target: list[float] | None = None
        self._q: list[float] | None = None
        self._t_ns = 0

    def T_base_tip(self, q: Floats) -> Floats:
        """Transform (4, 4) from the probe's tip (z = pole, towards the object) to base at joints (n,), rad or m."""
        return forward(self.model.chain, q) @ self.T_flange_tip

    def outside(self, q: Floats) -> str | None:
        """A message that the tip is outside of the workspace at joint positions (n,), rad or m; None inside."""
        if self._workspace is None:
            return None
        return outside_workspace(self.T_base_tip(q)[:3, 3], self._workspace, self._tip)

    def measure(self, measurement: Measurement) -> str | None:
        """A motion since the last cycle that no joint can make; None without one, or where nothing new is known."""
        if measurement.q is None or any(measurement.q_age):
            return None
        before, self._q = self._q, measurement.q.tolist()
        share = MAX_SPEED_SHARE * (measurement.t_ns - self._t_ns + self._period_ns) * 1e-9
        self._t_ns = measurement.t_ns
        if before is None:
            return None
        joints = zip(self._q, before, self._speed, self._counts, strict=True)
        beyond = [abs(q - was) - share * speed - ENCODER_TOLERANCE_COUNTS * count for q, was, speed, count in joints]
        if max(beyond) <= 0.0:
            return None
        joint = beyond.index(max(beyond))
        way = self.model.joints[joint].text(abs(self._q[joint] - before[joint]))
        return f"joint {joint + 1} reports a motion of {way} in one cycle, more than it can make"

    def command(self, q_target: Floats, measurement: Measurement) -> Floats:
        """The target that may be sent for `q_target` (n,), rad or m: it or, where that is too far, one on the way.

        Raises:
            SafetyStop: it is no target, or beyond a limit of a joint or of the workspace.
        """
        n = len(self._range)
        if type(q_target) is not np.ndarray or q_target.dtype != np.float64:
            try:
                given = np.asanyarray(q_target)
            except (TypeError, ValueError):
                given = np.array(None)
            if given.dtype.kind not in _NUMBER_KINDS or isinstance(given, np.ma.MaskedArray):
                raise SafetyStop(f"the controller's q_target is {q_target!r}: expected {n} {self._si}")
            target = np.asarray(given, dtype=np.float64)
        else:
            target = q_target
        wanted: list[float] = target.tolist() if target.shape == (n,) else [math.nan] * n
        last = self._target
        if last is None and measurement.q is not None:
            last = measurement.q.tolist()
        inside = [low <= q <= high for q, (low, high) in zip(wanted, self._range, strict=True)]
        if not all(inside) and not self._goes_back(wanted, last):
            if not all(map(math.isfinite, wanted)):
                got = f"is {target}" if target.shape == (n,) else f"has shape {target.shape}"
                raise SafetyStop(f"the controller's q_target {got}: expected {n} finite {self._si}")
            joint = inside.index(False)
            where = self.model.joints[joint].text(wanted[joint])
            raise SafetyStop(f"joint {joint + 1} at {where}, its stop")
        if self._workspace is not None and (left := self.outside(target)) is not None:
            raise SafetyStop(left)
        if last is not None:
            joints = zip(wanted, last, self._speed, strict=True)
            share = max([abs(q - was) / speed for q, was, speed in joints]) / (self._period_ns * 1e-9)
            if share > 1.0 + _ROUNDING:
                self.slowed += 1
                self._target = [was + (q - was) / share for q, was in zip(wanted, last, strict=True)]
                return np.array(self._target)
        self._target = wanted
        return q_target

    def _goes_back(self, wanted: list[float], last: list[float] | None) -> bool:
        """Whether joints that are out of their range stand or move back into it, as far as the last target knows."""
        joints = zip(wanted, last or (), self._range, strict=False)
        return last is not None and all(min(low, was) <= q <= max(high, was) for q, was, (low, high) in joints)


NOTED_ONCE = ("error_frames", "frames_dropped", "clock_step", "estimator")
"""Conditions that the cell lives with and notes once; the others are figures of the summary."""
SECOND_NS = 1_000_000_000
LOOK_PERIOD_NS = 20_000_000
"""Time between two looks at where the probe presses; a retreat moves less than a millimetre meanwhile."""
MEMORY_SHARE = 0.25
"""Share of a force that the array may show when it is gone: creep, 5 % a decade, of a press of a quarter of an hour."""
CLEARANCE = 3e-3
"""Way straight back along the pole, m: half a retreat; `MEMORY_SHARE` of 50 N presses the softest pad in less."""


class PressDetector:
    """Tells a press from the memory that the array has of one.

    After a long press the array creeps back for as long as it was pressed; its signal alone looks like a light touch.
    A press needs the probe in its place. Once the probe has gone straight back from its last press, further than any
    pad is pressed in, the rest of the signal is memory, and only a force above it is a new press.
    """

    def __init__(self) -> None:
        self._T_base_tip: Floats | None = None
        self._highest = 0.0
        self._remembered = 0.0

    def look(self, force: float, T_base_tip: Floats) -> None:
        """Take the array's force, N, and where the probe's tip is (4, 4)."""
        if self.holds(force) and force >= MEMORY_SHARE * self._highest:
            self._T_base_tip, self._highest = T_base_tip, max(force, self._highest)
        elif self._T_base_tip is None:
            self._remembered = min(force, self._remembered)
        elif self._is_clear(T_base_tip[:3, 3] - self._T_base_tip[:3, 3]):
            self._T_base_tip, self._highest, self._remembered = None, 0.0, force

    def holds(self, force: float) -> bool:
        """Whether a force that the array shows, N, is a press."""
        return force >= TOUCH_FORCE + (self._remembered if self._T_base_tip is None else 0.0)

    def _is_clear(self, way: Floats) -> bool:
        assert self._T_base_tip is not None
        pole = self._T_base_tip[:3, 2]
        back = -float(way @ pole)
        # within 45° of the pole: a probe that has slid further aside than back may still press
        return back > CLEARANCE and float(np.linalg.norm(way + back * pole)) < back


class Supervisor:
    """Runs the checks of the table, and keeps what they have to remember.

    Args:
        seen: the cell; brought up to date by :meth:`step`.
        guard: guard of the joints; None without an arm.
        push: witness of the force by the drives' torques; None without touch.

    Attributes:
        counts: how often each condition that does not stop the cell has happened.
        first: first cycle of each condition.
        array_alive: whether an image of the array has changed since bring-up.
    """

    def __init__(self, seen: CycleState, guard: JointGuard | None, push: PushWitness | None = None) -> None:
        self.seen = seen
        self.counts: dict[str, int] = dict.fromkeys((key for key, _ in COUNTERS), 0)
        self.first: dict[str, int] = {}
        self.array_alive = False
        self._guard = guard
        self._contact = TouchState(seen.limits)
        self._push = push
        self._sample: TactileSample | None = None
        self._press = PressDetector()
        self._look_ns = 0
        self._untouched = seen.limits.tares
        self._late: deque[tuple[int, int]] = deque()  # times of the last second's cycles, and whether they were late
        self._late_sum = 0
        self._active_ns = 0
        self._enabling = tuple(condition for condition in CYCLE_CHECKS if condition.enabling)

    def step(self, measurement: Measurement, sync_ns: int, overruns: int) -> None:
        """Take in one cycle, of which `seen` has what lies outside of the measurement: bus, patch, controller, log."""
        seen = self.seen
        self._count_late(overruns - seen.overruns, measurement.t_ns)
        seen.overruns = overruns
        seen.gap_ns = sync_ns - seen.sync_ns if seen.sync_ns else 0
        seen.measurement, seen.sync_ns = measurement, sync_ns
        if seen.controller_state is not ControllerState.PASSIVE:
            self._active_ns = measurement.t_ns
        seen.passive_ns = measurement.t_ns - self._active_ns
        seen.speeding = self._guard.measure(measurement) if self._guard is not None else None
        if (sample := measurement.tactile) is not None:
            self.array_alive = self.array_alive or (self._sample is not None and sample.differs_from(self._sample))
            self._sample = sample
        if self._untouched:
            self._untouched = not measurement.enabled
            if measurement.tactile is not None:
                seen.preload = max(seen.preload, seen.force)
        if self._push is not None:
            self._push.step(measurement, seen.force)
            seen.unfelt = self._push.unfelt
        if measurement.t_ns >= self._look_ns:
            self._look_ns = measurement.t_ns + LOOK_PERIOD_NS
            self._look()
        for key, count in COUNTERS:
            if (number := count(seen)) != self.counts[key]:
                self.counts[key] = number
                self.first.setdefault(key, measurement.cycle)

    def _count_late(self, late: int, t_ns: int) -> None:
        """Late cycles are longer than others: the last second has fewer of them."""
        cycles, period_ns = self._late, self.seen.limits.period_ns
        if not cycles:  # as if a second in time had passed before the first one
            cycles.extend((before_ns, 0) for before_ns in range(t_ns - SECOND_NS + period_ns, t_ns, period_ns))
        cycles.append((t_ns, late))
        self._late_sum += late
        while cycles[0][0] <= t_ns - SECOND_NS:
            self._late_sum -= cycles.popleft()[1]
        self.seen.late_share = self._late_sum / len(cycles)

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
        """Whether a condition holds that forbids every motion."""
        return any(c.reaction is Reaction.STOP and c.check(self.seen) is not None for c in CYCLE_CHECKS)  # type: ignore[misc]

    def pressing(self) -> float:
        """The force with which the probe presses on something, N; 0 where the array only remembers that it did."""
        self._look()
        force = self.seen.force
        return force if self._press.holds(force) else 0.0

    def _look(self) -> None:
        q = self.seen.measurement.q
        if self._sample is not None and q is not None and self._guard is not None:
            self._press.look(self.seen.force, self._guard.T_base_tip(q))

    def guard_contact(self, measurement: Measurement) -> Finding | None:
        """The first condition of a touch that holds, for a controller that does not guard its contact itself."""
        sample, patch = measurement.tactile, self.seen.patch
        if sample is not None and patch is not None:
            self._contact.update_force(patch, sample.t_sample_ns)
            if measurement.q is not None and self._guard is not None:
                self._contact.images.look(sample, patch, self._guard.T_base_tip(measurement.q)[:3, 3])
        self._contact.tactile_age = measurement.tactile_age
        return touch_finding(self._contact)

    def guard_target(self, command: Command) -> tuple[Command, Finding | None]:
        """The command that may be sent: a target too far away is approached, a target out of bounds is left out."""
        if command.q_target is None or self._guard is None:
            return command, None
        try:
            q = self._guard.command(command.q_target, self.seen.measurement)
        except SafetyStop as stop:
            return replace(command, q_target=None), Finding(BY_KEY["joint_stop"], stop)
        self.seen.slowed = self._guard.slowed
        return (command if q is command.q_target else replace(command, q_target=q)), None

    def notes(self) -> list[str]:
        """Conditions that happened and did not stop the cell, a line each."""
        return [
            f"{BY_KEY[key].what}: {self.counts[key]}, the first in cycle {self.first[key]}"
            for key in NOTED_ONCE
            if self.counts[key]
        ]
