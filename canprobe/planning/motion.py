"""Can the arm do it: reach, joint stops and joint speeds along the whole path."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from canprobe.errors import PlanError
from canprobe.planning.choices import PITCH_M
from canprobe.planning.model import JointSpeeds
from canprobe.protocol.tactile import SIDE
from canprobe.robot.chain import forward
from canprobe.robot.inverse import inverse_near, probe_pose
from canprobe.scene.setup import Approach, Arm, Calibrate, Free, Probe, SafetyLimits, Setup, Touch
from canprobe.touch.shapes import PlacedShape

# The path that a scan will take over the object as the scene describes it: points, normals, curvature.

Array = NDArray[np.float64]

SAMPLES = 240
"""Points of a path."""
_STEEPEST = math.radians(70.0)  # the servo steers in the scan plane: steeper than this it cannot follow


@dataclass(frozen=True, slots=True)
class SurfacePath:
    """Contacts that the task will make.

    Attributes:
        points: (n, 3) m, base frame; the first is where the approach ends.
        normals: (n, 3) outward unit normals there.
        hollow_radius: smallest concave radius met, m; inf without one.
    """

    points: Array
    normals: Array
    hollow_radius: float


def surface_path(task: Touch, shape: PlacedShape | None) -> tuple[SurfacePath | None, list[str]]:
    """Points of the object under the task's path; without a described object the plane that the approach expects.

    Args:
        task: a scan or a press.
        shape: the object.
    """
    approach, down = task.approach, task.approach.normal
    if shape is None:
        points = _plane_points(task)
        return SurfacePath(points, np.tile(down, (len(points), 1)), math.inf), []
    miss = _along(shape, approach.start, down)
    if miss is None or not -approach.search <= miss <= approach.clearance:
        return None, [_missed(approach, miss)]
    contacts = []
    for point in _plane_points(task):
        height = _along(shape, point, down)
        if height is None:
            return None, [_left_object(point)]
        contacts.append(shape.closest(point + height * down))
    points, normals = np.array([c.point for c in contacts]), np.array([c.normal for c in contacts])
    path = SurfacePath(points, normals, shape.tightest_concave_radius(points))
    beside = _beside(task, shape, path)
    return (path, []) if beside is None else (None, [beside])


def _plane_points(task: Touch) -> Array:
    """Points of the path in the scan plane, (n, 3) m; one point for a press."""
    if task.scan is None:
        return task.approach.start[None, :]
    along, across, _ = task.approach.axes
    flat = [task.scan.strategy.point(phase) for phase in np.linspace(0, 2 * math.pi, SAMPLES, endpoint=False)]
    points: Array = task.approach.start + np.array([x * along + y * across for x, y in flat])
    return points


def _along(shape: PlacedShape, point: Array, up: Array) -> float | None:
    """Height of the surface over `point` along `up`, m, by Newton; None where the line misses or grazes it."""
    height = 0.0
    for _ in range(50):
        foot = shape.closest(point + height * up)
        steepness = float(foot.normal @ up)
        if steepness < math.cos(_STEEPEST):
            return None
        if abs(foot.distance) < 1e-9:
            return height
        height -= foot.distance / steepness
    return None


def _missed(approach: Approach, miss: float | None) -> str:
    x, y, z = (1e3 * approach.start).tolist()
    where = f"task.start_mm = ({x:g}, {y:g}, {z:g})"
    if miss is None:
        return f"{where}: the approach does not meet the object; move start_mm over it or the object under it"
    return (
        f"{where}: the object lies {abs(1e3 * miss):.1f} mm {'above' if miss > 0 else 'below'} along the approach, "
        f"searched from {1e3 * approach.clearance:g} mm above to {1e3 * approach.search:g} mm below; move one of them"
    )


def _beside(task: Touch, shape: PlacedShape, path: SurfacePath) -> str | None:
    """Why the probe, before or at its first touch, meets the object where there is no array; None where all is well.

    A hollow that is tighter than the probe is refused as that.
    """
    approach, radius, up = task.approach, task.probe.radius, task.approach.normal
    if path.hollow_radius <= radius:
        return None
    nearest = shape.closest(approach.start + (approach.clearance + radius) * up)
    tilt = math.acos(min(max(float(nearest.normal @ up), -1.0), 1.0))
    mend = f"turn task.approach_normal by {math.degrees(tilt):.0f} deg to the object's normal, or move one of them"
    if nearest.distance <= radius:
        deep = 1e3 * (radius - nearest.distance)
        return (
            f"task.clearance_mm = {1e3 * approach.clearance:g}: the probe would be {deep:.1f} mm in the object before"
            f" its approach, {math.degrees(tilt):.0f} deg beside it; {mend}"
        )
    if radius * tilt > 0.5 * SIDE * PITCH_M:
        return (
            f"task.approach_normal: the first touch would be {1e3 * radius * tilt:.1f} mm beside the middle of the"
            f" array, which reaches {500 * SIDE * PITCH_M:.1f} mm and would not feel it; {mend}"
        )
    return None


def _left_object(point: Array) -> str:
    x, y, z = (1e3 * point).tolist()
    return (
        f"task: at ({x:.1f}, {y:.1f}, {z:.1f}) mm the path leaves the object or meets it steeper than "
        f"{math.degrees(_STEEPEST):.0f} deg; shorten task.length_mm or task.width_mm, or turn task.heading_deg"
    )


# Can the arm do it: reach, joint stops and joint speeds along the whole path.

_BRANCH_RAD = 0.3  # between two points of a path; farther away lies another branch
_TOUCH_TO_TOUCH_RAD = 1.0  # between the touches of a calibration


def check_motion(setup: Setup) -> tuple[JointSpeeds | None, list[str]]:
    """What the task asks of the arm, and what the arm cannot do."""
    if setup.arm is None:
        return None, []
    stops = _Stops(setup.arm, setup.limits)
    problems = stops.start_problems()
    match setup.task:
        case Free() as task:
            return _check_swing(task, stops, problems)
        case Calibrate() as task:
            return _check_ball(task, stops, problems)
        case Touch() as task:
            return _check_touch(task, setup, stops, problems)
    return None, problems


@dataclass(frozen=True, slots=True)
class _Stops:
    """The joints' stops and speeds, less what the limits keep from them."""

    arm: Arm
    limits: SafetyLimits

    def inside(self, low: Array, high: Array) -> NDArray[np.bool_]:
        """For each joint whether a range of positions, (n,) rad or m each, is allowed."""
        model = self.arm.model
        margin = self.limits.joint_margin * model.radian
        inside: NDArray[np.bool_] = (low >= model.q_min + margin) & (high <= model.q_max - margin)
        return inside

    def allowed(self, joint: int) -> str:
        """A joint's range, for people."""
        a, kept = self.arm.model.joints[joint], self.limits.joint_margin * float(self.arm.model.radian[joint])
        low, high, margin = a.shown(a.q_min), a.shown(a.q_max), a.shown(kept)
        return f"{low + margin:g} to {high - margin:g} {a.unit} ({margin:g} {a.unit} from its stops)"

    def start_problems(self) -> list[str]:
        """Joints that would start outside."""
        q, joints = self.arm.q_start, self.arm.model.joints
        return [
            f"arm.start_deg: joint {i + 1} at {joints[i].text(q[i], 'g')}, allowed {self.allowed(i)}"
            for i in np.flatnonzero(~self.inside(q, q)).tolist()
        ]

    def problems(self, joints: Array) -> list[str]:
        """Joints that would leave their range, of positions (m, n) rad or m."""
        low, high, its = joints.min(axis=0), joints.max(axis=0), self.arm.model.joints
        return [
            f"task: joint {i + 1} would move from {its[i].shown(low[i]):.1f} to {its[i].text(high[i])}, "
            f"allowed {self.allowed(i)}; move the object, shorten the path, or raise task.rolling_share"
            for i in np.flatnonzero(~self.inside(low, high)).tolist()
        ]

    def speeds(self, needed: Array) -> JointSpeeds:
        """Needed speeds (n,), rad/s or m/s, beside what is allowed."""
        joints, limit = self.arm.model.joints, self.arm.model.qd_max * self.limits.speed_share
        return JointSpeeds(
            tuple(round(joint.shown(rate), 3) for joint, rate in zip(joints, needed.tolist(), strict=True)),
            tuple(round(joint.shown(rate), 3) for joint, rate in zip(joints, limit.tolist(), strict=True)),
        )


