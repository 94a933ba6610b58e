"""Whether the arm can do the task: reach, joint stops and joint speeds along the whole path."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.planning.contact import contact_problems, first_touch_problems, force_problems, saturation_problem
from canprobe.cell.planning.model import JointSpeeds
from canprobe.cell.scene.setup import Arm, Calibrate, Free, Probe, SafetyLimits, Setup, Touch
from canprobe.errors import PlanError, at_least, at_most
from canprobe.mechanics.robot.chain import forward, forward_jacobian
from canprobe.mechanics.robot.inverse import ERROR_LENGTH_M, in_rows, inverse_near, task_rows
from canprobe.mechanics.robot.probe_poses import probe_pose, start_posture
from canprobe.mechanics.types import Floats

if TYPE_CHECKING:
    from canprobe.cell.planning.surface_path import SurfacePath

_METRES_GUESS_M = 6e-3
"""Distance from the origin of the base below which a place was hardly meant in mm; the lifted start may add some mm."""
_PATH_MOVE_RAD = 0.3  # between two points of a path; farther away lies another branch
_MIN_SINGULAR = 1e-3  # of the Jacobian in rows of a posture from which an arm cannot go on
_TOUCH_MOVE_RAD = 1.0  # between the touches of a calibration, and from the approach to the first contact
DEVIATION_RAD = math.radians(1.0)
"""Angle by which the joints of a touch may go beyond its planned way, which knows neither depth nor servo; for a
prismatic one see `ArmModel.radian`. Without the last retreat, which no stop ends; near a singular posture there is no
such bound."""
MAX_OFF_M = 0.3e-3
"""Distance of the probe from a pose on a carrier beyond which that is out of reach, m: a step falls short by less."""
PARKED_ABOVE_M = 5e-3
"""Height of an emulated arm above the approach's first point at power on, m."""


def check_motion(setup: Setup, arm: Arm) -> tuple[JointSpeeds | None, list[str]]:
    """Joint speeds that the task needs, and why the arm cannot do it; empty where it can."""
    stops = _Stops(arm, setup.limits)
    problems = stops.start_problems()
    if (lacking := _lacking_rows(setup)) is not None:
        return None, [*problems, lacking]
    speeds: JointSpeeds | None
    try:
        match setup.task:
            case Free() as task:
                speeds, found = _check_swing(task, stops, starts=not problems)
            case Calibrate() as task:
                from canprobe.cell.planning.surface_path import joints_on_way, round_ball

                ball, q_start = task, _beginning(setup, task, _over_ball(task))
                _follow(task.arm, task.probe, _over_ball(task), q_start)
                joints = joints_on_way(task.arm, task.probe, q_start, lambda pose: round_ball(ball, pose))
                speeds, found = stops.speeds(np.zeros_like(task.arm.q_start)), stops.problems(joints, touching=True)
                kappas = np.full((1, 2), 1.0 / task.ball_radius)
                found += [problem] if (problem := saturation_problem(task, kappas, lambda _: True)) is not None else []
                found += [*force_problems(setup, task), *first_touch_problems(setup, task, kappas[0].tolist())]
            case Touch() as task:
                from canprobe.cell.planning.surface_path import surface_path

                path = surface_path(task, setup.truth.object)
                if path.hollow_radius <= task.probe.radius:
                    problems.append(
                        f"object: a hollow of radius {1e3 * path.hollow_radius:.3g} mm is tighter than the probe of"
                        f" radius {1e3 * task.probe.radius:g} mm, which touches it in more than one place; use a"
                        " smaller probe or another object"
                    )
                contacts = [*_along_path(task, path)][_POSES_BEFORE_CONTACT:]
                speeds, found = _check_touch(task, path, stops, _beginning(setup, task, contacts))
                found += force_problems(setup, task)
                if path.hollow_radius > task.probe.radius:
                    found += first_touch_problems(setup, task, path.kappas[0].tolist())
            case _:
                return None, problems
    except PlanError as error:
        return None, [*problems, *error.problems]
    return speeds, problems + found


