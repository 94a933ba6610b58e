"""What every task that touches with the probe has: the probe's motion, the phases, and the order of a cycle."""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgesv

from canprobe.cell.controller import Command, Measurement, TactileSample
from canprobe.cell.supervision import Contact, limits_of
from canprobe.cell.supervisor import outside_workspace
from canprobe.planning.model import Plan
from canprobe.robot.chain import Posture, Vec, ending_in, jacobian, pose_of, posture
from canprobe.robot.inverse import damped_step, in_rows, task_rows
from canprobe.scene.setup import Arm, Probe, SafetyLimits
from canprobe.tasks.sensing import ContactSensing
from canprobe.tasks.task import MotionTime, Task, TaskRecord
from canprobe.touch.contact import ContactSample
from canprobe.touch.patch.image import Patch
from canprobe.touch.servo import ProbePose

if TYPE_CHECKING:
    from canprobe.touch.estimate.answer import SurfaceEstimate


# The probe's pose → joint targets, by one damped Newton step of the inverse kinematics per cycle.

Vector = NDArray[np.float64]
SMALL_STEP = 0.01
"""Joint step of one cycle (rad) below which the exact inverse is taken: 230 deg/s at 400 Hz."""
REST_HZ = 1.0
"""How fast more joints than a pose needs go back to the posture they began with."""


class ProbeMotion:
    """Keeps the commanded joint positions of a probe whose pose is asked for cycle by cycle.

    Each cycle one damped step from the *commanded* joints, never from the measured ones: encoder noise stays out of the
    command, and the step is small enough that its second-order error is gone in the next cycle. An arm follows the rows
    of the pose that it can hold (`task_rows`).

    Args:
        arm, probe: what moves.
        safety: what joints and probe must keep to.
        period_s: of the cycle.
        q: joint positions to start from (n,), rad or m; more than six joints stay near them.

    Attributes:
        limit: what a joint or the workspace forbids; None where nothing does.
        slowed: cycles in which a joint could not keep up.
    """

    def __init__(self, arm: Arm, probe: Probe, safety: SafetyLimits, period_s: float, q: Vector) -> None:
        self.q = np.array(q, dtype=float)
        self._model = model = arm.model
        self._rows = task_rows(model)
        self._chain = ending_in(model.chain, probe.T_flange_probe)
        self._workspace, self._radius = safety.workspace, probe.radius
        self._step_max: list[float] = (model.qd_max * safety.speed_share * period_s).tolist()
        self._rest, self._rest_share = self.q, 2.0 * math.pi * REST_HZ * period_s
        margin = safety.joint_margin
        self._low, self._high = model.q_min + margin, model.q_max - margin
        self._range: list[tuple[float, float]] = list(zip(self._low.tolist(), self._high.tolist(), strict=True))
        self._at = posture(self._chain, self.q)
        self._x_reference = self._at.x
        self.limit: str | None = None
        self.slowed = 0

    @property
    def pose(self) -> ProbePose:
        """The commanded pose."""
        return ProbePose(np.array(self._at.flange), np.array(self._at.z))

    @property
    def pose_matrix(self) -> Vector:
        """The same with the turn about the pole, (4, 4), m."""
        return pose_of(self._at)

    def step(self, pose: ProbePose) -> Vector:
        """Joint targets (n,), rad or m, one step nearer to ``pose``."""
        before = self.q.tolist()
        self._at = at = posture(self._chain, before)
        J = jacobian(at, at.flange)
        if self._workspace is not None:
            self.limit = outside_workspace(np.array(at.flange) + self._radius * np.array(at.z), self._workspace)
        twist: tuple[float, ...] | Vector
        if self._rows == 6:
            twist = _pose_error(at, pose.centre.tolist(), pose.pole.tolist(), self._x_reference)
        else:
            six = np.concatenate((pose.centre - at.flange, np.cross(at.z, pose.pole)))
            R = self.pose_matrix[:3, :3]
            J, twist = in_rows(self._rows, R, J), in_rows(self._rows, R, six)
        dq = self._increment(J, twist)
        share = max([abs(step) / most for step, most in zip(dq, self._step_max, strict=True)])
        if share > 1.0:
            dq = [step / share for step in dq]
            self.slowed += 1
        targets = [q + step for q, step in zip(before, dq, strict=True)]
        self.q = np.array(targets)
        if not all([low <= q <= high for q, (low, high) in zip(targets, self._range, strict=True)]):
            self._stop_at_limit()
        return self.q

    def _increment(self, J: Vector, twist: tuple[float, ...] | Vector) -> list[float]:
        """The exact step; the damped one where the exact step would be no small one, as near a singular pose."""
        if J.shape[0] == J.shape[1]:
            _, _, dq, info = dgesv(J, twist)  # LAPACK itself: numpy's wrapper costs four times as much
            exact: list[float] = dq.tolist()
            if info == 0 and max(map(abs, exact)) < SMALL_STEP:
                return exact
        damped: list[float] = damped_step(J, np.asarray(twist), self._rest_share * (self._rest - self.q)).tolist()
        return damped

    def _stop_at_limit(self) -> None:
        joint = int(np.flatnonzero((self.q < self._low) | (self.q > self._high))[0])
        self.limit = f"joint {joint + 1} at {self._model.joints[joint].text(self.q[joint])}, its stop"
        self.q = np.clip(self.q, self._low, self._high)