def _too_fast(arm: Arm, speeds: JointSpeeds, way_out: str) -> list[str]:
    """One line for every joint that the task asks to be too fast."""
    each = zip(arm.model.joints, speeds.needed_deg_s, speeds.limit_deg_s, strict=True)
    return [
        f"task: joint {i} would need {need:.0f} {joint.unit}/s, allowed {limit:.0f}; {way_out}"
        for i, (joint, need, limit) in enumerate(each, start=1)
        if need > limit
    ]


def _check_touch(task: Touch, setup: Setup, stops: _Stops, problems: list[str]) -> tuple[JointSpeeds | None, list[str]]:
    path, found = surface_path(task, setup.truth.object)
    problems += found
    if path is None:
        return None, problems
    problems += _hollow_problems(path, task.probe)
    joints, found = _follow(task.arm, task.probe, _along_path(task, path))
    problems += found
    if joints is None:
        return None, problems
    problems += stops.problems(joints)
    if task.scan is None:
        return stops.speeds(np.zeros_like(task.arm.q_start)), problems
    steps = np.linalg.norm(np.diff(path.points, axis=0), axis=1)
    rates = np.abs(np.diff(joints[1:], axis=0)) / steps[:, None] * task.scan.speed
    speeds = stops.speeds(rates.max(axis=0))
    possible = 1e3 * task.scan.speed / max(speeds.worst_share, 1.0) * 0.99
    way_out = f"lower task.speed_mm_s to {possible:.3g}, turn task.heading_deg, or raise task.rolling_share"
    return speeds, problems + _too_fast(task.arm, speeds, way_out)


