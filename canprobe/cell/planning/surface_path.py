"""The path of a task over the object as the scene describes it: contacts, the way to them in time, its joints."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from canprobe.cell.planning.contact import edge_margin
from canprobe.cell.planning.model import TASK_OVERHEAD_S
from canprobe.cell.scene.setup import Approach, Arm, Calibrate, Carrier, Probe, Touch
from canprobe.errors import PlanError
from canprobe.mechanics.robot.inverse import FIXED_POLE, task_rows
from canprobe.mechanics.touch.probe_motion import (
    EXTRA_CLEARANCE_M,
    MOVE_SPEED_M_S,
    RETREAT_SPEED_M_S,
    ROUND_SPEED_M_S,
    ArcMotion,
    LineMotion,
    PoseSteps,
)
from canprobe.mechanics.touch.servo import SETTLE_S, ProbePose
from canprobe.mechanics.touch.shapes import ClosestPoint, PlacedShape
from canprobe.mechanics.touch.strategies import Rectangle
from canprobe.mechanics.types import Floats

SAMPLES = 240
"""Number of points of a path."""
LINE_M, MIN_LINES, MAX_LINES = 4e-3, 4, 14
"""Distance between the lines on which a rectangle is checked, m; least and largest number of them."""
CARRIED_STEP_S, MAX_CARRIED_STEPS = 0.05, 10_000
"""Longest step at rest in the check of a run on a carrier, s, and about the largest number of its steps."""
_STEEPEST = math.radians(70.0)  # the servo steers in the scan plane: steeper than this it cannot follow
_RESTS_M = 5e-6  # of a ball, which may stand on two places that differ by so much
_BALL_STEPS = 6  # halves what is left of the way from under the centre to the contact
_PATCH_M = 2e-3  # half of the width of a patch
_BESIDE_M = 1e-6  # of a foot that does not lie under its point along the normal: on the surface's border


@dataclass(frozen=True, slots=True)
class SurfacePath:
    """Contacts that the task will make.

    Attributes:
        points: contact points (n, 3), m, base frame; the approach ends at the first.
        normals: outward unit normals there (n, 3).
        kappas: principal curvatures there (n, 2), 1/m; 0 where a ball bridges gaps that no formula describes.
        hollow_radius: smallest concave radius on the path, m; inf without one.
    """

    points: Floats
    normals: Floats
    kappas: Floats
    hollow_radius: float


def surface_path(task: Touch, shape: PlacedShape | None) -> SurfacePath:
    """Points of the object under the task's path; without an object those of the plane that the approach expects.

    Args:
        task: a scan or a press.
        shape: the object; None where the scene describes none.

    Raises:
        PlanError: when the approach or the path misses the object, or the probe first meets it beside the array.
    """
    approach, down = task.approach, task.approach.normal
    plane = approach.start[None, :]  # points in the scan plane; one for a press
    strategy = task.scan.strategy if task.scan is not None else None
    if isinstance(strategy, Rectangle):
        plane = approach.start + lines_over(strategy) @ approach.axes[:2]
    elif strategy is not None:
        flat = [strategy.point(phase) for phase in np.linspace(0, 2 * math.pi, SAMPLES, endpoint=False)]
        plane = approach.start + np.array(flat) @ approach.axes[:2]
    if shape is None:
        return SurfacePath(plane, np.tile(down, (len(plane), 1)), np.zeros((len(plane), 2)), math.inf)
    # a ball bridges gaps into which a point would fall
    radius = task.probe.radius if shape.by_gaps and not task.array.pad.is_flat else 0.0
    _check_approach(approach, _rest(shape, approach.start, down, radius))
    explores = isinstance(strategy, Rectangle)
    if not task.array.pad.is_flat:
        begins = _first_contact(shape, approach, task.probe.radius)
        plane = np.concatenate([plane[:1] + begins, plane[1:] if explores else plane[1:] + begins])
    if explores:
        plane = touchable(shape, plane, down, task.probe.radius)
    path = _contacts(shape, plane, down, radius)
    if shape.by_gaps:  # the contacts of a rectangle need not lie exactly under its points
        path = _over_patches(path, plane, radius) if explores else _under_ball(shape, path, plane, down, radius)
    if path.hollow_radius > task.probe.radius:  # a tighter hollow is refused elsewhere
        _check_first_touch(task, shape)
    return path


def lines_over(rectangle: Rectangle) -> Floats:
    """(n, 2) points of the scan plane all over a rectangle, m: from its middle to a corner, then lines both ways."""
    sizes = (rectangle.length, rectangle.width)
    counts = [min(max(math.ceil(side / LINE_M) + 1, MIN_LINES), MAX_LINES) for side in sizes]
    x, y = (side * np.linspace(-0.5, 0.5, count) for side, count in zip(sizes, counts, strict=True))
    along = [(a, b) for k, b in enumerate(y) for a in (x if k % 2 == 0 else x[::-1])]
    back = x if along[-1][0] < 0.0 else x[::-1]
    across = [(a, b) for k, a in enumerate(back) for b in (y[::-1] if k % 2 == 0 else y)]
    to_corner = np.linspace(0.0, 1.0, max(counts))[:-1, None] * np.array(along[0])
    return np.concatenate([to_corner, np.array(along), np.array(across)[1:]])


def touchable(shape: PlacedShape, plane: Floats, up: Floats, radius: float) -> Floats:
    """The points (n, 3) of a rectangle under which a probe of a radius (m) touches the object in one place.

    An exploration turns back from the others. The first contact is kept, and refused elsewhere.
    """
    ball = radius if shape.by_gaps else 0.0
    rests = [_rest(shape, point, up, ball) for point in plane]
    one_place = [rest is not None and shape.tightest_concave_radius(rest[1].point[None]) > radius for rest in rests]
    found: Floats = plane[np.array([True, *one_place[1:]])]
    return found


def _first_contact(shape: PlacedShape, approach: Approach, radius: float) -> Floats:
    """Place where a ball first touches (3,), m, across the approach from its end: the path begins there.

    A curve lies round it; a rectangle stays where it is.
    """
    rest = _rest(shape, approach.start, approach.normal, radius)
    if rest is None or shape.tightest_concave_radius(approach.start[None]) <= radius:
        return np.zeros(3)  # in a tighter hollow it touches in two places, which is refused elsewhere
    beside = rest[1].point - approach.start
    return beside - float(beside @ approach.normal) * approach.normal


def _contacts(shape: PlacedShape, plane: Floats, up: Floats, radius: float) -> SurfacePath:
    """Contacts of a ball of `radius` that rests over each point (n, 3); with 0 the points of the surface."""
    contacts = []
    for point in plane:
        rest = _rest(shape, point, up, radius)
        if rest is None:
            raise PlanError(
                [
                    f"task: at {in_mm(point)} mm the path leaves the object or meets it steeper than "
                    f"{math.degrees(_STEEPEST):.0f} deg; shorten task.length_mm or task.width_mm, or turn "
                    "task.heading_deg"
                ]
            )
        contacts.append(rest[1])
    points, normals = np.array([c.point for c in contacts]), np.array([c.normal for c in contacts])
    kappas = np.zeros((len(contacts), 2)) if shape.by_gaps else np.array([c.kappa for c in contacts])
    return SurfacePath(points, normals, kappas, shape.tightest_concave_radius(points))


def _under_ball(shape: PlacedShape, path: SurfacePath, plane: Floats, up: Floats, radius: float) -> SurfacePath:
    """The path of a ball whose contacts, not whose centre, lie over the points of the plane."""
    over = plane
    for _ in range(_BALL_STEPS):
        path = _over_patches(path, plane, radius)
        beside = plane - path.points
        over = over + beside - np.outer(beside @ up, up)
        path = _contacts(shape, over, up, radius)
    return _over_patches(path, plane, radius)


def _over_patches(path: SurfacePath, plane: Floats, radius: float) -> SurfacePath:
    """A ball's path with the normals that its pad shows: each from a linear fit to those near it."""
    beside = plane[None] - plane[:, None]
    weights = np.exp(-0.5 * np.sum((beside / _PATCH_M) ** 2, axis=2))
    terms = np.concatenate((np.ones((*weights.shape, 1)), beside / _PATCH_M), axis=2)
    weighted = (weights[..., None] * terms).transpose(0, 2, 1)
    moments = weighted @ terms + 1e-6 * np.eye(4)  # along a line, nothing is known beside it
    normals = np.linalg.solve(moments, weighted @ path.normals)[:, 0]
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return replace(path, points=path.points + radius * (path.normals - normals), normals=normals)