def _pose_error(at: Posture, centre: list[float], pole: list[float], x_reference: Vec) -> tuple[float, ...]:
    """Twist (6) from a probe's pose to a centre and a pole, x as near to the reference as the pole allows.

    Unrolled floats: on 3-vectors numpy costs ten times as much.
    """
    (r00, r10, r20), (r01, r11, r21), (r02, r12, r22), (t0, t1, t2) = at.x, at.y, at.z, at.flange
    p0, p1, p2 = pole
    x0, x1, x2 = x_reference
    along = x0 * p0 + x1 * p1 + x2 * p2
    x0, x1, x2 = x0 - along * p0, x1 - along * p1, x2 - along * p2
    size = math.sqrt(x0 * x0 + x1 * x1 + x2 * x2)
    x0, x1, x2 = x0 / size, x1 / size, x2 / size
    y0, y1, y2 = p1 * x2 - p2 * x1, p2 * x0 - p0 * x2, p0 * x1 - p1 * x0
    return (
        centre[0] - t0,
        centre[1] - t1,
        centre[2] - t2,
        0.5 * (r10 * x2 - r20 * x1 + r11 * y2 - r21 * y1 + r12 * p2 - r22 * p1),
        0.5 * (r20 * x0 - r00 * x2 + r21 * y0 - r01 * y2 + r22 * p0 - r02 * p2),
        0.5 * (r00 * x1 - r10 * x0 + r01 * y1 - r11 * y0 + r02 * p1 - r12 * p0),
    )


def smooth_step(u: float) -> float:
    """Quintic from 0 to 1 over ``u`` in 0…1, with zero slope and bend at both ends; constant outside."""
    u = min(max(u, 0.0), 1.0)
    return u * u * u * (10 - 15 * u + 6 * u * u)


class LineMotion:
    """A straight move of the probe with a quintic time law (zero speed and acceleration at both ends).

    Args:
        start: pose to leave.
        end: pose to reach.
        speed: mean speed, m/s.
        at_once: leave with twice the mean speed, which then falls to zero: to let go of what is pressed.
    """

    def __init__(self, start: ProbePose, end: ProbePose, speed: float, *, at_once: bool = False) -> None:
        self._start, self._end, self._at_once = start, end, at_once
        distance = float(np.linalg.norm(end.centre - start.centre))
        angle = math.acos(max(-1.0, min(1.0, float(start.pole @ end.pole))))
        self.duration = max(distance / speed, angle / 0.5, 0.05)  # the pole turns at 0.5 rad/s on average

    def at(self, t: float) -> ProbePose:
        """Pose ``t`` seconds after the start; the end pose afterwards."""
        share = smooth_step(t / self.duration) if not self._at_once else 1.0 - max(1.0 - t / self.duration, 0.0) ** 2
        pole = self._start.pole + share * (self._end.pole - self._start.pole)
        return ProbePose(
            self._start.centre + share * (self._end.centre - self._start.centre), pole / math.sqrt(float(pole @ pole))
        )


