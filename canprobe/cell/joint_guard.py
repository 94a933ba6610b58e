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
        self._target: Vector | None = None
        self._q: Vector | None = None
        self._t_ns = 0

    def measure(self, measurement: Measurement) -> str | None:
        """What a joint did since the last cycle that none can do; None where all is well or nothing new is known."""
        speed, count = self._limits.joint_speed, self._limits.count
        if measurement.q is None or speed is None or count is None or any(measurement.q_age):
            return None
        before, self._q = self._q, measurement.q
        passed_s = (measurement.t_ns - self._t_ns + self._limits.period_ns) * 1e-9
        self._t_ns = measurement.t_ns
        if before is None:
            return None
        moved = np.abs(measurement.q - before)
        beyond = moved - MEASURED_SHARE * speed * passed_s - COUNTS * count
        if not (beyond > 0).any():
            return None
        joint = int(np.argmax(beyond))
        degrees = math.degrees(moved[joint])
        return f"joint {joint + 1} reports a motion of {degrees:.1f} deg in one cycle, more than it can make"

    def command(self, q_target: Vector, measurement: Measurement) -> GuardedTarget:
        """The target that may be sent for ``q_target`` (6,), rad."""
        limits = self._limits
        if limits.joint_low is None or limits.joint_high is None or limits.joint_speed is None:
            return GuardedTarget(q_target)
        target = np.asarray(q_target, dtype=np.float64)
        if target.shape != limits.joint_low.shape or not np.isfinite(target).all():
            return GuardedTarget(None, f"the controller's joint target is {target}: expected 6 finite angles, rad")
        outside = (target < limits.joint_low) | (target > limits.joint_high)
        if outside.any():
            joint = int(np.flatnonzero(outside)[0])
            return GuardedTarget(None, f"joint {joint + 1} at {math.degrees(target[joint]):.1f} deg, its stop")
        if limits.workspace is not None and limits.tip_of is not None:
            left = outside_workspace(limits.tip_of(target), limits.workspace)
            if left is not None:
                return GuardedTarget(None, left)
        return self._within_speed(q_target, target, measurement, limits.joint_speed)

    def _within_speed(self, q_target: Vector, target: Vector, measurement: Measurement, speed: Vector) -> GuardedTarget:
        last = self._target if self._target is not None else measurement.q
        if last is not None:
            step = target - last
            share = float((np.abs(step) / speed).max()) / (self._limits.period_ns * 1e-9)
            if share > 1.0 + _ROUNDING:
                self.slowed += 1
                self._target = last + step / share
                return GuardedTarget(self._target)
        self._target = target
        return GuardedTarget(q_target)
