"""The way of a motion that a person asks for: where it goes, how fast it may be, and why it may not be gone.

A way is known as a whole before it begins: joint positions along it, close to each other. So limits, keep-out places
and the speed of each joint are looked at before anything moves; what happens on it is `cell.tasks.hand_motion`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from canprobe.cell.master.supervisor import JointGuard
from canprobe.cell.planning.first_touch import blind_s, depth_at
from canprobe.cell.planning.model import Plan
from canprobe.cell.planning.units import lag_s
from canprobe.errors import PlanError, UsageError, did_you_mean
from canprobe.mechanics.robot.inverse import inverse_near
from canprobe.mechanics.robot.motion_profile import MotionProfile
from canprobe.mechanics.touch.linear_algebra import checked
from canprobe.mechanics.types import Floats

JERK_S = 0.05
"""Time in which a joint reaches its acceleration limit, s."""
USUAL_SPEED = 0.1
"""Share of the speed limits that a motion by hand has where nothing else is asked for."""
STEP_RAD, STEP_M = math.radians(0.5), 1e-3
"""Largest distance of two places of a way: of a joint or of the probe's orientation, and of the probe."""
MAX_MOVE_RAD = 0.2
"""Largest motion of a joint from one place to the next: more is another branch, or a singular pose."""
TURN_SPEED_RAD_S = math.radians(30.0)
"""Highest speed at which the probe is turned."""
LINE_SPEED_M_S = 0.25
"""Highest speed of the probe on a line, as that of a robot beside which somebody stands (ISO 10218-1, 5.6.2)."""


@dataclass(frozen=True, slots=True, eq=False)
class HandWay:
    """A way in joint space, and its limits in its own unit: share of the way, per s, s² and s³.

    Attributes:
        q: joint positions (m, n) along the way, at even shares of it, rad or m.
        tip: the probe's tip (m, 3) there, base, m.
        speed, acceleration, jerk: highest ones.
        slowed_by: why it is slower than what was asked for; None where it is not.
    """

    q: Floats
    tip: Floats
    speed: float
    acceleration: float
    jerk: float
    slowed_by: str | None = None

    def at(self, share: float) -> Floats:
        """Joint positions (n,), rad or m, at a share of the way."""
        place = min(max(share, 0.0), 1.0) * (len(self.q) - 1)
        k = min(int(place), len(self.q) - 2)
        joints: Floats = self.q[k] + (place - k) * (self.q[k + 1] - self.q[k])
        return joints

    def profile(self) -> MotionProfile:
        """Its motion from rest to rest."""
        return MotionProfile(1.0, self.speed, self.acceleration, self.jerk)


def joint_way(
    plan: Plan, start: Floats, to: str | npt.ArrayLike, speed: float = USUAL_SPEED, *, bounded: bool = False
) -> HandWay:
    """The way from one posture to another, straight in joints: all joints begin and end together.

    Args:
        plan: plan of a cell with an arm.
        start: joint positions (n,), rad or m.
        to: the same, or the name of a posture.
        speed: share of the speed limits of the joints, above 0 and up to 1.
        bounded: it is so slow that it can stop at what it touches, see `touch_speed`.

    Raises:
        UsageError: there is no arm, no such posture or no such speed.
    """
    arm = plan.setup.needed_arm()
    if isinstance(to, str) and to not in arm.postures:
        known = ", ".join(arm.postures)
        raise UsageError(f"posture {to}: the cell has {known}{did_you_mean(to, arm.postures)}; [postures] names others")
    goal = arm.postures[to] if isinstance(to, str) else checked("posture", to, (arm.model.n,))
    if not 0.0 < float(checked("speed", speed, ())) <= 1.0:
        raise UsageError(f"speed: expected a share of the joints' limits, above 0 and up to 1, got {speed:g}")
    steps = np.abs(goal - start) / (arm.model.radian * STEP_RAD)
    count = max(1, math.ceil(float(steps.max())))
    joints = start + np.linspace(0.0, 1.0, count + 1)[:, None] * (goal - start)
    return _limited(plan, joints, float(speed), bounded=bounded)


def probe_way(plan: Plan, start: Floats, way: Floats, turn: Floats, speed: float = USUAL_SPEED) -> HandWay:
    """The way of the probe along a straight line and about an axis through its tip.

    Args:
        plan: plan of a cell with an arm.
        start: joint positions (n,), rad or m.
        way: (3,) of the tip in base, m.
        turn: (3,) rotation vector of the probe in base, rad.
        speed: share of the speed limits of the joints, of `LINE_SPEED_M_S` and of `TURN_SPEED_RAD_S`.

    Raises:
        UsageError: the arm cannot go there, as at the end of its reach.
    """
    arm = plan.setup.needed_arm()
    length, angle = float(np.linalg.norm(way)), float(np.linalg.norm(turn))
    count = max(1, math.ceil(max(length / STEP_M, angle / STEP_RAD)))
    guard, rows = JointGuard(plan), [start]
    T = guard.T_base_tip(start)
    for share in np.linspace(0.0, 1.0, count + 1)[1:]:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(share * turn).as_matrix() @ T[:3, :3], T[:3, 3] + share * way
        try:
            rows.append(inverse_near(arm.model, pose, guard.T_flange_tip, rows[-1], max_move_rad=MAX_MOVE_RAD))
        except PlanError as error:
            gone = f"{1e3 * share * length:.1f} mm and {math.degrees(share * angle):.1f} deg"
            raise UsageError(f"the arm cannot go there, after {gone} of the way: {error}; move its joints") from error
    line = LINE_SPEED_M_S / length if length else math.inf
    fastest = min(line, TURN_SPEED_RAD_S / angle if angle else math.inf)
    return _limited(plan, np.array(rows), speed, speed * fastest, bounded=True)


