"""A controller that follows points of a joint trajectory, as the joint trajectory controller of ros2_control does."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

from canprobe.cell.master.controller import Command, Controller, Measurement
from canprobe.cell.master.supervisor import JointGuard
from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.setup import SafetyLimits
from canprobe.cell.tasks.task import MotionTime
from canprobe.errors import UsageError
from canprobe.mechanics.robot.model import ArmModel
from canprobe.mechanics.touch.checks import checked, instance
from canprobe.mechanics.types import Floats

FIRST_POINT_TOLERANCE_RAD = 0.01
"""Largest distance of a first point at time 0 from the arm's position, rad; of a sliding joint by `ArmModel.radian`."""
BRAKE_S = 0.5
"""Time in which an arm comes to rest after a stop."""
CHECKS_PER_SEGMENT = 33
"""Number of instants of each segment at which range, speed and workspace are checked."""


class Trajectory(Controller):
    """Leads the joints from where they stand through points, and holds the last one.

    Between two points each joint follows a cubic in time. Without velocities of the points it passes each as a monotone
    cubic does (Fritsch and Butland): it stays between the two points, and has speed 0 in a point that is an extreme.
    Speeds are continuous, accelerations are not. The motion starts and ends at rest. A motion that leaves the range of
    a joint or the workspace, or is faster than `limits.joint_speed_share` of a joint's speed, is refused before the
    drives are enabled. Lag and torque of the drives are not considered. A trajectory is followed once. Of a stall it
    makes up for four periods, little by little, and ends later by the rest.

    Args:
        plan: plan of a cell with an arm.
        points: (time from the start, s; joint positions (n,), rad or m), in the order of time. A first one at time 0
            must be where the arm stands, within 0.01 rad (3.5 mm).
        velocities: (n,) of each point, rad/s or m/s; by default they follow from the points.
        hold_s: time for which the last point is held before the controller is done.

    Raises:
        UsageError: no arm, no point, times that do not ascend, wrong numbers of joints, or a point out of range.

    Source: Fritsch and Butland, A method for constructing local monotone piecewise cubic interpolants, 1984.
    """

    def __init__(
        self,
        plan: Plan,
        points: Iterable[tuple[float, ArrayLike]],
        velocities: Sequence[ArrayLike] | None = None,
        *,
        hold_s: float = 0.5,
    ) -> None:
        arm = instance("trajectory: plan", plan, Plan).setup.needed_arm("trajectory")
        self._model: ArmModel = arm.model
        self._limits: SafetyLimits = plan.setup.limits
        self._guard = JointGuard(plan)
        self._times, self._q = _table(points, arm.model.n)
        self._given = (
            None if velocities is None else checked("trajectory: velocities", velocities, self._q.shape).copy()
        )
        self._hold_s = float(checked("trajectory: hold_s", hold_s, ()))
        self._time = MotionTime(plan.sync.period_ns)
        self._gone_ns: int | None = None
        self._way: CubicHermiteSpline | None = None
        if reason := self._outside_range():
            raise UsageError(f"trajectory: {reason}")

    @property
    def duration_s(self) -> float:
        """Time of the last point, s from the start."""
        return float(self._times[-1])

    def inspect(self, q: Floats) -> str | None:
        """Why the motion from the joint positions q (n,), rad or m, is refused; None where it is allowed."""
        if self._times[0] == 0.0:
            away = np.abs(self._q[0] - q) / self._model.radian
            if away.max() > FIRST_POINT_TOLERANCE_RAD:
                joint = int(away.argmax())
                its = self._model.joints[joint]
                stands, first = (its.text(float(one[joint]), ".2f") for one in (q, self._q[0]))
                return f"trajectory: joint {joint + 1} stands at {stands}; the first point, at time 0, is at {first}"
        self.lead(q)
        reason = self._outside_way()
        return None if reason is None else f"trajectory: {reason}"

    def lead(self, q: Floats, qd: Floats | None = None) -> None:
        """Start the motion at the joint positions q, without a check.

        Args:
            q: (n,) rad or m.
            qd: (n,) speeds there, rad/s or m/s; 0 by default.
        """
        if self._times[0] == 0.0:
            self._q[0] = q
        else:
            self._times = np.concatenate([[0.0], self._times])
            self._q = np.vstack([q, self._q])
            if self._given is not None:
                self._given = np.vstack([np.zeros_like(q), self._given])
        if len(self._times) == 1:  # nothing but where it stands
            self._times, self._q, self._given = np.array([0.0, 1e-3]), np.vstack([q, q]), None
        speeds = self._given
        if speeds is None:
            speeds = PchipInterpolator(self._times, self._q).derivative()(self._times)
        speeds[0], speeds[-1] = (0.0 if qd is None else qd), 0.0
        self._way = CubicHermiteSpline(self._times, self._q, speeds)

    @classmethod
    def braking(cls, plan: Plan, q: Floats, qd: Floats) -> Trajectory:
        """A trajectory from a motion at q with speed qd (n,) to rest, evenly in `BRAKE_S`, within the joints' range."""
        guard = JointGuard(plan)
        end = np.clip(q + 0.5 * BRAKE_S * qd, guard.low, guard.high)
        way = cls(plan, [(BRAKE_S, end)], hold_s=0.0)
        way.lead(q, qd)
        return way

    def at(self, t_s: float) -> Floats:
        """Joint positions (n,), rad or m, at a time from the start, s; after the last point those at it."""
        assert self._way is not None
        q: Floats = self._way(min(max(t_s, 0.0), self.duration_s))
        return q

    def step(self, measurement: Measurement) -> Command:
        passed_ns = self._time.step(measurement.t_ns)
        if self._gone_ns is None:
            assert measurement.q is not None
            if self._way is None and (reason := self.inspect(measurement.q)):
                raise UsageError(reason)
            passed_ns = self._gone_ns = 0
        self._gone_ns += passed_ns
        t = self._gone_ns * 1e-9
        return Command(q_target=self.at(t), done=t >= self.duration_s + self._hold_s)

    def _outside_range(self) -> str | None:
        for (point, joint), q in np.ndenumerate(self._q):
            low, high = float(self._guard.low[joint]), float(self._guard.high[joint])
            if not low <= q <= high:
                its = self._model.joints[joint]
                where = f"point {point + 1}: joint {joint + 1} at {its.text(q, '.2f')}"
                return f"{where}, outside {its.shown(low):.1f} to {its.text(high)}"
        return None

    def _outside_way(self) -> str | None:
        """A message about a limit that is exceeded between two points, with the time that the speed limit allows."""
        highest = self._model.qd_max * self._limits.speed_share
        assert self._way is not None
        for start_s, end_s in pairwise(self._times.tolist()):
            t = np.linspace(start_s, end_s, CHECKS_PER_SEGMENT)
            q, qd = self._way(t), self._way(t, 1)
            where = f"at {start_s:g} to {end_s:g} s: joint"
            share = np.abs(qd).max(axis=0) / highest
            if share.max() > 1.0:
                joint = int(share.argmax())
                its = self._model.joints[joint]
                asked, limit = (its.text(float(v), ".1f") for v in (share[joint] * highest[joint], highest[joint]))
                return f"{where} {joint + 1} at {asked}/s, limit {limit}/s; give it {share[joint]:.2f} times the time"
            beyond = np.maximum(self._guard.low - q, q - self._guard.high).max(axis=0)
            if beyond.max() > 0.0:
                return f"{where} {int(beyond.argmax()) + 1} leaves its range between the points"
            if self._limits.workspace is not None and (found := next(filter(None, map(self._guard.outside, q)), None)):
                return f"at {start_s:g} to {end_s:g} s: {found}"
        return None


def _table(points: Iterable[tuple[float, ArrayLike]], n: int) -> tuple[Floats, Floats]:
    """Times (m,) s and positions (m, n) of the points, finite and in the order of time."""
    try:
        rows = [(time, positions) for time, positions in points]
    except (TypeError, ValueError) as error:
        raise UsageError(f"trajectory: expected (time, positions) of each point, got {points!r}") from error
    if not rows:
        raise UsageError("trajectory: expected (time, positions) of each point, got no point")
    times = checked("trajectory: times of the points", [time for time, _ in rows], (len(rows),))
    q = checked("trajectory: positions of the points", [positions for _, positions in rows], (len(rows), n))
    if times[0] < 0.0 or (np.diff(times) <= 0.0).any():
        raise UsageError("trajectory: expected times from 0 on, each later than the one before")
    return times, q
