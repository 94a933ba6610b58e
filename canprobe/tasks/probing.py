"""What every task that touches with the probe has: its settings and phases, the probe's motion, what it says in each
cycle.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgesv

from canprobe.cell.controller import Command, TactileSample
from canprobe.cell.supervision import Limits
from canprobe.cell.supervisor import HiddenForce, outside_workspace
from canprobe.robot.chain import forward_jacobian
from canprobe.robot.inverse import damped_step, in_rows, task_rows
from canprobe.robot.model import ArmModel
from canprobe.tasks.sensing import ContactSensing
from canprobe.tasks.task import Task, TaskRecord
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


@dataclass(frozen=True, slots=True, eq=False)
class MotionBounds:
    """What a probe's motion keeps to.

    Attributes:
        margin: distance from every joint stop, rad; for a prismatic joint see `ArmModel.radian`.
        speed_share: of the joints' speed limits.
        workspace: lowest and highest position (2, 3) of the probe's tip, m, base frame; None without one.
        radius: from the probe's centre to its tip, m.
    """

    margin: float = 0.0
    speed_share: float = 1.0
    workspace: Vector | None = None
    radius: float = 0.0


class ProbeMotion:
    """Keeps the commanded joint positions of a probe whose pose is asked for cycle by cycle.

    Each cycle one damped step from the *commanded* joints, never from the measured ones: encoder noise stays out of the
    command, and the step is small enough that its second-order error is gone in the next cycle. An arm follows the rows
    of the pose that it can hold (`task_rows`).

    Args:
        model: the arm.
        flange_probe: transform (4, 4) from the probe's centre frame to the flange.
        q: joint positions to start from (n,), rad or m; more than six joints stay near them.
        period_s: of the cycle.
        bounds: what joints and probe must keep to.
    """

    def __init__(self, model: ArmModel, flange_probe: Vector, q: Vector, period_s: float, bounds: MotionBounds) -> None:
        self.q = np.array(q, dtype=float)
        self._model = model
        self._rows = task_rows(model)
        self._flange_probe = flange_probe
        self._bounds = bounds
        self._rest, self._rest_share = self.q, 2.0 * math.pi * REST_HZ * period_s
        self._step_max: list[float] = (model.qd_max * bounds.speed_share * period_s).tolist()
        margin = bounds.margin * model.radian
        self._low, self._high = model.q_min + margin, model.q_max - margin
        self._range: list[tuple[float, float]] = list(zip(self._low.tolist(), self._high.tolist(), strict=True))
        self.pose_matrix, _ = forward_jacobian(model.chain, self.q, flange_probe)
        self._x_reference: tuple[float, float, float] = tuple(self.pose_matrix[:3, 0].tolist())
        self.limit: str | None = None
        self.slowed = 0

    @property
    def pose(self) -> ProbePose:
        """The commanded pose."""
        return ProbePose(self.pose_matrix[:3, 3], self.pose_matrix[:3, 2])

    def step(self, pose: ProbePose) -> Vector:
        """Joint targets (n,), rad or m, one step nearer to ``pose``.

        Sets :attr:`limit` at a joint's stop and outside the workspace; counts in :attr:`slowed` the cycles in which a
        joint could not keep up.
        """
        T, J = forward_jacobian(self._model.chain, self.q, self._flange_probe)
        self.pose_matrix = T
        if self._bounds.workspace is not None:
            self.limit = outside_workspace(T[:3, 3] + self._bounds.radius * T[:3, 2], self._bounds.workspace)
        twist: tuple[float, ...] | Vector
        if self._rows == 6:
            twist = _pose_error(T.tolist(), pose.centre.tolist(), pose.pole.tolist(), self._x_reference)
        else:
            R, six = T[:3, :3], np.concatenate((pose.centre - T[:3, 3], np.cross(T[:3, 2], pose.pole)))
            J, twist = in_rows(self._rows, R, J), in_rows(self._rows, R, six)
        dq = self._increment(J, twist)
        share = max([abs(step) / most for step, most in zip(dq.tolist(), self._step_max, strict=True)])
        if share > 1.0:
            dq /= share
            self.slowed += 1
        self.q = self.q + dq
        if not all([low <= q <= high for q, (low, high) in zip(self.q.tolist(), self._range, strict=True)]):
            self._stop_at_limit()
        return self.q

    def _increment(self, J: Vector, twist: tuple[float, ...] | Vector) -> Vector:
        """The exact step; the damped one where the exact step would be no small one, as near a singular pose."""
        if J.shape[0] == J.shape[1]:
            _, _, dq, info = dgesv(J, twist)  # LAPACK itself: numpy's wrapper costs four times as much
            if info == 0 and max(map(abs, dq.tolist())) < SMALL_STEP:
                exact: Vector = dq
                return exact
        return damped_step(J, np.asarray(twist), self._rest_share * (self._rest - self.q))

    def _stop_at_limit(self) -> None:
        joint = int(np.flatnonzero((self.q < self._low) | (self.q > self._high))[0])
        self.limit = f"joint {joint + 1} at {self._model.joints[joint].text(self.q[joint])}, its stop"
        self.q = np.clip(self.q, self._low, self._high)


def _pose_error(
    T: list[list[float]], centre: list[float], pole: list[float], x_reference: tuple[float, float, float]
) -> tuple[float, ...]:
    """Twist (6) from the pose ``T`` to a centre and a pole, x as near to the reference as the pole allows.

    Unrolled floats: on 3-vectors numpy costs ten times as much.
    """
    (r00, r01, r02, t0), (r10, r11, r12, t1), (r20, r21, r22, t2), _ = T
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
        angular_speed: mean angular speed of the pole, rad/s.
        at_once: leave with twice the mean speed, which then falls to zero: to let go of what is pressed.
    """

    def __init__(
        self, start: ProbePose, end: ProbePose, speed: float, angular_speed: float = 0.5, *, at_once: bool = False
    ) -> None:
        self._start, self._end, self._at_once = start, end, at_once
        distance = float(np.linalg.norm(end.centre - start.centre))
        angle = math.acos(max(-1.0, min(1.0, float(start.pole @ end.pole))))
        self.duration = max(distance / speed, angle / angular_speed, 0.05)

    def at(self, t: float) -> ProbePose:
        """Pose ``t`` seconds after the start; the end pose afterwards."""
        share = smooth_step(t / self.duration) if not self._at_once else 1.0 - max(1.0 - t / self.duration, 0.0) ** 2
        pole = self._start.pole + share * (self._end.pole - self._start.pole)
        return ProbePose(
            self._start.centre + share * (self._end.centre - self._start.centre), pole / math.sqrt(float(pole @ pole))
        )


