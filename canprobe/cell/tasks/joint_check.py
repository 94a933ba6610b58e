"""First motion: each joint moves alone by a small way, slowly, and every encoder is compared.

Encoders are compared motor by motor, so that a drive that turns the wrong way, by another gear or not at all is named
even where wrist joints drag each other's motors along. Whether the joint itself turned the way it must, no encoder
can show, as a drive's polarity turns target and feedback round together: that is what the operator is asked.
"""

from __future__ import annotations

import math
from collections.abc import Generator

import numpy as np

from canprobe.cell.master.controller import Command, Controller, Measurement
from canprobe.cell.master.position_track import rest_counts
from canprobe.cell.master.supervisor import JointGuard
from canprobe.cell.planning.model import Plan
from canprobe.cell.tasks.joint_finding import VERBS, Answer, JointFinding, Operator, find_fault
from canprobe.mechanics.touch.probe_motion import smooth_step
from canprobe.mechanics.types import Floats

Script = Generator[Command, Measurement, Measurement]
MOVE_ANGLE = math.radians(1.0)
"""Angle by which a revolute joint is moved; a prismatic joint moves by `ArmModel.radian` times that, 3.5 mm."""
MOVE_S = 15 / 8 * 0.5
"""Time of a motion, for a highest speed of 2 deg/s (7 mm/s); the highest speed of the quintic is 15/8 of its mean."""
SETTLE_S = 0.25


class JointCheck(Controller):
    """The controller that moves one joint after the other, forth and back.

    Args:
        plan: plan of a cell with an arm; a joint that would leave its limits is moved the other way, or not at all.
        operator: asked before each motion, and after it whether the joint moved the right way; None: no questions.

    Attributes:
        findings: one for each joint that was checked so far.
        start: joint positions (n,), rad or m, before any motion; None as long as they are not known.
    """

    def __init__(self, plan: Plan, operator: Operator | None) -> None:
        assert plan.setup.arm is not None
        self._guard, self._model = JointGuard(plan), plan.setup.arm.model
        self._period_s, self._operator = plan.sync.period_ns * 1e-9, operator
        self.findings: list[JointFinding] = []
        self.start: Floats | None = None
        self._quits = False
        self._script: Generator[Command, Measurement, None] = self._all_joints()
        next(self._script)

    def step(self, measurement: Measurement) -> Command:
        """Give the target of a cycle."""
        try:
            return self._script.send(measurement)
        except StopIteration:
            return Command(done=True)

    def inspect(self, q: Floats) -> str | None:
        """Why an arm that stands at joint positions (n,), rad or m, must not be enabled."""
        self.start = q
        outside = np.flatnonzero((q < self._guard.low) | (q > self._guard.high))
        if not outside.size:
            return None
        joint = int(outside[0])
        its = self._model.joints[joint]
        return (
            f"joint {joint + 1} stands at {its.text(q[joint])}, outside {its.shown(self._guard.low[joint]):.1f} to "
            f"{its.text(self._guard.high[joint])}: check counts_per_turn and gear, then sign and zero_counts; if they "
            "are right, move it there by hand"
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

    def _joint(self, joint: int, start: Floats) -> Generator[Command, Measurement, JointFinding | None]:
        """Ask, move, look, ask, move back; None where the operator has enough before it has moved."""
        its, units_per_q = self._model.joints[joint], self._model.units_per_q
        stood, unit = its.shown(start[joint]), its.unit
        verb = VERBS[unit][0]
        way = self._way(joint, start)
        if way is None:
            why = "either way it would leave its limits or the workspace"
            return JointFinding(joint, stood, skipped=why, unit=unit)
        told = its.shown(way[joint])
        question = f"joint {joint + 1} at {its.text(start[joint], '.2f')}: {verb} it by {told:+.2f} {unit}?"
        if (yield from self._asked(question, start)) is not Answer.YES:
            return None if self._quits else JointFinding(joint, stood, skipped="as the operator wished", unit=unit)
        before = yield from self._hold(start)
        measured = yield from self._move(start, start + way)
        assert before.q is not None and measured.q is not None
        moved = units_per_q @ (measured.q - before.q)
        fault = find_fault(joint, units_per_q @ way, moved, rest_counts(self._model), unit)
        positive = "along" if its.prismatic else "by the right hand round"
        seen = f"did joint {joint + 1} {verb} by about {told:+.1f} {unit}, positive {positive} its axis?"
        answer = yield from self._asked(seen, start + way)
        yield from self._move(start + way, start)
        if answer is Answer.NO and fault is None:
            fault = f"the operator did not see it {verb} that way: polarity, gear or another joint's drive"
        way_made = its.shown(float(moved[joint] / units_per_q[joint, joint]))
        return JointFinding(joint, stood, told, way_made, fault, unit=unit)

    def _way(self, joint: int, start: Floats) -> Floats | None:
        """The change of the joints (n,), rad or m: forwards, or else backwards; None where there is no room."""
        for angle in (MOVE_ANGLE, -MOVE_ANGLE):
            way = np.zeros_like(start)
            way[joint] = angle * self._model.radian[joint]
            goal = start + way
            if self._guard.low[joint] <= goal[joint] <= self._guard.high[joint] and self._guard.outside(goal) is None:
                return way
        return None

    # parts of the script

    def _asked(self, question: str, q: Floats) -> Generator[Command, Measurement, Answer]:
        if self._operator is None:
            return Answer.YES
        self._operator.ask(question)
        while (answer := self._operator.answer()) is None:
            yield Command(q_target=q)
        self._quits = answer is Answer.QUIT
        return answer

    def _hold(self, q: Floats) -> Script:
        for _ in range(max(1, round(SETTLE_S / self._period_s))):
            measurement = yield Command(q_target=q)
        return measurement

    def _move(self, q_from: Floats, q_to: Floats) -> Script:
        cycles = max(1, round(MOVE_S / self._period_s))
        for k in range(1, cycles + 1):
            yield Command(q_target=q_from + smooth_step(k / cycles) * (q_to - q_from))
        return (yield from self._hold(q_to))
