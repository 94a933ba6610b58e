"""The tasks without touch: hold, swing the joints, only listen to the sensor, or check each joint's first motion."""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.master.array import patch_of
from canprobe.cell.master.controller import Command, Controller, Measurement
from canprobe.cell.master.drives import rest_counts
from canprobe.cell.master.supervisor import JointGuard
from canprobe.cell.planning.model import Plan
from canprobe.cell.tasks.task import Task, TaskRecord
from canprobe.mechanics.touch.patch.image import PatchCalibration
from canprobe.mechanics.touch.probe_motion import smooth_step

# The tasks without touch: swing the joints, or only listen to the sensor.

Vector = NDArray[np.float64]


class FreeTask(Task):
    """Swing every joint sinusoidally about where it stood, with a soft start and end.

    Args:
        amplitude: of each joint (n,), rad or m.
        swing_period_s: of the swing.
        duration_s: of the whole task.
        period_s: of the cycle.
    """

    def __init__(self, amplitude: Vector, swing_period_s: float, duration_s: float, period_s: float) -> None:
        self._amplitude = amplitude
        self._omega = 2 * math.pi / swing_period_s
        self._duration = duration_s
        self._soft = min(1.0, duration_s / 4)
        self._period = period_s
        self._t = 0.0
        self._q0: Vector | None = None

    def step(self, measurement: Measurement) -> Command:
        """One cycle."""
        if self._q0 is None:
            assert measurement.q is not None
            self._q0 = measurement.q
        left = self._duration - self._t
        envelope = smooth_step(min(self._t, left) / self._soft)
        target = self._q0 + self._amplitude * (envelope * math.sin(self._omega * self._t))
        self._t += self._period
        return Command(q_target=target, done=left <= 0)


class ListenTask(Task):
    """Read the sensor and do nothing.

    Args:
        calibration: of the array.
        duration_s: how long.
        period_s: of the cycle.
    """

    def __init__(self, calibration: PatchCalibration, duration_s: float, period_s: float) -> None:
        self._calibration = calibration
        self._left = duration_s
        self._period = period_s
        self.taxels: NDArray[np.uint8] | None = None
        self._columns: dict[str, float | Vector] = {}

    def record(self) -> TaskRecord:
        """What it knows so far."""
        return TaskRecord(taxels=self.taxels)

    def step(self, measurement: Measurement) -> Command:
        """One cycle."""
        self._left -= self._period
        if measurement.tactile is not None:
            self.taxels = measurement.tactile.frame.taxels
            patch = patch_of(measurement.tactile, self._calibration)
            self._columns = {
                "sample_cycle": float(measurement.tactile.cycle),
                "force_n": patch.force,
                "pad_u_mm": patch.u * 1e3,
                "pad_v_mm": patch.v * 1e3,
            }
        return Command(done=self._left <= 0, columns=self._columns)


class HoldTask(Task):
    """Stay where the drives are."""

    def step(self, _: Measurement) -> Command:
        """Nothing to do."""
        return Command()


# What a joint's first motion showed, and the operator who looks at it.

TOLERANCE, TOLERANCE_RESTS = 0.05, 0.5
"""How far an encoder's way may be from what was asked: this share, but at least this part of `rest_counts`."""


class Answer(Enum):
    """What an operator says."""

    YES = "yes"
    NO = "no"
    QUIT = "quit"


class Operator(Protocol):
    """Somebody who looks at the arm. The cell goes on meanwhile: `answer` never waits."""

    def ask(self, question: str) -> None:
        """Put a question."""

    def answer(self) -> Answer | None:
        """The answer to it; None until it is given."""


VERBS = {"deg": ("turn", "turned"), "mm": ("move", "moved")}
"""What a joint does and did, by its unit."""


@dataclass(frozen=True, slots=True)
class JointFinding:
    """What became of one joint.

    Attributes:
        joint: from 0.
        start: where it stood, in its unit, as the next two.
        asked: the way of its target; 0 where it was not moved.
        moved: how far it moved, by its own motor's encoder.
        unit: deg or mm.
        fault: what is wrong; None where nothing is.
        skipped: why it was not moved; None where it was.
    """

    joint: int
    start: float
    asked: float = 0.0
    moved: float = 0.0
    fault: str | None = None
    skipped: str | None = None
    unit: str = "deg"

    def __str__(self) -> str:
        where = f"joint {self.joint + 1} at {self.start:.2f} {self.unit}: "
        if self.skipped is not None:
            return where + f"not moved, {self.skipped}"
        way = f"asked {self.asked:+.2f} {self.unit}, {VERBS[self.unit][1]} {self.moved:+.2f} {self.unit}"
        return where + way + (f": {self.fault}" if self.fault is not None else ": as expected")


def find_fault(joint: int, asked: Vector, moved: Vector, rest: Sequence[float], unit: str = "deg") -> str | None:
    """What is wrong with the motors' ways, the joint's own first; None where nothing is.

    Args:
        joint: that was to move, from 0.
        asked, moved: ways of the motors (n,), drive units.
        rest: within which each is at rest (n,), drive units.
        unit: of the joint, deg or mm.
    """
    least = TOLERANCE_RESTS * np.array(rest)
    tolerance = np.maximum(TOLERANCE * np.abs(asked), least)
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


# First motion: each joint alone by a small way, slowly, and what every encoder made of it.
#
# Encoders are compared motor by motor, so that a drive that turns the wrong way, by another gear or not at all is named
# even where wrist joints drag each other's motors along. Whether the joint itself turned the way it must, no encoder
# can show, as a drive's polarity turns target and feedback round together: that is what the operator is asked.

Script = Generator[Command, Measurement, Measurement]
ANGLE = math.radians(1.0)
"""Of a prismatic joint its travel by `ArmModel.radian`: 3.5 mm."""
MOVE_S = 15 / 8 * 0.5
"""With a highest speed of 2 deg/s (7 mm/s): that of the quintic is 15/8 of its mean."""
SETTLE_S = 0.25


class JointCheck(Controller):
    """The controller that moves one joint after the other, forth and back.

    Args:
        plan: of a cell with an arm; a joint that would leave its limits is moved the other way, or not at all.
        operator: asked before each motion, and after it whether the joint moved the right way; None: no questions.

    Attributes:
        findings: one for each joint that its turn has come to.
        start: joint positions (n,), rad or m, before any motion; None as long as they are not known.
    """

    def __init__(self, plan: Plan, operator: Operator | None) -> None:
        assert plan.setup.arm is not None
        self._guard, self._model = JointGuard(plan), plan.setup.arm.model
        self._period_s, self._operator = plan.sync.period_ns * 1e-9, operator
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

    def _joint(self, joint: int, start: Vector) -> Generator[Command, Measurement, JointFinding | None]:
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

    def _way(self, joint: int, start: Vector) -> Vector | None:
        """The change of the joints (n,), rad or m: forwards, or else backwards; None where there is no room."""
        for angle in (ANGLE, -ANGLE):
            way = np.zeros_like(start)
            way[joint] = angle * self._model.radian[joint]
            goal = start + way
            if self._guard.low[joint] <= goal[joint] <= self._guard.high[joint] and self._guard.outside(goal) is None:
                return way
        return None

    # parts of the script

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
        cycles = max(1, round(MOVE_S / self._period_s))
        for k in range(1, cycles + 1):
            yield Command(q_target=q_from + smooth_step(k / cycles) * (q_to - q_from))
        return (yield from self._hold(q_to))
