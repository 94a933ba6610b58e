"""The way of a motion that a person asks for: where it goes, how fast it may be, and why it may not be gone.

A way is a row of places, close to each other, each of which is looked at before the motion comes near it: limits,
workspace and keep-out places, and the speed of each joint. A way to a goal is looked at as a whole before anything
moves; that of a jog goes on, place by place, as far as it may. What happens on it is `cell.tasks.hand_motion`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation  # before a cell is live: it takes longer to load than nodes wait

from canprobe.cell.master.supervisor import JointGuard
from canprobe.cell.planning.contact import blind_s, depth_at
from canprobe.cell.planning.model import Plan
from canprobe.cell.planning.units import PROFILE_STOP_S, lag_s
from canprobe.cell.tasks.task import USUAL_SPEED
from canprobe.errors import PlanError, UsageError, did_you_mean
from canprobe.mechanics.robot.inverse import inverse_near
from canprobe.mechanics.robot.motion_profile import MotionProfile
from canprobe.mechanics.touch.checks import checked
from canprobe.mechanics.types import Floats

FAR = 1e6
"""Length of a way without an end, places."""
JERK_S = 0.05
"""Time in which a joint reaches its acceleration limit, s."""
GUIDED_JERK_S = 0.01
"""The same in a guided motion, s, which has to stop soon."""
GUIDED_STOP_S = 0.06
"""Longest time in which a guided motion brakes, s: no faster than it can."""
JOG_GROWTH = 4.0
"""How many times quicker a joint may become in a jog of the probe: beyond it is near a singular pose."""
STEP_RAD, STEP_M = math.radians(0.5), 1e-3
"""Largest distance of two places of a way: of a joint or of the probe's orientation, and of the probe."""
MAX_MOVE_RAD = 0.2
"""Largest motion of a joint from one place to the next: more is another branch, or a singular pose."""
TURN_SPEED_RAD_S = math.radians(30.0)
"""Highest speed at which the probe is turned."""
LINE_SPEED_M_S = 0.25
"""Highest speed of the probe on a line, as that of a robot beside which somebody stands (ISO 10218-1, 5.6.2)."""