# What every task that touches with the probe has: a phase, the probe's motion, and what it says in each cycle.

CYCLES_TO_EFFECT = 2
"""From a SYNC to the moment its command begins to take effect, behind which the drives lag."""
LONGEST_STEP = 4
"""Periods that one command makes up for at most after an overrun; the rest of a longer stall is lost time."""


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
    """Base of the tasks that touch.

    Args:
        lag_s: of the drives behind a ramp.
        limits: of the cell; beyond them the probe retreats and the cell stops.
        sensing: contacts from measurements.
        motion_from: makes the probe's motion from the first joint angles.

    Attributes:
        phase: what it is about.
        reason: why it stopped; None while all is well.
        taxels: last image of the touch itself.
    """

    lets_go = True

    def __init__(
        self,
        lag_s: float,
        limits: Limits,
        sensing: ContactSensing,
        motion_from: Callable[[Vector], ProbeMotion],
    ) -> None:
        self.phase = Phase.MOVE
        self.sensing = sensing
        self.reason: str | None = None
        self.taxels: NDArray[np.uint8] | None = None
        self._limits = limits
        period_s = limits.period_ns * 1e-9
        self._lead_s = CYCLES_TO_EFFECT * period_s + lag_s
        self._motion_from = motion_from
        self._motion: ProbeMotion | None = None
        self._period_s = self._dt = period_s
        self._last_ns: int | None = None
        self._t = 0.0
        self._force = 0.0
        self._hidden, self._off_pad = HiddenForce(), HiddenForce()
        self._columns: dict[str, float | Vector] = {}

    def record(self) -> TaskRecord:
        """What it knows so far."""
        slowed = self._motion.slowed if self._motion is not None else 0
        return TaskRecord(taxels=self.taxels, unplaced=self.sensing.dropped, slowed=slowed)

    def retreat(self, reason: str) -> None:
        """Let go and end for a reason that the cell has."""
        raise NotImplementedError

    def _pass_time(self, t_ns: int) -> None:
        """Where an overrun has swallowed cycles the motion goes on by the time that has passed, within a bound."""
        passed = self._period_s if self._last_ns is None else (t_ns - self._last_ns) * 1e-9
        self._last_ns = t_ns
        self._dt = min(passed, LONGEST_STEP * self._period_s)

    def _enter(self, phase: Phase) -> None:
        self.phase = phase
        self._t = 0.0

    def _done(self) -> ProbePose:
        assert self._motion is not None
        return self._motion.pose

    def _command(self, pose: ProbePose, estimate: SurfaceEstimate | None = None) -> Command:
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
            estimate=estimate,
        )

    def _felt_columns(
        self, sample: TactileSample, patch: Patch, contact: ContactSample | None
    ) -> dict[str, float | Vector]:
        """What an image says, for the log."""
        nothing = np.full(3, np.nan)
        return {
            "phase": float(self.phase),
            "sample_cycle": float(sample.cycle),
            "force_n": patch.force,
            "pad_u_mm": patch.u * 1e3,
            "pad_v_mm": patch.v * 1e3,
            "contact_mm": contact.p_base * 1e3 if contact is not None else nothing,
            "normal": contact.n_base if contact is not None else nothing,
        }
