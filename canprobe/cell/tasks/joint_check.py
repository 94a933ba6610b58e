"""First motion: each joint alone by a small angle, slowly, and what every encoder made of it.

Encoders are compared motor by motor, so that a drive that turns the wrong way, by another gear or not at all is named
even where wrist joints drag each other's motors along. Whether the joint itself turned the way it must, no encoder
can tell, as a drive's polarity turns target and feedback round together: that is what the operator is asked.
"""

from __future__ import annotations

import math
from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.joint_guard import outside_workspace
from canprobe.cell.measurement import Command, Measurement
from canprobe.cell.supervision import Limits
from canprobe.cell.tasks.joint_findings import Answer, JointFinding, Operator, find_fault
from canprobe.cell.tasks.probe_motion import smooth_step
from canprobe.robot.puma260 import PumaModel, joints_to_counts

Vector = NDArray[np.float64]
Script = Generator[Command, Measurement, Measurement]
ANGLE_DEG, SPEED_DEG_S = 1.0, 2.0
SETTLE_S = 0.25
_PEAK = 15 / 8  # of the quintic's speed over its mean


class JointCheck:
    """The controller that moves one joint after the other, forth and back.

    Args:
        model: the arm.
        limits: of the cell; a joint that would leave them is moved the other way, or not at all.
        period_s: of the cycle.
        operator: asked before each motion, and after it whether the joint turned the right way; None asks nobody.
        angle_deg: of each motion.
        speed_deg_s: highest speed of it.

    Attributes:
        findings: one for each joint that its turn has come to.
        start: joint angles (6,), rad, before any motion; None as long as they are not known.
    """

    def __init__(
        self,
        model: PumaModel,
        limits: Limits,
        period_s: float,
        operator: Operator | None,
        *,
        angle_deg: float = ANGLE_DEG,
        speed_deg_s: float = SPEED_DEG_S,
    ) -> None:
        assert limits.joint_low is not None and limits.joint_high is not None
        self._low, self._high, self._limits = limits.joint_low, limits.joint_high, limits
        self._model, self._period_s, self._operator = model, period_s, operator
        self._angle = math.radians(angle_deg)
        self._move_s = _PEAK * angle_deg / speed_deg_s
        self.findings: list[JointFinding] = []
        self.start: Vector | None = None
        self._quits = False
        self._script: Generator[Command, Measurement, None] = self._all_joints()
        next(self._script)

    def step(self, measurement: Measurement) -> Command:
        """One cycle."""
        try:
            return self._script.send(measurement)
        except StopIteration:
            return Command(done=True)

    def inspect(self, q: Vector) -> str | None:
        """Why an arm that stands at joint angles (6,), rad, must not be enabled."""
        self.start = q
        outside = np.flatnonzero((q < self._low) | (q > self._high))
        if not outside.size:
            return None
        joint = int(outside[0])
        low, high = np.degrees((self._low[joint], self._high[joint]))
        return (
            f"joint {joint + 1} stands at {math.degrees(q[joint]):.1f} deg, outside {low:.1f} to {high:.1f} deg:"
            " move it there by hand, or its zero is wrong"
        )

    def _all_joints(self) -> Generator[Command, Measurement, None]:
        measurement = yield Command()
        assert measurement.q is not None
        start = self.start = measurement.q
        for joint in range(len(start)):
            finding = yield from self._joint(joint, start)
            if finding is not None:
                self.findings.append(finding)
            if self._quits:
                return

    def _joint(self, joint: int, start: Vector) -> Generator[Command, Measurement, JointFinding | None]:
        """Ask, move, look, ask, move back; None where the operator has enough before it has moved."""
        degrees = math.degrees(start[joint])
        way = self._way(joint, start)
        if way is None:
            return JointFinding(joint, degrees, skipped="either way it would leave its limits or the workspace")
        told = math.degrees(way[joint])
        question = f"joint {joint + 1} at {degrees:.2f} deg: turn it by {told:+.2f} deg?"
        if (yield from self._asked(question, start)) is not Answer.YES:
            return None if self._quits else JointFinding(joint, degrees, skipped="as the operator wished")
        before = yield from self._hold(start)
        measured = yield from self._move(start, start + way)
        assert before.q is not None and measured.q is not None
        moved = joints_to_counts(self._model, measured.q - before.q)
        fault = find_fault(joint, joints_to_counts(self._model, way), moved)
        seen = f"did joint {joint + 1} turn by about {told:+.1f} deg, positive by the right hand round its axis?"
        answer = yield from self._asked(seen, start + way)
        yield from self._move(start + way, start)
        if answer is Answer.NO and fault is None:
            fault = "the operator did not see it turn that way: polarity, gear or another joint's drive"
        turned = math.degrees(float(moved[joint] / self._model.counts[joint, joint]))
        return JointFinding(joint, degrees, told, turned, fault)

    def _way(self, joint: int, start: Vector) -> Vector | None:
        """The change of the joint angles (6,), rad: forwards, or else backwards; None where there is no room."""
        for angle in (self._angle, -self._angle):
            way = np.zeros_like(start)
            way[joint] = angle
            goal = start + way
            if self._low[joint] <= goal[joint] <= self._high[joint] and not self._leaves_workspace(goal):
                return way
        return None

    def _leaves_workspace(self, q: Vector) -> bool:
        limits = self._limits
        if limits.workspace is None or limits.T_base_tip_of is None:
            return False
        return outside_workspace(limits.T_base_tip_of(q)[:3, 3], limits.workspace) is not None

    # ------------------------------------------------------------------ parts of the script

    def _asked(self, question: str, q: Vector) -> Generator[Command, Measurement, Answer]:
        if self._operator is None:
            return Answer.YES
        self._operator.ask(question)
        while (answer := self._operator.answer()) is None:
            yield Command(q_target=q)
        self._quits = answer is Answer.QUIT
        return answer

    def _hold(self, q: Vector) -> Script:
        for _ in range(max(1, round(SETTLE_S / self._period_s))):
            measurement = yield Command(q_target=q)
        return measurement

    def _move(self, q_from: Vector, q_to: Vector) -> Script:
        cycles = max(1, round(self._move_s / self._period_s))
        for k in range(1, cycles + 1):
            yield Command(q_target=q_from + smooth_step(k / cycles) * (q_to - q_from))
        return (yield from self._hold(q_to))