def in_mm(point: Floats) -> str:
    x, y, z = (1e3 * point).tolist()
    return f"({x:.1f}, {y:.1f}, {z:.1f})"


def _rest(shape: PlacedShape, point: Floats, up: Floats, radius: float) -> tuple[float, ClosestPoint] | None:
    """Height along `up` over `point` at which the foot of a ball of `radius` rests on the surface, m, and the foot.

    None where the line misses or grazes the surface, or the ball rests on its border.
    """
    height = 0.0
    for _ in range(50):
        at = point + (height + radius) * up
        foot = shape.closest(at)
        steepness = float(foot.normal @ up)
        if steepness < math.cos(_STEEPEST) or np.abs(at - foot.point - foot.distance * foot.normal).max() > _BESIDE_M:
            return None
        if abs(foot.distance - radius) < (_RESTS_M if radius else 1e-9):
            return height, foot
        height -= (foot.distance - radius) / steepness
    return None


def _check_approach(approach: Approach, rest: tuple[float, ClosestPoint] | None) -> None:
    """Check that the approach finds the object, on which the probe would rest at the end of the approach."""
    x, y, z = (1e3 * approach.start).tolist()
    where = f"task.start_mm = ({x:g}, {y:g}, {z:g})"
    if rest is None:
        raise PlanError(
            [f"{where}: the approach does not meet the object; move start_mm over it or the object under it"]
        )
    miss, _ = rest
    if not -approach.search <= miss <= approach.clearance:
        side = "above" if miss > 0 else "below"
        searched = f"{1e3 * approach.clearance:g} mm above to {1e3 * approach.search:g} mm below"
        lies = f"the object lies {abs(1e3 * miss):.1f} mm {side} along the approach"
        raise PlanError([f"{where}: {lies}, searched from {searched}; move one of them"])