class HandWay:
    """A way in joint space; what is measured along it is counted in places.

    Args:
        plan: plan of a cell with an arm.
        start: joint positions (n,), rad or m.
        places: joint positions (n,) of the places after it, at even distances; `UsageError` says why there are no more.
        length: number of them; infinite where the way goes on as far as it may.
        speed: share of the speed limits of the joints.
        most: highest speed, places/s.
        bounded: it is so slow that it can stop at what it touches, see `touch_speed`.
        guided: it is so slow, and its jerk so high, that it brakes within `GUIDED_STOP_S`.
        growth: how many times quicker a joint may become than at the start of a guided motion, which is slower for it.

    Attributes:
        q, tip: joint positions (n,), rad or m, and the probe's tip (3,) in base, m, at each place that was looked at.
        refused: why the next place may not be gone; None where it may, or was not looked at.
        speed, acceleration, jerk: highest ones, places/s, /s² and /s³.
        slowed_by: why it is slower than what was asked for; None where it is not.
    """

    def __init__(
        self,
        plan: Plan,
        start: Floats,
        places: Iterator[Floats],
        length: float,
        speed: float,
        *,
        most: float = math.inf,
        bounded: bool = False,
        guided: bool = False,
        growth: float = 1.0,
    ) -> None:
        arm = plan.setup.needed_arm()
        self._plan, self._model, self._guard = plan, arm.model, JointGuard(plan)
        self._low, self._high = np.minimum(self._guard.low, start), np.maximum(self._guard.high, start)
        self._highest = speed * plan.setup.limits.speed_share * arm.model.qd_max
        self._places, self._most, self._bounded, self._guided = places, most, bounded, guided
        self._growth = growth if guided else 1.0
        self.length = length
        self.q, self.tip = [start], [self._guard.T_base_tip(start)[:3, 3]]
        self.refused: str | None = None
        self.speed = self.acceleration = self.jerk = 1.0
        self.slowed_by: str | None = None
        self._begun = False

    def look(self, place: float) -> str | None:
        """Look at the way up to a place, as far as it goes; returns why it may not be gone so far, or None."""
        last = min(place, self.length)
        while self.refused is None and len(self.q) - 1 < last:
            try:
                q = next(self._places)
            except UsageError as error:
                self.refused = str(error)
                break
            self.refused = self._forbidden(q) or self._too_quick(q)
            if self.refused is None:
                self.q.append(q)
                self.tip.append(self._guard.T_base_tip(q)[:3, 3])
        return self.refused

    def whole(self) -> HandWay:
        """The way, which was looked at to its end.

        Raises:
            UsageError: a joint would leave its range, the probe its workspace, or the arm would come near what it keeps
                out of; with place and time.
        """
        why = self.look(self.length) if self.length else self._forbidden(self.q[0])
        if why is None:
            return self
        if (place := len(self.q)) == 1:
            raise UsageError(f"{why}, at the start of the way")
        percent = 100.0 * place / self.length
        raise UsageError(f"{why}, {self._time_at(place):.2f} s after the start, {percent:.0f} % of the way")

    @property
    def looked_at(self) -> bool:
        """Whether the way was looked at to its end."""
        return len(self.q) - 1 >= self.length

    def at(self, place: float) -> Floats:
        """Joint positions (n,), rad or m, at a place."""
        last = len(self.q) - 1
        place = min(max(place, 0.0), last)
        k = max(0, min(int(place), last - 1))
        joints: Floats = self.q[k] + (place - k) * (self.q[min(k + 1, last)] - self.q[k])
        return joints

    def profile(self, begin: float = 0.0) -> MotionProfile:
        """Its motion from rest to rest, from a place on, by the places that were looked at, at least one."""
        self.look(1.0)
        self._limit()
        self._begun = True
        return MotionProfile(min(self.length, FAR) - begin, self.speed, self.acceleration, self.jerk)

    def tip_way(self) -> float:
        """Mean way of the tip from place to place, m."""
        return float(np.linalg.norm(np.diff(self.tip, axis=0), axis=1).mean()) if len(self.tip) > 1 else 0.0

    def _forbidden(self, q: Floats) -> str | None:
        """Why a place may not be gone; a joint that stands beyond its limits may move back, and no further out."""
        guard, keep_out = self._guard, self._plan.setup.limits.keep_out
        if (outside := np.flatnonzero((q < self._low - 1e-9) | (q > self._high + 1e-9))).size:
            joint = int(outside[0])
            its = self._model.joints[joint]
            return (
                f"joint {joint + 1} would come to {its.text(q[joint])}; it may go from"
                f" {its.shown(guard.low[joint]):.1f} to {its.text(guard.high[joint])}"
            )
        if (why := guard.outside(q)) is None and keep_out is not None:
            why = keep_out.touched(self._model.chain, q)
        return why

    def _too_quick(self, q: Floats) -> str | None:
        """Why a place may not be gone in a motion whose speed and acceleration are set."""
        rates, most = np.abs(q - self.q[-1]), 1.0 + 1e-6
        quick = (rates * self.speed > most * self._highest) | (rates * self.acceleration > most * self._model.qdd_max)
        if not (self._begun and quick.any()):
            return None
        return "the arm comes near a singular pose, where a joint would be too quick; move its joints"

    def _limit(self) -> None:
        """Set the limits of the motion by the places that were looked at."""
        rates = np.abs(np.diff(self.q, axis=0)).max(axis=0, initial=0.0)  # of each joint, per place
        moves = rates > 0.0
        if not moves.any():
            return
        model, self.slowed_by = self._model, None
        fastest = min(self._most, float((self._highest[moves] / rates[moves]).min()))
        acceleration = float((model.qdd_max[moves] / rates[moves]).min()) / self._growth
        stop_s, why = math.inf, ""
        if self._guided:
            # from a speed v it brakes in v / a and the time of one jerk
            stop_s, why = GUIDED_STOP_S - GUIDED_JERK_S, "it has to stop at once where nobody renews it"
        if self._plan.setup.needed_arm().profile_lag:
            stop_s, why = PROFILE_STOP_S, "the drives lag by their way to stop (profile position)"
        if fastest > acceleration * stop_s * (1.0 + 1e-6):
            fastest, self.slowed_by = acceleration * stop_s, f"no faster, as {why}"
        tip_rate = float(np.linalg.norm(np.diff(self.tip, axis=0), axis=1).max())
        touch = touch_speed(self._plan) if self._bounded else None
        if touch is not None and fastest * tip_rate > touch:
            fastest = touch / tip_rate
            self.slowed_by = f"the probe at {1e3 * touch:.1f} mm/s, as it may touch something"
        self.speed, self.acceleration = fastest, acceleration
        self.jerk = acceleration / (GUIDED_JERK_S if self._guided else JERK_S)

    def _time_at(self, place: float) -> float:
        """Time from the start at which a place is reached, s."""
        profile = self.profile()
        t = np.linspace(0.0, profile.duration_s, 1001)
        return float(np.interp(place, [profile.at(one)[0] for one in t.tolist()], t))


def goal_of(plan: Plan, to: str | npt.ArrayLike) -> Floats:
    """Joint positions (n,), rad or m, of a posture's name, or as they are.

    Raises:
        UsageError: no arm, no such posture, or no n numbers.
    """
    arm = plan.setup.needed_arm()
    if not isinstance(to, str):
        return checked("posture", to, (arm.model.n,))
    if (q := arm.postures.get(to)) is None:
        known = ", ".join(arm.postures)
        raise UsageError(f"posture {to}: the cell has {known}{did_you_mean(to, arm.postures)}; [postures] names others")
    return q


