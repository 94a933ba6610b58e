"""The probe's pose → joint targets, by one damped Newton step of the inverse kinematics per cycle."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dgesv

from canprobe.cell.joint_guard import outside_workspace
from canprobe.robot.damped import damped_step
from canprobe.robot.kinematics import forward_jacobian
from canprobe.robot.puma260 import PumaModel
from canprobe.touch.servo import ProbePose

Vector = NDArray[np.float64]
SMALL_STEP = 0.01
"""Joint step of one cycle (rad) below which the exact inverse is taken: 230 deg/s at 400 Hz."""


@dataclass(frozen=True, slots=True, eq=False)
class MotionBounds:
    """What a probe's motion keeps to.

    Attributes:
        margin: distance from every joint stop, rad.
        speed_share: of the joints' speed limits.
        workspace: lowest and highest position (2, 3) of the probe's tip, m, base frame; None without one.
        radius: from the probe's centre to its tip, m.
    """

    margin: float = 0.0
    speed_share: float = 1.0
    workspace: Vector | None = None
    radius: float = 0.0


class ProbeMotion:
    """Keeps the commanded joint angles of a probe whose pose is asked for cycle by cycle.

    Each cycle one damped step from the *commanded* joints, never from the measured ones: encoder noise stays out of the
    command, and the step is small enough that its second-order error is gone in the next cycle.

    Args:
        model: the arm.
        flange_probe: transform (4, 4) from the probe's centre frame to the flange.
        q: joint angles to start from (6,), rad.
        period_s: of the cycle.
        bounds: what joints and probe must keep to.
    """

    def __init__(
        self, model: PumaModel, flange_probe: Vector, q: Vector, period_s: float, bounds: MotionBounds
    ) -> None:
        self.q = np.array(q, dtype=float)
        self._model = model
        self._flange_probe = flange_probe
        self._bounds = bounds
        self._step_max: list[float] = (model.qd_max * bounds.speed_share * period_s).tolist()
        self._low, self._high = model.q_min + bounds.margin, model.q_max - bounds.margin
        self._range: list[tuple[float, float]] = list(zip(self._low.tolist(), self._high.tolist(), strict=True))
        self.pose_matrix, _ = forward_jacobian(model, self.q, flange_probe)
        self._x_reference: tuple[float, float, float] = tuple(self.pose_matrix[:3, 0].tolist())
        self.limit: str | None = None
        self.slowed = 0

    @property
    def pose(self) -> ProbePose:
        """The commanded pose."""
        return ProbePose(self.pose_matrix[:3, 3], self.pose_matrix[:3, 2])

    def step(self, pose: ProbePose) -> Vector:
        """Joint targets (6,), rad, one step nearer to ``pose``.

        Sets :attr:`limit` at a joint's stop and outside the workspace; counts in :attr:`slowed` the cycles in which a
        joint could not keep up.
        """
        T, J = forward_jacobian(self._model, self.q, self._flange_probe)
        self.pose_matrix = T
        if self._bounds.workspace is not None:
            self.limit = outside_workspace(T[:3, 3] + self._bounds.radius * T[:3, 2], self._bounds.workspace)
        twist = _pose_error(T.tolist(), pose.centre.tolist(), pose.pole.tolist(), self._x_reference)
        dq = self._increment(J, twist)
        share = max([abs(step) / most for step, most in zip(dq.tolist(), self._step_max, strict=True)])
        if share > 1.0:
            dq /= share
            self.slowed += 1
        self.q = self.q + dq
        if not all([low <= q <= high for q, (low, high) in zip(self.q.tolist(), self._range, strict=True)]):
            self._stop_at_limit()
        return self.q

    def _increment(self, J: Vector, twist: tuple[float, ...]) -> Vector:
        """The exact step; the damped one where the exact step would be no small one, as near a singular pose."""
        _, _, dq, info = dgesv(J, twist)  # LAPACK itself: numpy's wrapper costs four times as much
        if info == 0 and max(map(abs, dq.tolist())) < SMALL_STEP:
            exact: Vector = dq
            return exact
        return damped_step(J, np.array(twist))

    def _stop_at_limit(self) -> None:
        joint = int(np.flatnonzero((self.q < self._low) | (self.q > self._high))[0])
        self.limit = f"joint {joint + 1} at {math.degrees(self.q[joint]):.1f} deg, its stop"
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