def _check_first_touch(task: Touch, shape: PlacedShape) -> None:
    """Check that the probe is outside the object before its approach, and first meets it with the array."""
    approach, radius, up = task.approach, task.probe.radius, task.approach.normal
    nearest = shape.closest(approach.start + (approach.clearance + radius) * up)
    tilt = math.acos(min(max(float(nearest.normal @ up), -1.0), 1.0))
    mend = f"turn task.approach_normal by {math.degrees(tilt):.0f} deg to the object's normal, or move one of them"
    if nearest.distance <= radius:
        deep = 1e3 * (radius - nearest.distance)
        what = f"{deep:.1f} mm in the object before its approach, {math.degrees(tilt):.0f} deg beside it"
        raise PlanError([f"task.clearance_mm = {1e3 * approach.clearance:g}: the probe would be {what}; {mend}"])
    reaches, margin = task.array.pad.reach_m, edge_margin(task)
    if margin < reaches < radius * tilt + margin:
        beside = f"the first touch would be {1e3 * radius * tilt:.1f} mm beside the middle of the array"
        reach = f"which reaches {1e3 * reaches:.1f} mm, and the patch at {task.force:g} N needs {1e3 * margin:.1f} mm"
        raise PlanError([f"task.approach_normal: {beside}, {reach} of it; {mend}"])


_MAX_STEP_S, _MAX_STEP_M, _MAX_STEP_RAD = 0.05, 1e-3, 0.02
"""Longest steps: in time for the null space, and of the linear and the angular rows."""
_MIN_STEPS = 4
"""Least number of steps between two poses."""
TimedPose = tuple[ProbePose, float]
"""A pose of the probe, and the time to it from the one before, s."""


def joints_on_way(arm: Arm, probe: Probe, q_start: Floats, way: Callable[[ProbePose], Iterable[TimedPose]]) -> Floats:
    """Joint positions (m, n), rad or m, on the way of a task.

    Args:
        arm, probe: the arm and its probe.
        q_start: joint positions at the beginning (n,), rad or m.
        way: function of the pose at the beginning that gives the poses of the task.
    """
    steps = PoseSteps(arm.model, probe.T_flange_probe, q_start)
    before = ProbePose(np.array(steps.at.flange), np.array(steps.at.z))
    q, found = q_start.tolist(), [q_start.tolist()]
    for pose, seconds in way(before):
        moved = float(np.linalg.norm(pose.centre - before.centre)) / _MAX_STEP_M
        turned = float(np.linalg.norm(pose.pole - before.pole)) / _MAX_STEP_RAD
        count = max(_MIN_STEPS, math.ceil(max(moved, turned, seconds / _MAX_STEP_S)))
        for between, step_s in _between(before, pose, seconds, count):
            q = [a + step for a, step in zip(q, steps.step(q, between, step_s), strict=True)]
            found.append(q)
        before = pose
    return np.array(found)