def parked_posture(setup: Setup, arm: Arm) -> Floats:
    """Posture of an emulated arm at power on (n,), rad or m: above the start of a touch, else as in the scene.

    Raises:
        PlanError: when it cannot stand there.
    """
    touch = setup.touch
    if touch is None:
        return arm.q_start
    clearance = touch.approach.clearance
    try:
        return start_posture(
            arm.model,
            touch.approach.start,
            touch.approach.normal,
            arm.q_start,
            radius_m=touch.probe.radius,
            T_flange_probe=touch.probe.T_flange_probe,
            clearance_m=clearance + PARKED_ABOVE_M,
        )
    except (PlanError, ValueError) as error:
        raise PlanError(
            [
                f"task.clearance_mm = {1e3 * clearance:g}: an emulated arm begins {1e3 * PARKED_ABOVE_M:g} mm above it,"
                f" and cannot: {error}; lower it, move the object, or set start_deg of the joints to another branch"
            ]
        ) from error


def reach_problems(setup: Setup, task: Touch, poses: Iterable[tuple[Floats, Floats]]) -> list[str]:
    """Why the arm of a touch cannot go through poses of its probe.

    Args:
        setup: the closed setup.
        task: its task.
        poses: centre (3,), m, and pole (3,) away from the object, base frame.
    """
    targets = [_Pose(centre, pole, _TOUCH_MOVE_RAD, "out of reach: {why}") for centre, pole in poses]
    try:
        return _Stops(task.arm, setup.limits).problems(_follow(task.arm, task.probe, targets, task.arm.q_start))
    except PlanError as error:
        return list(error.problems)


def _lacking_rows(setup: Setup) -> str | None:
    """Problem where the arm cannot pose the probe as the task needs on any path; else None."""
    arm, task = setup.arm, setup.task
    if arm is None or not isinstance(task, Touch | Calibrate):
        return None
    rows, name = task_rows(arm.model), arm.model.name
    if isinstance(task, Calibrate) and rows < 5:
        return f"task.kind: a calibration tilts the probe, and the {name} arm of {arm.model.n} joints cannot choose it"
    T, J = forward_jacobian(arm.model.chain, arm.q_start, task.probe.T_flange_probe)
    held = in_rows(rows, T[:3, :3], J) * arm.model.radian
    held[:3] /= ERROR_LENGTH_M
    weakest = float(np.linalg.svd(held, compute_uv=False)[-1]) if len(held) <= arm.model.n else 0.0
    if weakest > _MIN_SINGULAR:
        return None
    what = {3: "its position", 5: "its position and pole", 6: "its pose"}[rows]
    return (
        f"joints: in its start posture the {name} arm of {arm.model.n} joints cannot move the probe's centre and pole "
        f"in every direction that a touch needs ({what}; smallest singular value {weakest:.2g}, needed "
        f"{_MIN_SINGULAR:g}): start from another posture, or use an arm that can"
    )