class ArcMotion:
    """Round a centre: direction along a great circle, distance and pole by a quintic time law.

    Args:
        centre: of the ball (3,), m.
        start: pose to leave, not at the centre.
        end: pose to reach; not opposite to the first.
        speed: mean speed, m/s.
    """

    def __init__(self, centre: Vector, start: ProbePose, end: ProbePose, speed: float) -> None:
        self._centre, self._poles = centre, (start.pole, end.pole)
        a, b = start.centre - centre, end.centre - centre
        self._radii = float(np.linalg.norm(a)), float(np.linalg.norm(b))
        self._a, self._b = a / self._radii[0], b / self._radii[1]
        self._angle = math.acos(max(-1.0, min(1.0, float(self._a @ self._b))))
        pole_angle = math.acos(max(-1.0, min(1.0, float(start.pole @ end.pole))))
        way = math.hypot(self._angle * max(self._radii), self._radii[1] - self._radii[0])
        self.duration = max(way / speed, pole_angle / 0.7, 0.05)

    def at(self, t: float) -> ProbePose:
        """Pose ``t`` seconds after the start; the end pose afterwards."""
        s = smooth_step(t / self.duration)
        if self._angle > 1e-6:
            direction = math.sin((1 - s) * self._angle) * self._a + math.sin(s * self._angle) * self._b
            direction = direction / math.sin(self._angle)
        else:
            direction = self._b
        radius = self._radii[0] + s * (self._radii[1] - self._radii[0])
        pole = self._poles[0] + s * (self._poles[1] - self._poles[0])
        return ProbePose(self._centre + radius * direction, pole / math.sqrt(float(pole @ pole)))


# What every task that touches with the probe has: phases, and the order of a cycle.

CYCLES_TO_EFFECT = 2
"""From a SYNC to the moment its command begins to take effect, behind which the drives lag."""
RETREAT_SPEED = 20e-3
"""m/s."""


class Phase(IntEnum):
    """Phases of a touch task, in their order; a scan that loses its contact goes to and fro between it and REGAIN."""

    MOVE = 0
    APPROACH = 1
    SETTLE = 2
    SCAN = 3
    RETREAT = 4
    DONE = 5
    REGAIN = 6