def jog_way(
    plan: Plan,
    start: Floats,
    joint: int | None = None,
    *,
    velocity: float,
    for_s: float,
    along: npt.ArrayLike | None = None,
    about: npt.ArrayLike | None = None,
    in_probe_frame: bool = False,
) -> HandWay:
    """The way of a jog: one joint as far as its range goes, or the probe in a direction; see `OpenCell.jog`.

    Raises:
        UsageError: not one of joint, along and about; no such joint; no speed; or the probe cannot go there.
    """
    arm = plan.setup.needed_arm()
    if [joint, along, about].count(None) != 2:
        raise UsageError("jog: expected one of joint, along and about")
    length = float(checked("jog: velocity", velocity, ())) * float(checked("jog: for_s", for_s, ()))
    if velocity == 0.0 or for_s <= 0.0:
        raise UsageError(f"jog: expected a velocity and a time above 0, got {velocity:g} for {for_s:g} s")
    guard = JointGuard(plan)
    highest = arm.model.qd_max * plan.setup.limits.speed_share
    if joint is not None:
        if not 1 <= joint <= arm.model.n:
            raise UsageError(f"jog: expected a joint from 1 to {arm.model.n}, got {joint}")
        goal, i = start.copy(), joint - 1
        low, high = min(guard.low[i], start[i]), max(guard.high[i], start[i])
        goal[i] = min(max(start[i] + length, low), high)
        return joint_way(plan, start, goal, min(1.0, abs(velocity) / highest[i]), bounded=True)
    direction = checked("jog: direction", along if about is None else about, (3,))
    if (size := float(np.linalg.norm(direction))) == 0.0:
        raise UsageError("jog: expected a direction that is not 0")
    direction = direction * (length / size)
    if in_probe_frame:
        direction = guard.T_base_tip(start)[:3, :3] @ direction
    most = LINE_SPEED_M_S if about is None else TURN_SPEED_RAD_S
    still = np.zeros(3)
    way, turn = (direction, still) if about is None else (still, direction)
    return probe_way(plan, start, way, turn, min(1.0, abs(velocity) / most))


def refuse(plan: Plan, way: HandWay) -> None:
    """Refuse a way that may not be gone, with place and time.

    A joint that stands beyond its limits may move back, and no further out.

    Raises:
        UsageError: a joint would leave its range, the probe its workspace, or the arm would come near what it keeps
            out of.
    """
    arm, limits, guard = plan.setup.needed_arm(), plan.setup.limits, JointGuard(plan)
    low, high = np.minimum(guard.low, way.q[0]), np.maximum(guard.high, way.q[0])
    for k, q in enumerate(way.q):
        why = None
        if (outside := np.flatnonzero((q < low - 1e-9) | (q > high + 1e-9))).size:
            joint = int(outside[0])
            its = arm.model.joints[joint]
            why = (
                f"joint {joint + 1} would come to {its.text(q[joint])}; it may go from"
                f" {its.shown(guard.low[joint]):.1f} to {its.text(guard.high[joint])}"
            )
        why = why or guard.outside(q)
        if why is None and limits.keep_out is not None:
            why = limits.keep_out.touched(arm.model.chain, q)
        if why is not None:
            share = k / (len(way.q) - 1)
            raise UsageError(f"{why}, {_time_at(way, share):.2f} s after the start, {100 * share:.0f} % of the way")


def _time_at(way: HandWay, share: float) -> float:
    """Time from the start at which a share of the way is gone, s."""
    profile = way.profile()
    low, high = 0.0, profile.duration_s
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if profile.at(middle)[0] < share else (low, middle)
    return high


def _limited(plan: Plan, q: Floats, speed: float, most: float = math.inf, *, bounded: bool) -> HandWay:
    """A way with the limits of the joints, no faster than `most`, and slow enough for what it may touch."""
    arm, guard = plan.setup.needed_arm(), JointGuard(plan)
    rates = np.abs(np.diff(q, axis=0)).max(axis=0) * (len(q) - 1)  # of each joint, per way
    moves = rates > 0.0
    if not moves.any():
        return HandWay(q, _tips(guard, q), 1.0, 1.0, 1.0)
    highest = speed * plan.setup.limits.speed_share * arm.model.qd_max
    fastest, slowed_by, tip = min(most, float((highest[moves] / rates[moves]).min())), None, _tips(guard, q)
    tip_rate = float(np.linalg.norm(np.diff(tip, axis=0), axis=1).max()) * (len(q) - 1)
    if bounded and (touch := touch_speed(plan)) is not None and fastest * tip_rate > touch:
        fastest, slowed_by = touch / tip_rate, f"the probe at {1e3 * touch:.1f} mm/s, as it may touch something"
    acceleration = float((arm.model.qdd_max[moves] / rates[moves]).min())
    return HandWay(q, tip, fastest, acceleration, acceleration / JERK_S, slowed_by)


def touch_speed(plan: Plan) -> float | None:
    """Speed of the probe, m/s, at which a plane that it touches is pressed, from `limits.jog_force_n` on, half of the
    way to the force limit until the array has shown it and the drives stand; None without an array."""
    setup = plan.setup
    if setup.array is None:
        return None
    shown = setup.limits.jog_force
    forces = (shown, 0.5 * (shown + setup.limits.force_max))
    depths = [depth_at(force, setup.probe, setup.array, (0.0, 0.0)) for force in forces]
    return (depths[1] - depths[0]) / blind_s(setup.rate_hz, setup.array, lag_s(setup))


def _tips(guard: JointGuard, q: Floats) -> Floats:
    return np.array([guard.T_base_tip(one)[:3, 3] for one in q])
