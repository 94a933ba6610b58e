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
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Protocol

import numpy as np

from canprobe.cell.master.array import make_patch_reader
from canprobe.cell.master.controller import Command, Controller, Measurement
from canprobe.cell.master.position_track import rest_counts
from canprobe.cell.master.supervisor import JointGuard
from canprobe.cell.planning.model import Plan
from canprobe.mechanics.robot.chain import forward
from canprobe.mechanics.robot.motion_profile import smooth_step
from canprobe.mechanics.touch.stops import TOUCH_FORCE
from canprobe.mechanics.types import Floats

TRAVEL_TOLERANCE_SHARE, TRAVEL_TOLERANCE_RESTS = 0.05, 0.5
"""Tolerance of an encoder's way: this share of the commanded way, but at least this part of `rest_counts`."""
SEEN_TOLERANCE_SHARE = 0.25
"""Tolerance of a way that an operator saw, as a share of it: an eye is right within that, and half and twice as far are
outside."""


class Answer(Enum):
    """The answer of an operator."""

    YES = "yes"
    NO = "no"
    QUIT = "quit"


@dataclass(frozen=True, slots=True)
class SeenWay:
    """The way of a motion, as an operator saw or measured it.

    Attributes:
        number: its length; that of a joint is negative in negative direction.
        unit: unit that came with the number, deg or mm; None without one. Millimetres of a joint that turns are those
            of the flange, straight from where it was.
        signed: the number came with a sign; else it goes the way that was asked for.
    """

    number: float
    unit: str | None = None
    signed: bool = True


class Operator(Protocol):
    """A person who watches the arm. The cell goes on meanwhile: `answer` never waits."""

    def ask(self, question: str, *, for_way: bool = False) -> None:
        """Put a question; one for a way may be answered by a number, and yes stands for the way in the question."""

    def answer(self) -> Answer | SeenWay | None:
        """The answer to it; None until it is given."""


VERBS = {"deg": ("turn", "turned"), "mm": ("move", "moved")}
"""Verbs for the motion of a joint, present and past, by its unit."""


@dataclass(frozen=True, slots=True)
class JointFinding:
    """The result of the check of a joint.

    Attributes:
        joint: number of the joint, from 0.
        start: position before the motion, in the joint's unit, as the next two.
        asked: the way of its target; 0 where it was not moved.
        moved: way by its own motor's encoder.
        unit: deg or mm.
        fault: fault that was found; None without one.
        skipped: why it was not moved; None where it was.
        seen: the way that the operator saw, in words; None where nobody saw enough to judge gear and counts.
        unseen: why the operator did not; None where he did, or nobody was asked.
        force: highest force that the array showed meanwhile, N; None without an array that was seen alive.
    """

    joint: int
    start: float
    asked: float = 0.0
    moved: float = 0.0
    fault: str | None = None
    skipped: str | None = None
    unit: str = "deg"
    seen: str | None = None
    unseen: str | None = None
    force: float | None = None

    def __str__(self) -> str:
        where = f"joint {self.joint + 1} at {self.start:.2f} {self.unit}: "
        if self.skipped is not None:
            return where + f"not moved, {self.skipped}"
        way = f"asked {self.asked:+.2f} {self.unit}, {VERBS[self.unit][1]} {self.moved:+.2f} {self.unit}"
        seen = f", seen {self.seen}" if self.seen is not None else ""
        unseen = f"; gear and counts are not known, {self.unseen}" if self.unseen is not None else ""
        return where + way + seen + (f": {self.fault}" if self.fault is not None else f": as expected{unseen}")


def find_seen_fault(seen: float, due: float, unit: str) -> str | None:
    """The fault in the way that an operator saw; None where it is the one that is due, within the tolerance.

    Args:
        seen, due: both ways, in one unit.
        unit: unit of the joint, deg or mm.
    """
    share = seen / due
    if abs(share - 1.0) <= SEEN_TOLERANCE_SHARE:
        return None
    if share < 0.0:
        return f"it {VERBS[unit][1]} the wrong way, as the operator saw it: sign, or polarity (607Eh)"
    return (
        f"it {VERBS[unit][1]} {share:.2f} times as far, as the operator saw it: gear, counts_per_{_OF_COUNTS[unit]}, or"
        " another joint's drive; no encoder shows that"
    )


_OF_COUNTS = {"deg": "turn", "mm": "m"}


def find_fault(joint: int, asked: Floats, moved: Floats, rest: Sequence[float], unit: str = "deg") -> str | None:
    """The fault in the motors' ways, the joint's own first; None without one.

    Args:
        joint: number of the joint that was to move, from 0.
        asked, moved: ways of the motors (n,), drive units.
        rest: distance within which each is at rest (n,), drive units.
        unit: unit of the joint, deg or mm.
    """
    least = TRAVEL_TOLERANCE_RESTS * np.array(rest)
    tolerance = np.maximum(TRAVEL_TOLERANCE_SHARE * np.abs(asked), least)
    wrong = np.abs(moved - asked) > tolerance
    if wrong[joint]:
        share = float(moved[joint] / asked[joint])
        if abs(moved[joint]) <= least[joint]:
            return f"it did not {VERBS[unit][0]}"
        if share < 0:
            return f"it {VERBS[unit][1]} the wrong way"
        return f"it {VERBS[unit][1]} {share:.2f} times as far: gear or encoder resolution"
    if wrong.any():
        other = int(np.argmax(wrong))
        return (
            f"the motor of joint {other + 1} turned by {moved[other]:.0f} counts,"
            f" {asked[other]:.0f} are due to joint {joint + 1}"
        )
    return None


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
                # unwatched: at first the array still shows what pressed, which would turn it round again
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