class ProbingTask(Task):
    """Base of the tasks that touch: the order of a cycle, and the phases that all of them have.

    Args:
        plan: of a cell with an arm; beyond its limits the probe retreats and the cell stops.
        lag_s: of the drives behind a ramp.
        sensing: contacts from measurements.

    Attributes:
        phase: what it does now.
        sensing: as given.
        reason: why it stopped; None as long as it goes on.
        taxels: last image of the touch itself.
    """

    lets_go = True

    def __init__(self, plan: Plan, lag_s: float, sensing: ContactSensing) -> None:
        self.phase = Phase.MOVE
        self.sensing = sensing
        self.reason: str | None = None
        self.taxels: NDArray[np.uint8] | None = None
        self._setup = plan.setup
        self._touch = Contact(limits_of(plan))
        self._period_s = self._dt = plan.sync.period_ns * 1e-9
        self._time = MotionTime(plan.sync.period_ns)
        self._lead_s = CYCLES_TO_EFFECT * self._period_s + lag_s
        self._motion: ProbeMotion | None = None
        self._line: LineMotion | ArcMotion | None = None
        self._cycle = 0
        self._t = 0.0
        self._floor = 0.0
        self._columns: dict[str, float | Vector] = {}
        self._estimate: SurfaceEstimate | None = None
        self._phases: dict[Phase, Callable[[], ProbePose]] = {
            Phase.MOVE: self._move,
            Phase.APPROACH: self._approach,
            Phase.SETTLE: self._settle,
            Phase.SCAN: self._scan,
            Phase.RETREAT: self._retreat,
            Phase.DONE: self._stay,
            Phase.REGAIN: self._regain,
        }

    def record(self) -> TaskRecord:
        """What it knows so far."""
        slowed = self._motion.slowed if self._motion is not None else 0
        return TaskRecord(taxels=self.taxels, unplaced=self.sensing.dropped, slowed=slowed)

    def step(self, measurement: Measurement) -> Command:
        """One cycle."""
        self._cycle = measurement.cycle
        self._dt = self._time.step(measurement.t_ns) * 1e-9
        if self._motion is None:
            setup = self._setup
            assert measurement.q is not None and setup.arm is not None
            self._motion = ProbeMotion(setup.arm, setup.probe, setup.limits, self._period_s, measurement.q)
            self._begin(self._motion.pose)
        patch = self.sensing.step(measurement)
        if patch is not None and measurement.tactile is not None:
            self._feel(measurement.tactile, patch)
        self._touch.tactile_age = measurement.tactile_age
        self._watch()
        pose = self._phases[self.phase]()
        self._t += self._dt
        return self._command(pose)

    def retreat(self, reason: str) -> None:
        """Let go and end for a reason that the cell has."""
        raise NotImplementedError

    def stop(self) -> None:
        """Let go and be done, from whatever phase."""
        raise NotImplementedError

    def _begin(self, pose: ProbePose) -> None:
        """Start the first move, from where the probe is."""
        raise NotImplementedError

    def _feel(self, sample: TactileSample, patch: Patch) -> None:
        """Take a tactile sample."""
        raise NotImplementedError

    def _watch(self) -> None:
        """Check the touch by the table of conditions."""
        raise NotImplementedError

    def _command(self, pose: ProbePose) -> Command:
        """One step of the probe to a pose, as the cell takes it; a joint's limit on the way makes the task let go."""
        assert self._motion is not None
        target = self._motion.step(pose)
        if self._motion.limit is not None:
            self.retreat(self._motion.limit)
        self._columns["phase"] = float(self.phase)
        done = self.phase is Phase.DONE
        return Command(
            q_target=target,
            done=done and self.reason is None,
            stop_reason=self.reason if done else None,
            columns=self._columns,
            estimate=self._estimate,
        )

    def _felt_columns(
        self, sample: TactileSample, patch: Patch, contact: ContactSample | None
    ) -> dict[str, float | Vector]:
        """What an image says, for the log."""
        return {
            "phase": float(self.phase),
            "sample_cycle": float(sample.cycle),
            "force_n": patch.force,
            "pad_u_mm": patch.u * 1e3,
            "pad_v_mm": patch.v * 1e3,
            "contact_mm": contact.p_base * 1e3 if contact is not None else np.full(3, np.nan),
            "normal": contact.n_base if contact is not None else np.full(3, np.nan),
        }

    # phases: each returns the pose for this cycle

    def _enter(self, phase: Phase) -> None:
        self.phase = phase
        self._t = 0.0

    def _move(self) -> ProbePose:
        assert self._line is not None
        pose = self._line.at(self._t)
        if self._t >= self._line.duration + self._lead_s + 0.1:
            self._floor = self._touch.force  # an array that was pressed for long shows some of it for a while
            self._enter(Phase.APPROACH)
        return pose

    def _approach(self) -> ProbePose:
        raise NotImplementedError

    def _settle(self) -> ProbePose:
        raise NotImplementedError

    def _scan(self) -> ProbePose:
        raise NotImplementedError

    def _regain(self) -> ProbePose:
        raise NotImplementedError

    def _draw_back(self, way: Vector) -> None:
        """Begin the retreat by a way (3,), m, off the object."""
        assert self._motion is not None
        pose = self._motion.pose
        self._line = LineMotion(pose, ProbePose(pose.centre + way, pose.pole), RETREAT_SPEED, at_once=True)
        self._enter(Phase.RETREAT)

    def _retreat(self) -> ProbePose:
        assert self._line is not None
        pose = self._line.at(self._t)
        if self._t >= self._line.duration + self._lead_s:
            self._off()
        return pose

    def _off(self) -> None:
        """The probe is off the object."""
        self._enter(Phase.DONE)

    def _stay(self) -> ProbePose:
        assert self._motion is not None
        return self._motion.pose