@dataclass(frozen=True, slots=True)
class _Stops:
    """Stops and highest speeds of the joints, less the margins that the limits keep."""

    arm: Arm
    limits: SafetyLimits

    def inside(self, low: Floats, high: Floats) -> NDArray[np.bool_]:
        """For each joint whether a range of positions, (n,) rad or m each, is allowed."""
        model = self.arm.model
        margin = self.limits.joint_margin
        return (low >= model.q_min + margin) & (high <= model.q_max - margin)

    def allowed(self, joint: int) -> str:
        """A joint's range, for people."""
        a, kept = self.arm.model.joints[joint], float(self.limits.joint_margin[joint])
        low, high, margin = a.shown(a.q_min), a.shown(a.q_max), a.shown(kept)
        return f"{low + margin:g} to {high - margin:g} {a.unit} ({margin:g} {a.unit} from its stops)"

    def start_problems(self) -> list[str]:
        """Joints that would start outside."""
        q, joints = self.arm.q_start, self.arm.model.joints
        return [
            f"joints.{joints[i].name}.start_{joints[i].unit}: at {joints[i].text(q[i], 'g')}, allowed {self.allowed(i)}"
            for i in np.flatnonzero(~self.inside(q, q)).tolist()
        ]

    def problems(self, joints: Floats, *, touching: bool = False) -> list[str]:
        """Joints that would leave their range, of positions (m, n) rad or m; a touch may lead them somewhat farther."""
        its, farther = self.arm.model.joints, DEVIATION_RAD * touching * self.arm.model.radian
        low, high = joints.min(axis=0), joints.max(axis=0)
        near = "and {} less, by which a touch may lead it farther; "
        return [
            f"task: joint {i + 1} would move from {its[i].shown(low[i]):.1f} to {its[i].text(high[i])}, "
            f"allowed {self.allowed(i)}; {near.format(its[i].text(farther[i])) * touching}"
            "move the object, shorten the path, or raise task.rolling_share"
            for i in np.flatnonzero(~self.inside(low - farther, high + farther)).tolist()
        ]

    def speeds(self, needed: Floats) -> JointSpeeds:
        """Needed speeds (n,), rad/s or m/s, beside what is allowed."""
        joints, limit = self.arm.model.joints, self.arm.model.qd_max * self.limits.speed_share
        return JointSpeeds(
            tuple(joint.shown(rate) for joint, rate in zip(joints, needed.tolist(), strict=True)),
            tuple(joint.shown(rate) for joint, rate in zip(joints, limit.tolist(), strict=True)),
            tuple(f"{joint.unit}/s" for joint in joints),
        )


def _too_fast(speeds: JointSpeeds, way_out: str) -> list[str]:
    """One line for every joint that would have to be too fast."""
    each = zip(speeds.needed, speeds.limit, speeds.units, strict=True)
    return [
        f"task: joint {i} would need {need:.4g} {unit}, allowed {limit:.4g}; {way_out}"
        for i, (need, limit, unit) in enumerate(each, start=1)
        if need > limit
    ]


def _beginning(setup: Setup, task: Touch | Calibrate, contacts: Iterable[_Pose]) -> Floats:
    """Posture from which the arm moves (n,), rad or m, as far as it is known.

    Raises:
        PlanError: when an emulated arm cannot be parked; or the contacts are out of reach, which is reported instead.
    """
    if not setup.emulates:
        return task.arm.q_start
    try:
        return parked_posture(setup, task.arm)
    except PlanError:
        _follow(task.arm, task.probe, contacts, task.arm.q_start)
        raise


def _check_touch(
    task: Touch, path: SurfacePath, stops: _Stops, q_start: Floats
) -> tuple[JointSpeeds | None, list[str]]:
    from canprobe.cell.planning.surface_path import joints_on_way, over_path
    from canprobe.mechanics.touch.strategies import Rectangle

    if (unreached := _unreached(task, path, stops, q_start)) is not None:
        return None, [unreached]
    joints = _follow(task.arm, task.probe, _along_path(task, path), q_start)
    gone = joints_on_way(task.arm, task.probe, q_start, lambda pose: over_path(task, path, pose))
    problems = stops.problems(gone, touching=True)
    if path.hollow_radius > task.probe.radius:  # a tighter hollow is refused elsewhere
        at_contacts = joints[_POSES_BEFORE_CONTACT:]
        problems += contact_problems(task, at_contacts, path.normals, path.kappas, stops.limits.force_max)
    approach = task.approach
    down = stops.speeds(np.abs(joints[_POSES_BEFORE_CONTACT] - joints[1]) / approach.clearance * approach.speed)
    slowly = 1e3 * approach.speed / max(down.worst_share, 1.0) * 0.99
    problems += _too_fast(down, f"lower task.approach_mm_s to {at_most(slowly)}")
    carried, elsewhere = _check_carried(task, path, stops, joints[_POSES_BEFORE_CONTACT])
    problems += elsewhere
    if task.scan is None:
        speeds = stops.speeds(carried)
        return speeds, problems + _too_fast(speeds, "let the carrier move slower")
    steps = np.linalg.norm(np.diff(path.points, axis=0), axis=1)
    rates = np.abs(np.diff(joints[_POSES_BEFORE_CONTACT:], axis=0)) / steps[:, None] * task.scan.speed
    speeds = stops.speeds(np.maximum(rates.max(axis=0), carried))
    if isinstance(task.scan.strategy, Rectangle):  # the path may take any direction
        along, across = np.abs(np.diff(path.points, axis=0) @ task.approach.axes[:2].T).T
        speeds = stops.speeds(np.hypot(rates[along >= across].max(axis=0), rates[along < across].max(axis=0)))
    possible = 1e3 * task.scan.speed / max(speeds.worst_share, 1.0) * 0.99
    way_out = f"lower task.speed_mm_s to {at_most(possible)}, turn task.heading_deg, or raise task.rolling_share"
    return speeds, problems + _too_fast(speeds, way_out)


