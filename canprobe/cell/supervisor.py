"""Runs the table of conditions over a cell, cycle by cycle. Pure: no clock, no port, so a log can be supervised too."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from canprobe.bus.port import ControllerState, PortCounters
from canprobe.cell.conditions import COUNTED, CYCLE_CHECKS, TOUCH_CHECKS
from canprobe.cell.hidden_force import HiddenForce
from canprobe.cell.joint_guard import JointGuard
from canprobe.cell.measurement import Command, Measurement, TactileSample
from canprobe.cell.supervision import TOUCH_FORCE, Condition, Contact, Reaction, Seen, Vector
from canprobe.errors import CanprobeError

if TYPE_CHECKING:
    from canprobe.touch.patch import Patch

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
