"""What the joints may be told, and what they can have done."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.measurement import Measurement
from canprobe.cell.supervision import Limits

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
    """A joint target as it may be sent (6,), rad; or why it may not."""

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
        degrees = math.degrees(moved[joint])
        return f"joint {joint + 1} reports a motion of {degrees:.1f} deg in one cycle, more than it can make"

    def command(self, q_target: Vector, measurement: Measurement) -> GuardedTarget:
        """The target that may be sent for ``q_target`` (6,), rad."""
        limits = self._limits
        if not self._range or not self._speed:
            return GuardedTarget(q_target)
        try:
            given = np.asanyarray(q_target)
        except (TypeError, ValueError):
            given = np.array(None)
        if given.dtype.kind not in _NUMBERS or isinstance(given, np.ma.MaskedArray):
            return GuardedTarget(None, f"the controller's joint target is {q_target!r}: expected 6 angles, rad")
        target = np.asarray(given, dtype=np.float64)
        wanted = target.tolist() if target.shape == (len(self._range),) else [math.nan]
        if not all(map(math.isfinite, wanted)):
            return GuardedTarget(None, f"the controller's joint target is {target}: expected 6 finite angles, rad")
        inside = [low <= q <= high for q, (low, high) in zip(wanted, self._range, strict=True)]
        if not all(inside):
            joint = inside.index(False)
            return GuardedTarget(None, f"joint {joint + 1} at {math.degrees(wanted[joint]):.1f} deg, its stop")
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
    """As plain floats: six of them are done with before numpy has begun."""
    return [] if values is None else [float(v) for v in values]