def _check_carried(task: Touch, path: SurfacePath, stops: _Stops, q_start: Floats) -> tuple[Floats, list[str]]:
    """Highest joint speeds (n,), rad/s or m/s, of a run on a carrier, and why the arm cannot do it; 0 without one.

    The joints follow the poses as those of the task will.

    Args:
        q_start: joint positions at the first contact (n,), rad or m.
    """
    if (carrier := task.carrier) is None:
        return np.zeros_like(q_start), []
    from canprobe.cell.planning.surface_path import carried, in_mm
    from canprobe.mechanics.touch.probe_motion import PoseSteps

    steps, joints, rates, before = PoseSteps(task.arm.model, task.probe.T_flange_probe, q_start), [q_start], [], None
    for t, seconds, pose in carried(task, carrier, path):
        move = np.array(steps.step(joints[-1].tolist(), pose, seconds))
        if before is not None and float(np.linalg.norm(steps.at.flange - before.centre)) > MAX_OFF_M:
            place = f"the probe's centre at {in_mm(before.centre)} mm is out of reach"
            raise PlanError([f"carrier: {t:.1f} s into the run {place}; shorten task.duration_s, or move the object"])
        joints.append(joints[-1] + move)
        rates.append(np.abs(move) / seconds)
        before = pose
    return np.max(rates, axis=0), stops.problems(np.array(joints), touching=True)


def _unreached(task: Touch, path: SurfacePath, stops: _Stops, q_start: Floats) -> str | None:
    """Problem with the part of an explored rectangle that the arm cannot reach; None without such a part."""
    from canprobe.mechanics.touch.strategies import Rectangle, turn_radius

    if task.scan is None or not isinstance(rectangle := task.scan.strategy, Rectangle):
        return None
    if min(rectangle.length, rectangle.width) < (least := 4.0 * turn_radius(task.scan.speed, task.gains.tilt_hz)):
        slower = 1e3 * task.scan.speed * min(rectangle.length, rectangle.width) / least
        return (
            f"task.length_mm and width_mm: an exploration at {1e3 * task.scan.speed:g} mm/s needs {1e3 * least:.3g} mm "
            f"to turn round; make the rectangle larger, or lower task.speed_mm_s to {at_most(slower)}"
        )
    why, missed, q = "", [], q_start
    contacts = itertools.islice(_along_path(task, path), _POSES_BEFORE_CONTACT, None)
    for pose, point in zip(contacts, path.points, strict=True):
        try:
            (found,) = _follow(task.arm, task.probe, [pose], q)
        except PlanError as error:
            missed.append(point)
            why = why or error.problems[0].removeprefix("task: ").partition("; ")[0]
            continue
        if (outside := np.flatnonzero(~stops.inside(found, found))).size:
            missed.append(point)
            i = int(outside[0])
            joint = task.arm.model.joints[i]
            why = why or f"joint {i + 1} would be at {joint.text(found[i])}, allowed {stops.allowed(i)}"
        else:
            q = found
    if not missed:
        return None
    flat = 1e3 * (np.array(missed) - path.points[0]) @ task.approach.axes[:2].T
    (a, b), (c, d) = zip(flat.min(axis=0).tolist(), flat.max(axis=0).tolist(), strict=True)
    return (
        f"task: {100 * len(missed) / len(path.points):.0f} % of the rectangle cannot be reached, within {a:.0f} to "
        f"{b:.0f} mm along the heading and {c:.0f} to {d:.0f} mm across it: {why}; shorten task.length_mm or "
        "task.width_mm, turn task.heading_deg, or move task.start_mm"
    )