def _hollow_problems(path: SurfacePath, probe: Probe) -> list[str]:
    if path.hollow_radius > probe.radius:
        return []
    return [
        f"object: a hollow of radius {1e3 * path.hollow_radius:.3g} mm is tighter than the probe of radius "
        f"{1e3 * probe.radius:g} mm, which touches it in more than one place; use a smaller probe or another object"
    ]


@dataclass(frozen=True, slots=True)
class _Pose:
    """Where the probe's centre is, with its pole; how far the joints may move to it, and what is said if they cannot.

    Attributes:
        centre: (3,), m, base frame.
        pole: (3,) from the centre away from the object, base frame.
        most_rad: largest move of a joint from the pose before, see `inverse_near`; farther away lies another branch.
        out_of_reach: message, to be filled with why.
    """

    centre: Array
    pole: Array
    most_rad: float
    out_of_reach: str


def _along_path(task: Touch, path: SurfacePath) -> Iterator[_Pose]:
    """The lifted start, then the contacts."""
    radius, first = task.probe.radius, task.approach.normal
    share = task.scan.rolling_share if task.scan is not None else 1.0
    lifted = path.points[0] + path.normals[0] * task.approach.clearance
    for point, normal in zip((lifted, *path.points), (path.normals[0], *path.normals), strict=True):
        pole = (1 - share) * normal + share * first
        pole /= np.linalg.norm(pole)
        x, y, z = (1e3 * point).tolist()
        out_of_reach = (
            f"task: contact at ({x:.1f}, {y:.1f}, {z:.1f}) mm out of reach: {{why}}; move the object, shorten the "
            "path, or set arm.start_deg to another branch"
        )
        yield _Pose(point + radius * normal, pole, _BRANCH_RAD, out_of_reach)


def _over_ball(task: Calibrate) -> Iterator[_Pose]:
    """Above and at each touch."""
    for number, touch in enumerate(task.approaches, start=1):
        out_of_reach = (
            f"task: touch {number} of {len(task.approaches)} is out of reach: {{why}}; move the ball, or lower "
            "task.tilt_deg or task.beside_deg"
        )
        for gap in (task.approach.clearance, 0.0):
            centre = task.ball_centre + (task.ball_radius + task.probe.radius + gap) * touch.n_base
            yield _Pose(centre, -touch.pole_base, _TOUCH_TO_TOUCH_RAD, out_of_reach)


def _follow(arm: Arm, probe: Probe, poses: Iterable[_Pose]) -> tuple[Array | None, list[str]]:
    """Joint positions at the poses (m, n), rad or m, each near the one before; or the first that is out of reach."""
    q = arm.q_start
    x_hint = (forward(arm.model.chain, q) @ probe.T_flange_probe)[:3, 0]
    found: list[Array] = []
    for pose in poses:
        try:
            T_base_probe = probe_pose(pose.centre, pose.pole, 0.0, x_hint)
            most_rad, q_rest = (pose.most_rad, found[0]) if found else (math.inf, q)
            q = inverse_near(arm.model, T_base_probe, probe.T_flange_probe, q, max_move_rad=most_rad, q_rest=q_rest)
        except (PlanError, ValueError) as error:
            return None, [pose.out_of_reach.format(why=error)]
        found.append(q)
    return np.array(found), []


def _check_ball(task: Calibrate, stops: _Stops, problems: list[str]) -> tuple[JointSpeeds | None, list[str]]:
    joints, found = _follow(task.arm, task.probe, _over_ball(task))
    problems += found
    if joints is None:
        return None, problems
    return stops.speeds(np.zeros_like(task.arm.q_start)), problems + stops.problems(joints)


def _check_swing(task: Free, stops: _Stops, problems: list[str]) -> tuple[JointSpeeds, list[str]]:
    start, swing = task.arm.q_start, np.abs(task.swing)
    speeds = stops.speeds(swing * 2 * math.pi / task.period_s)
    if not problems:
        problems = stops.problems(np.array((start - swing, start + swing)))
    slower = task.period_s * max(speeds.worst_share, 1.0) * 1.01
    way_out = f"swing slower (task.swing_period_s = {slower:.3g}) or less (task.swing_deg)"
    return speeds, problems + _too_fast(task.arm, speeds, way_out)
