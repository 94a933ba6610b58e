"""The probe's pose → joint targets, by one damped Newton step of the inverse kinematics per cycle."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from canprobe.robot.damped import damped_step
from canprobe.robot.kinematics import forward_jacobian
from canprobe.robot.puma260 import PumaModel
from canprobe.touch.servo import ProbePose

Vector = NDArray[np.float64]


class ProbeMotion:
    """Keeps the commanded joint angles of a probe whose pose is asked for cycle by cycle.

    Each cycle one damped step from the *commanded* joints, never from the measured ones: encoder noise stays out of the
    command, and the step is small enough that its second-order error is gone in the next cycle.

    Args:
        model: the arm.
        flange_probe: transform (4, 4) from the probe's centre frame to the flange.
        q: joint angles to start from (6,), rad.
        period_s: of the cycle.
        margin: distance to keep from every joint stop, rad.
    """

    def __init__(self, model: PumaModel, flange_probe: Vector, q: Vector, period_s: float, margin: float) -> None:
        self.q = np.array(q, dtype=float)
        self._model = model
        self._flange_probe = flange_probe
        self._step_max = model.qd_max * period_s
        self._low, self._high = model.q_min + margin, model.q_max - margin
        self.pose_matrix, _ = forward_jacobian(model, self.q, flange_probe)
        self._x_reference = np.array(self.pose_matrix[:3, 0])
        self.limit: str | None = None
        self.slowed = 0

    @property
    def pose(self) -> ProbePose:
        """The commanded pose."""
        return ProbePose(self.pose_matrix[:3, 3], self.pose_matrix[:3, 2])

    def step(self, pose: ProbePose) -> Vector:
        """Joint targets (6,), rad, one step nearer to ``pose``; sets :attr:`limit` at a stop, counts in :attr:`slowed` at a speed limit."""
        T, J = forward_jacobian(self._model, self.q, self._flange_probe)
        twist = np.empty(6)
        twist[:3] = pose.centre - T[:3, 3]
        twist[3:] = self._rotation_error(T[:3, :3], pose.pole)
        dq = damped_step(J, twist)
        share = float(np.max(np.abs(dq) / self._step_max))
        if share > 1.0:
            dq /= share
            self.slowed += 1
        self.q = self.q + dq
        outside = np.flatnonzero((self.q < self._low) | (self.q > self._high))
        if outside.size:
            joint = int(outside[0])
            self.limit = f"joint {joint + 1} at {math.degrees(self.q[joint]):.1f} deg, its stop"
            self.q = np.clip(self.q, self._low, self._high)
        self.pose_matrix = T
        return self.q

    def _rotation_error(self, R: Vector, pole: Vector) -> Vector:
        x = self._x_reference - pole * float(self._x_reference @ pole)
        x /= math.sqrt(float(x @ x))
        return 0.5 * (_cross(R[:, 0], x) + _cross(R[:, 1], _cross(pole, x)) + _cross(R[:, 2], pole))


def _cross(a: Vector, b: Vector) -> Vector:
    """Cross product without np.cross, which costs ten times as much on 3-vectors."""
    a0, a1, a2 = a.tolist()
    b0, b1, b2 = b.tolist()
    return np.array((a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0))


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
    """

    def __init__(self, start: ProbePose, end: ProbePose, speed: float, angular_speed: float = 0.5) -> None:
        self._start, self._end = start, end
        distance = float(np.linalg.norm(end.centre - start.centre))
        angle = math.acos(max(-1.0, min(1.0, float(start.pole @ end.pole))))
        self.duration = max(distance / speed, angle / angular_speed, 0.05)

    def at(self, t: float) -> ProbePose:
        """Pose ``t`` seconds after the start; the end pose afterwards."""
        share = smooth_step(t / self.duration)
        pole = self._start.pole + share * (self._end.pole - self._start.pole)
        return ProbePose(
            self._start.centre + share * (self._end.centre - self._start.centre), pole / math.sqrt(float(pole @ pole))
        )
