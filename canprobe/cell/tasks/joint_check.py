"""First motions: each joint moves alone and slowly, by a small way and then by one that a person can measure.

Encoders are compared motor by motor, so that a drive that turns the wrong way, by another gear or not at all is named
even where wrist joints drag each other's motors along. Whether the joint itself turned the way it must, no encoder
can show: a drive's polarity turns target and feedback round together, and a gear or a resolution that the cell file has
wrong scales them together. So a person is asked. The small way shows the wrong direction and the wrong joint before
much has moved; half or twice a gear is seen at `SEEN_ANGLE` only. The array watches where there is one: what presses on
it meanwhile is no part of the motion.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from dataclasses import replace

import numpy as np

from canprobe.cell.master.array import make_patch_reader
from canprobe.cell.master.controller import Command, Controller, Measurement
from canprobe.cell.master.position_track import rest_counts
from canprobe.cell.master.supervisor import JointGuard
from canprobe.cell.planning.model import Plan
from canprobe.cell.tasks.joint_finding import (
    VERBS,
    Answer,
    JointFinding,
    Operator,
    SeenWay,
    find_fault,
    find_seen_fault,
)
from canprobe.mechanics.robot.chain import forward
from canprobe.mechanics.touch.probe_motion import smooth_step
from canprobe.mechanics.touch.stops import TOUCH_FORCE
from canprobe.mechanics.types import Floats

Script = Generator[Command, Measurement, Measurement]
Judged = Generator[Command, Measurement, JointFinding]
Look = Callable[[JointFinding, Floats, Floats], Judged]
MOVE_ANGLE, MOVE_SPEED = math.radians(1.0), math.radians(2.0)
"""Angle by which a revolute joint is moved first, and its highest speed, per s; a prismatic joint moves by
`ArmModel.radian` times that: 3.5 mm."""
SEEN_ANGLE, SEEN_SPEED = math.radians(10.0), math.radians(4.0)
"""The same for the way that a person measures; 35 mm of a prismatic joint."""
ROOM_STEP = math.radians(1.0)
"""Distance of the postures that are compared with the workspace before a motion."""
MIN_FLANGE_WAY_M = 0.01
"""Least way of the flange that a person can measure well enough."""
PEAK_OVER_MEAN_SPEED = 15 / 8
"""Highest speed of the quintic over its mean."""
SETTLE_S = 0.25


class JointCheck(Controller):
    """The controller that moves one joint after the other, forth and back.

    Args:
        plan: plan of a cell with an arm; a joint that would leave its limits is moved the other way, or not at all.
        operator: asked before each motion, and after it what the joint did; None: no questions, and no larger way,
            which only a person can judge.

    Attributes:
        findings: one for each joint that was checked so far.
        start: joint positions (n,), rad or m, before any motion; None as long as they are not known.
    """

    compares_motion = True

    def __init__(self, plan: Plan, operator: Operator | None) -> None:
        self._guard, self._model = JointGuard(plan), plan.setup.needed_arm().model
        self._highest = plan.setup.limits.speed_share * self._model.qd_max / self._model.radian
        self._period_s, self._operator = plan.sync.period_ns * 1e-9, operator
        self.reader = make_patch_reader(plan.setup)
        self.findings: list[JointFinding] = []
        self.start: Floats | None = None
        self._quits = False
        self._force: float | None = None
        self._pressed: str | None = None
        self._script: Generator[Command, Measurement, None] = self._all_joints()
        next(self._script)

    def step(self, measurement: Measurement) -> Command:
        try:
            return self._script.send(measurement)
        except StopIteration:
            return Command(done=self._pressed is None, stop_reason=self._pressed)

    def inspect(self, q: Floats) -> str | None:
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
            if self._quits or self._pressed is not None:
                return

    def _joint(self, joint: int, start: Floats) -> Generator[Command, Measurement, JointFinding | None]:
        """The small way, and where it was as expected and somebody watches, the larger one."""
        its, room = self._model.joints[joint], self._room(joint, start)
        self._force = None
        if abs(room) < MOVE_ANGLE:
            why = "either way it would leave its limits or the workspace"
            return JointFinding(joint, its.shown(start[joint]), skipped=why, unit=its.unit)
        first = yield from self._motion(joint, start, math.copysign(MOVE_ANGLE, room), MOVE_SPEED, self._look_small)
        if first is None or first.skipped or first.fault or self._operator is None:
            return first
        if self._quits:
            return replace(first, unseen="the operator ended before he saw a larger way")
        angle = min(max(room, -SEEN_ANGLE), SEEN_ANGLE)
        second = yield from self._motion(joint, start, angle, SEEN_SPEED, self._look_large)
        if second is None or second.skipped is not None:
            return replace(first, unseen="no larger way was seen, as the operator wished")
        return second

    def _motion(
        self, joint: int, start: Floats, angle: float, speed: float, look: Look
    ) -> Generator[Command, Measurement, JointFinding | None]:
        """Ask, move, look, ask, move back; None where the operator has enough before it has moved."""
        its, units_per_q = self._model.joints[joint], self._model.units_per_q
        stood, unit = its.shown(start[joint]), its.unit
        way = np.zeros_like(start)
        way[joint] = angle * self._model.radian[joint]
        told = its.shown(way[joint])
        question = f"joint {joint + 1} at {its.text(start[joint], '.2f')}: {VERBS[unit][0]} it by {told:+.2f} {unit}?"
        if (yield from self._asked(question, start)) is not Answer.YES:
            return None if self._quits else JointFinding(joint, stood, skipped="as the operator wished", unit=unit)
        speed = min(speed, float(self._highest[joint]))
        before = yield from self._hold(start)
        measured = yield from self._move(joint, start, angle, speed)
        assert before.q is not None and measured.q is not None
        moved = units_per_q @ (measured.q - before.q)
        shown = its.shown(float(moved[joint] / units_per_q[joint, joint]))
        force = self._force if self.array_alive else None
        finding = JointFinding(joint, stood, told, shown, unit=unit, force=force)
        if self._pressed is not None:
            return replace(finding, fault=self._pressed)
        fault = find_fault(joint, units_per_q @ way, moved, rest_counts(self._model), unit)
        finding = yield from look(replace(finding, fault=fault), start, way)
        yield from self._move(joint, start + way, -angle, speed, watched=False)
        return finding

    def _look_small(self, finding: JointFinding, start: Floats, way: Floats) -> Judged:
        """Ask whether the joint moved the right way."""
        verb = VERBS[finding.unit][0]
        positive = "along" if self._model.joints[finding.joint].prismatic else "by the right hand round"
        told = f"{finding.asked:+.1f} {finding.unit}, positive {positive} its axis"
        seen = f"did joint {finding.joint + 1} {verb} by about {told}?"
        answer = yield from self._asked(seen, start + way)
        if answer is Answer.NO and finding.fault is None:
            fault = f"the operator did not see it {verb} that way: polarity, gear or another joint's drive"
            return replace(finding, fault=fault)
        return finding

    def _look_large(self, finding: JointFinding, start: Floats, way: Floats) -> Judged:
        """Ask for the way in numbers, until one of them can be judged."""
        its, unit, angle = self._model.joints[finding.joint], finding.unit, abs(way[finding.joint])
        chain = self._model.chain
        flange_mm = 1e3 * float(np.linalg.norm((forward(chain, start + way) - forward(chain, start))[:3, 3]))
        short = angle < SEEN_ANGLE * self._model.radian[finding.joint] * (1.0 - 1e-9)
        by_flange = not its.prismatic and flange_mm >= 1e3 * MIN_FLANGE_WAY_M
        number = "mm" if its.prismatic else "degrees"
        question = (
            f"by how many {number} did joint {finding.joint + 1} {VERBS[unit][0]} (Enter for {finding.asked:+.1f})"
            f"{', or how far did its flange go, straight, such as 35 mm' * by_flange}?"
        )
        while finding.fault is None:
            answer = yield from self._asked(question, start + way, for_way=True)
            if answer is Answer.QUIT:
                return replace(finding, unseen="the operator ended before he answered")
            if answer is Answer.NO:
                return replace(finding, fault=f"the operator saw it {VERBS[unit][0]} otherwise: gear, counts or sign")
            if not isinstance(answer, SeenWay):
                answer = SeenWay(finding.asked, unit)
            if answer.unit in (None, unit):
                due = finding.asked
                seen = answer.number if answer.signed else math.copysign(answer.number, due)
                words = f"{seen:+g} {unit}"
            elif answer.unit == "mm" and by_flange:
                due, seen = flange_mm, abs(answer.number)
                words = f"{seen:g} mm of the flange, where {due:.0f} mm are due"
            else:
                continue
            if (fault := find_seen_fault(seen, due, unit)) is None and short and due == finding.asked:
                left = its.text(angle)
                return replace(finding, unseen=f"there is room for {left} only: turn it away from its stop, or measure")
            return replace(finding, seen=words, fault=fault)
        return finding

    def _room(self, joint: int, start: Floats) -> float:
        """Signed room of a joint, rad: forwards where it has twice `SEEN_ANGLE`, should a gear be half, or else where
        there is more; no more than that."""
        radian, step = float(self._model.radian[joint]), np.zeros_like(start)
        found: list[float] = []
        for sign, stop in ((1.0, self._guard.high), (-1.0, self._guard.low)):
            room = min(abs(stop[joint] - start[joint]) / radian, 2.0 * SEEN_ANGLE)
            step[joint] = sign * ROOM_STEP * radian
            inside = 0
            while (inside + 1) * ROOM_STEP <= room + 1e-9 and self._guard.outside(start + (inside + 1) * step) is None:
                inside += 1
            found.append(sign * min(room, inside * ROOM_STEP))
        return found[0] if found[0] >= -found[1] else found[1]

    # parts of the script

    def _asked(
        self, question: str, q: Floats, *, for_way: bool = False
    ) -> Generator[Command, Measurement, Answer | SeenWay]:
        if self._operator is None:
            return Answer.YES
        self._operator.ask(question, for_way=for_way)
        while (answer := self._operator.answer()) is None:
            yield Command(q_target=q)
        self._quits = answer is Answer.QUIT
        return answer

    def _hold(self, q: Floats) -> Script:
        for _ in range(max(1, round(SETTLE_S / self._period_s))):
            measurement = yield Command(q_target=q)
        return measurement

    def _move(self, joint: int, q_from: Floats, angle: float, speed: float, *, watched: bool = True) -> Script:
        """Move a joint; where something presses on the array meanwhile, back the way that it came."""
        way = np.zeros_like(q_from)
        way[joint] = angle * self._model.radian[joint]
        cycles = max(1, round(PEAK_OVER_MEAN_SPEED * abs(angle) / speed / self._period_s))
        for k in range(1, cycles + 1):
            share = smooth_step(k / cycles)
            measurement = yield Command(q_target=q_from + share * way)
            if watched and self._presses(joint, measurement):
                yield from self._hold(q_from + share * way)
                return (yield from self._move(joint, q_from + share * way, -share * angle, speed, watched=False))
        return (yield from self._hold(q_from + way))

    def _presses(self, joint: int, measurement: Measurement) -> bool:
        """Whether something presses on the array while a joint moves."""
        sample = measurement.tactile
        if self.reader is None or sample is None:
            return False
        force = self.reader.read(sample).force
        self._force = max(force, self._force or 0.0)
        if force > TOUCH_FORCE:
            self._pressed = (
                f"the array showed {force:.2f} N while joint {joint + 1} moved alone, and it went back: move the arm"
                " away from what it touches, or look for another joint that moves"
            )
        return self._pressed is not None