def _between(before: ProbePose, after: ProbePose, seconds: float, count: int) -> Iterator[TimedPose]:
    """Poses in equal steps from one, which is left out, to another."""
    for share in (np.arange(count) + 1) / count:
        pole = before.pole + share * (after.pole - before.pole)
        centre = before.centre + share * (after.centre - before.centre)
        yield ProbePose(centre, pole / np.linalg.norm(pole)), seconds / count


def over_path(task: Touch, path: SurfacePath, pose: ProbePose) -> Iterator[TimedPose]:
    """The poses of a touch: to the approach, down, at rest, and once round the path."""
    approach, radius = task.approach, task.probe.radius
    above = ProbePose(approach.start + (approach.clearance + radius) * approach.normal, -approach.normal)
    yield from _moving(LineMotion(pose, above, MOVE_SPEED_M_S))
    poses = contact_poses(task, path)
    yield ProbePose(poses[0].centre, above.pole), approach.clearance / approach.speed
    yield poses[0], SETTLE_S
    if task.scan is not None:
        for last, here in itertools.pairwise(poses):
            yield here, float(np.linalg.norm(here.centre - last.centre)) / task.scan.speed


def carried(task: Touch, carrier: Carrier, path: SurfacePath) -> Iterator[tuple[float, float, ProbePose]]:
    """Poses in contact, in base, of a run on a carrier that moves from position 0 on: time, step in time, s, and pose.

    The path goes round until the run, or one turn of the carrier, is over. A very long run is gone through faster.
    """
    poses = contact_poses(task, path)
    resting = poses[0], CARRIED_STEP_S
    speed = 0.0 if task.scan is None else task.scan.speed
    steps = [] if speed else [resting]
    ways = np.linalg.norm(np.roll(path.points, -1, axis=0) - path.points, axis=1).tolist()
    for last, here, way in zip(poses, [*poses[1:], poses[0]], ways, strict=True) if speed else ():
        seconds = max(way / speed, 1e-3)
        steps += _between(last, here, seconds, math.ceil(seconds / CARRIED_STEP_S))
    turn_s = 2.0 * math.pi / carrier.speed if carrier.motion.point is not None else math.inf
    end_s, t = TASK_OVERHEAD_S + min(task.duration_s, turn_s), 0.0
    pace = max(1.0, end_s * len(steps) / sum(seconds for _, seconds in steps) / MAX_CARRIED_STEPS)
    before = [resting] * math.ceil(TASK_OVERHEAD_S / CARRIED_STEP_S)
    for pose, seconds in itertools.chain(before, itertools.cycle(steps)):
        t += pace * seconds
        yield t, seconds, pose.moved(carrier.motion.T_base_carrier(carrier.speed * t))
        if t >= end_s:
            return


def contact_poses(task: Touch, path: SurfacePath) -> list[ProbePose]:
    """The pose of the probe at each contact."""
    places = zip(path.points, path.normals, poles_at_contacts(task, path), strict=True)
    return [ProbePose(point + task.probe.radius * normal, -pole) for point, normal, pole in places]


def round_ball(task: Calibrate, pose: ProbePose) -> Iterator[TimedPose]:
    """The poses of a calibration: to each touch, down, and off again."""
    radii, down_s = task.ball_radius + task.probe.radius, task.approach.clearance / task.approach.speed
    for touch in task.approaches:
        above, on, off = (
            ProbePose(task.ball_centre + (radii + gap) * touch.n_base, touch.pole_base)
            for gap in (task.approach.clearance, 0.0, task.approach.clearance + EXTRA_CLEARANCE_M)
        )
        yield from _moving(ArcMotion(task.ball_centre, pose, above, ROUND_SPEED_M_S))
        yield on, down_s
        yield from _moving(LineMotion(on, off, RETREAT_SPEED_M_S))
        pose = off


def _moving(motion: LineMotion | ArcMotion) -> Iterator[TimedPose]:
    """The poses of a move."""
    count = max(_MIN_STEPS, math.ceil(motion.duration / _MAX_STEP_S))
    for k in range(1, count + 1):
        yield motion.at(motion.duration * k / count), motion.duration / count


def poles_at_contacts(task: Touch, path: SurfacePath) -> Floats:
    """(n, 3) pole of the probe, away from the object, at each contact."""
    fixed = task_rows(task.arm.model) == FIXED_POLE
    share = task.scan.rolling_share if task.scan is not None else float(fixed)
    kept = task.approach.normal if fixed else path.normals[0]  # the probe keeps the pole of its first contact
    poles = (1 - share) * path.normals + share * kept
    unit: Floats = poles / np.linalg.norm(poles, axis=1)[:, None]
    return unit