def joint_way(
    plan: Plan,
    start: Floats,
    goal: Floats,
    speed: float = USUAL_SPEED,
    *,
    bounded: bool = False,
    guided: bool = False,
) -> HandWay:
    """The way from one posture to another, straight in joints: all joints begin and end together.

    Args:
        plan: plan of a cell with an arm.
        start, goal: joint positions (n,), rad or m.
        speed, bounded, guided: as for `HandWay`.
    """
    arm = plan.setup.needed_arm()
    steps = float((np.abs(goal - start) / (arm.model.radian * STEP_RAD)).max())
    number = math.ceil(steps)
    places = (start + k / number * (goal - start) for k in range(1, number + 1))
    return HandWay(plan, start, places, number, speed, bounded=bounded, guided=guided)


@dataclass(frozen=True, slots=True)
class Jog:
    """What a jog moves: one joint, or the probe in a direction; for its attributes see `OpenCell.jog`.

    Raises:
        UsageError: not one of joint, along and about.
    """

    joint: int | None = None
    along: npt.ArrayLike | None = None
    about: npt.ArrayLike | None = None
    in_probe_frame: bool = False

    def __post_init__(self) -> None:
        if sum(one is not None for one in (self.joint, self.along, self.about)) != 1:
            raise UsageError("jog: expected one of joint, along and about")


def jog_way(plan: Plan, start: Floats, jog: Jog, length: float, speed: float, *, guided: bool = False) -> HandWay:
    """The way of a jog: one joint as far as its range goes, or the probe in a direction.

    Args:
        plan: plan of a cell with an arm.
        start: joint positions (n,), rad or m.
        jog: what moves.
        length: signed, rad or m; infinite: as far as it may go.
        speed: share of the speed limits of the joints, of `LINE_SPEED_M_S` and of `TURN_SPEED_RAD_S`.
        guided: as for `HandWay`.

    Raises:
        UsageError: no such joint, or no direction.
    """
    most, guard, about = jog_speed(plan, jog), JointGuard(plan), jog.about
    if jog.joint is not None:
        goal, i = start.copy(), jog.joint - 1
        low, high = min(guard.low[i], start[i]), max(guard.high[i], start[i])
        goal[i] = min(max(start[i] + length, low), high)
        return joint_way(plan, start, goal, speed, bounded=True, guided=guided)
    direction = checked("jog: direction", jog.along if about is None else about, (3,))
    if (size := float(np.linalg.norm(direction))) == 0.0:
        raise UsageError("jog: expected a direction that is not 0")
    longest = STEP_M if about is None else STEP_RAD
    number = math.ceil(abs(length) / longest) if math.isfinite(length) else math.inf
    step = abs(length) / number if math.isfinite(length) else longest
    direction = direction * (math.copysign(step, length) / size)
    if jog.in_probe_frame:
        direction = guard.T_base_tip(start)[:3, :3] @ direction
    still = np.zeros(3)
    places = _probe_places(plan, start, *((direction, still) if about is None else (still, direction)))
    return HandWay(
        plan, start, places, number, speed, most=speed * most / step, bounded=True, guided=guided, growth=JOG_GROWTH
    )


def _probe_places(plan: Plan, start: Floats, way: Floats, turn: Floats) -> Iterator[Floats]:
    """Joint positions (n,) at the places of the probe along a straight line and about an axis through its tip.

    Args:
        plan: plan of a cell with an arm.
        start: joint positions (n,), rad or m.
        way: (3,) of the tip in base from place to place, m.
        turn: (3,) rotation vector of the probe in base from place to place, rad.

    Raises:
        UsageError: the arm cannot go there, as at the end of its reach.
    """
    arm, guard, q = plan.setup.needed_arm(), JointGuard(plan), start
    T = guard.T_base_tip(start)
    for place in count(1):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(place * turn).as_matrix() @ T[:3, :3], T[:3, 3] + place * way
        try:
            q = inverse_near(arm.model, pose, guard.T_flange_tip, q, max_move_rad=MAX_MOVE_RAD)
        except PlanError as error:
            gone = f"{1e3 * np.linalg.norm(place * way):.1f} mm and {np.degrees(np.linalg.norm(place * turn)):.1f} deg"
            raise UsageError(f"the arm cannot go there, after {gone} of the way: {error}; move its joints") from error
        yield q


def jog_speed(plan: Plan, jog: Jog) -> float:
    """Highest speed of a jog: of a joint, rad/s or m/s, or of the probe, m/s along or rad/s about a direction.

    Raises:
        UsageError: there is no such joint.
    """
    arm = plan.setup.needed_arm()
    if jog.joint is None:
        return LINE_SPEED_M_S if jog.about is None else TURN_SPEED_RAD_S
    if not 1 <= jog.joint <= arm.model.n:
        raise UsageError(f"jog: expected a joint from 1 to {arm.model.n}, got {jog.joint}")
    return float(arm.model.qd_max[jog.joint - 1]) * plan.setup.limits.speed_share


def share_of_speed(speed: float) -> float:
    """A share of the speed limits, above 0 and up to 1.

    Raises:
        UsageError: it is none.
    """
    if not 0.0 < float(checked("speed", speed, ())) <= 1.0:
        raise UsageError(f"speed: expected a share of the joints' limits, above 0 and up to 1, got {speed:g}")
    return float(speed)


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