def _check_swing(task: Free, stops: _Stops, *, starts: bool) -> tuple[JointSpeeds, list[str]]:
    start, swing = task.arm.q_start, np.abs(task.swing)
    speeds = stops.speeds(swing * 2 * math.pi / task.period_s)
    problems = stops.problems(np.array((start - swing, start + swing))) if starts else []
    slower = task.period_s * max(speeds.worst_share, 1.0) * 1.01
    keys = " and ".join(dict.fromkeys(f"swing_{joint.unit}" for joint in task.arm.model.joints))
    way_out = f"swing slower (task.swing_period_s = {at_least(slower)}) or less ({keys} of the joints)"
    return speeds, problems + _too_fast(speeds, way_out)


@dataclass(frozen=True, slots=True)
class _Pose:
    """A pose of the probe, the joint move that is allowed to reach it, and the message where it is out of reach.

    Attributes:
        centre: centre of the probe (3,), m, base frame.
        pole: unit vector (3,) from the centre away from the object, base frame.
        most_rad: largest move of a joint from the pose before, see `inverse_near`; farther away lies another branch.
        out_of_reach: message, with a place for the reason.
    """

    centre: Floats
    pole: Floats
    most_rad: float
    out_of_reach: str


_POSES_BEFORE_CONTACT = 2


def _along_path(task: Touch, path: SurfacePath) -> Iterator[_Pose]:
    """The beginning of the approach and the lifted start, then the contacts."""
    from canprobe.cell.planning.surface_path import in_mm, poles_at_contacts

    radius, poles, approach = task.probe.radius, poles_at_contacts(task, path), task.approach
    above = approach.start + approach.normal * approach.clearance
    lifted = path.points[0] + path.normals[0] * approach.clearance
    points, normals = (above, lifted, *path.points), (approach.normal, path.normals[0], *path.normals)
    turns = (math.inf, *[_TOUCH_MOVE_RAD] * 2, *[_PATH_MOVE_RAD] * (len(path.points) - 1))
    for point, normal, pole, most_rad in zip(points, normals, (approach.normal, poles[0], *poles), turns, strict=True):
        metres = " (are these metres?)" if np.abs(point).max() < _METRES_GUESS_M else ""
        out_of_reach = (
            f"task: contact at {in_mm(point)} mm{metres} out of reach: {{why}}; move the object, shorten the probe "
            "or the path, or set start_deg of the joints to another branch"
        )
        yield _Pose(point + radius * normal, pole, most_rad, out_of_reach)


def _over_ball(task: Calibrate) -> Iterator[_Pose]:
    """The pose above each touch, and the pose at it."""
    for number, touch in enumerate(task.approaches, start=1):
        out_of_reach = (
            f"task: touch {number} of {len(task.approaches)} is out of reach: {{why}}; move the ball, or lower "
            "task.tilt_deg or task.beside_deg"
        )
        for gap in (task.approach.clearance, 0.0):
            centre = task.ball_centre + (task.ball_radius + task.probe.radius + gap) * touch.n_base
            yield _Pose(centre, -touch.pole_base, _TOUCH_MOVE_RAD, out_of_reach)


def _follow(arm: Arm, probe: Probe, poses: Iterable[_Pose], q_start: Floats) -> Floats:
    """Joint positions at the poses (m, n), rad or m, each near the one before, from those at the beginning (n,) on.

    Raises:
        PlanError: the first pose that is out of reach.
    """
    q = q_start
    x_hint = (forward(arm.model.chain, q) @ probe.T_flange_probe)[:3, 0]
    found: list[Floats] = []
    for pose in poses:
        try:
            T_base_probe = probe_pose(pose.centre, pose.pole, 0.0, x_hint)
            most_rad = pose.most_rad if found else math.inf
            q = inverse_near(arm.model, T_base_probe, probe.T_flange_probe, q, max_move_rad=most_rad, q_rest=q_start)
        except (PlanError, ValueError) as error:
            raise PlanError([pose.out_of_reach.format(why=error)]) from error
        found.append(q)
    return np.array(found)
