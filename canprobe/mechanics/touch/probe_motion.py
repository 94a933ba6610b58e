"""Motion of a probe: lines and arcs between poses, and the joint steps that follow poses, for tasks and for the plan.

A line or an arc gives the pose at a time. `PoseSteps` turns each pose into joints by one Newton step of the inverse
kinematics, damped near singular poses: a task takes one step a cycle, the plan takes longer ones along the path that
the task will go. Why not the whole inverse (`inverse_near`): its iterations do not fit into a cycle, and one step from
a posture a fraction of a millimetre away is exact enough.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from canprobe.mechanics.robot.chain import Posture, ending_in, jacobian, pose_of, posture
from canprobe.mechanics.robot.inverse import damped_step, in_rows, task_rows
from canprobe.mechanics.robot.model import ArmModel
from canprobe.mechanics.robot.motion_profile import smooth_step
from canprobe.mechanics.touch.servo import ProbePose
from canprobe.mechanics.touch.tangent_frames import transported
from canprobe.mechanics.types import Floats, Vec

MOVE_SPEED_M_S, ROUND_SPEED_M_S, RETREAT_SPEED_M_S = 30e-3, 40e-3, 20e-3
"""Mean speeds of the way to an object, round a ball, and off an object, m/s."""
EXTRA_CLEARANCE_M = 2e-3
"""Distance by which a probe draws back farther from a ball than the clearance from which it came, m."""
MAX_EXACT_STEP_RAD = 0.01
"""Largest joint step of the exact inverse that is taken undamped, rad: 230 deg/s in a cycle of 400 Hz."""
REST_RETURN_HZ = 1.0
"""Bandwidth with which joints that a pose leaves free go back to the posture they began with, Hz."""


def solve(J: Floats, twist: Any) -> list[float] | None:
    """The joint step (n,) of a twist (n,) by a square Jacobian; None where it is singular."""
    try:
        step: list[float] = np.linalg.solve(J, twist).tolist()
    except np.linalg.LinAlgError:
        return None
    return step


class PoseSteps:
    """Joint steps that follow the poses of a probe.

    An arm follows the rows of the pose that it can hold (`task_rows`). With six rows the turn about the pole stays as
    near to the first one as the pole allows. Where there are more joints than rows, they stay near the first posture.

    Args:
        model: the arm.
        T_flange_probe: (4, 4) probe frame to flange, m.
        q: (n,) first joint positions, rad or m.
        solve: solver of a square system, as the function `solve`; a control cycle has a quicker one.

    Attributes:
        at: chain and probe in the joints of the last step.
    """

    def __init__(
        self,
        model: ArmModel,
        T_flange_probe: Floats,
        q: Floats,
        solve: Callable[[Floats, Any], list[float] | None] = solve,
    ) -> None:
        self._solve = solve
        self._rows = task_rows(model)
        self._chain = ending_in(model.chain, T_flange_probe)
        self._rest = np.array(q, dtype=float)
        self.at = posture(self._chain, self._rest)
        # why not x of the last step: carried round a cone of 20° the probe would come back turned by 22°
        self._x_reference = self.at.x

    def step(self, q: list[float], pose: ProbePose, dt: float) -> list[float]:
        """The joint step (n,), rad or m, towards a pose.

        Args:
            q: (n,) joint positions before the step, rad or m.
            pose: the pose.
            dt: duration of the step, s.
        """
        self.at = at = posture(self._chain, q)
        J = jacobian(at, at.flange)
        twist: tuple[float, ...] | Floats
        if self._rows == 6:
            twist = _pose_error(at, pose.centre.tolist(), pose.pole.tolist(), self._x_reference)
        else:
            six = np.concatenate((pose.centre - at.flange, np.cross(at.z, pose.pole)))
            R = pose_of(at)[:3, :3]
            J, twist = in_rows(self._rows, R, J), in_rows(self._rows, R, six)
        if J.shape[0] == J.shape[1]:
            exact = self._solve(J, twist)
            if exact is not None and max(map(abs, exact)) < MAX_EXACT_STEP_RAD:
                return exact
        # The exact step is large, as near a singular pose, or there is none. Why not always the damped step: it costs a
        # decomposition in every cycle.
        wish = 2.0 * math.pi * REST_RETURN_HZ * dt * (self._rest - q)
        damped: list[float] = damped_step(J, np.asarray(twist), wish).tolist()
        return damped


def _pose_error(at: Posture, centre: list[float], pole: list[float], x_reference: Vec) -> tuple[float, ...]:
    """Twist (6) from a probe's pose to a centre and a pole, x as near to the reference as the pole allows."""
    # Plain floats are used, as numpy costs ten times as much on 3-vectors
    (r00, r10, r20), (r01, r11, r21), (r02, r12, r22), (t0, t1, t2) = at.x, at.y, at.z, at.flange
    p0, p1, p2 = pole
    (x0, x1, x2), (y0, y1, y2) = transported(x_reference, (p0, p1, p2))
    return (
        centre[0] - t0,
        centre[1] - t1,
        centre[2] - t2,
        # half the sum of the cross products of axes: the rotation of a small error, without an arc cosine
        0.5 * (r10 * x2 - r20 * x1 + r11 * y2 - r21 * y1 + r12 * p2 - r22 * p1),
        0.5 * (r20 * x0 - r00 * x2 + r21 * y0 - r01 * y2 + r22 * p0 - r02 * p2),
        0.5 * (r00 * x1 - r10 * x0 + r01 * y1 - r11 * y0 + r02 * p1 - r12 * p0),
    )


class LineMotion:
    """A straight move of the probe with a quintic time law (zero speed and acceleration at both ends).

    Args:
        start: pose to leave.
        end: pose to reach.
        speed: mean speed, m/s.
        at_once: whether to leave with twice the mean speed, which then falls to zero, as when a press must end at once.
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
    """A move round a centre: direction along a great circle, distance and pole by a quintic time law.

    Args:
        centre: (3,) centre of the ball, m.
        start: pose to leave, not at the centre.
        end: pose to reach; not opposite to the first.
        speed: mean speed, m/s.
    """

    def __init__(self, centre: Floats, start: ProbePose, end: ProbePose, speed: float) -> None:
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
