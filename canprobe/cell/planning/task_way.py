"""The way that a task will take, in time, and the joints on it: the task's motion, in longer steps."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator

import numpy as np

from canprobe.cell.planning.surface_path import SurfacePath
from canprobe.cell.scene.setup import Arm, Calibrate, Probe, Touch
from canprobe.mechanics.robot.inverse import FIXED_POLE, task_rows
from canprobe.mechanics.touch.probe_motion import (
    EXTRA_CLEARANCE_M,
    MOVE_SPEED_M_S,
    RETREAT_SPEED_M_S,
    ROUND_SPEED_M_S,
    SETTLE_S,
    ArcMotion,
    LineMotion,
    PoseSteps,
)
from canprobe.mechanics.touch.servo import ProbePose
from canprobe.mechanics.types import Floats

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
        for share in (np.arange(count) + 1) / count:
            pole = before.pole + share * (pose.pole - before.pole)
            between = ProbePose(before.centre + share * (pose.centre - before.centre), pole / np.linalg.norm(pole))
            q = [a + step for a, step in zip(q, steps.step(q, between, seconds / count), strict=True)]
            found.append(q)
        before = pose
    return np.array(found)


def over_path(task: Touch, path: SurfacePath, pose: ProbePose) -> Iterator[TimedPose]:
    """The poses of a touch: to the approach, down, at rest, and once round the path."""
    approach, radius = task.approach, task.probe.radius
    above = ProbePose(approach.start + (approach.clearance + radius) * approach.normal, -approach.normal)
    yield from _moving(LineMotion(pose, above, MOVE_SPEED_M_S))
    poses = [
        ProbePose(point + radius * normal, -pole)
        for point, normal, pole in zip(path.points, path.normals, poles_at_contacts(task, path), strict=True)
    ]
    yield ProbePose(poses[0].centre, above.pole), approach.clearance / approach.speed
    yield poses[0], SETTLE_S
    if task.scan is not None:
        for last, here in itertools.pairwise(poses):
            yield here, float(np.linalg.norm(here.centre - last.centre)) / task.scan.speed


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
