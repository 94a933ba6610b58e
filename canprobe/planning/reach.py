"""Can the arm do it: reach, joint stops and joint speeds along the whole path."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from canprobe.errors import PlanError
from canprobe.planning.ball_reach import joints_on_ball
from canprobe.planning.model import JointSpeeds
from canprobe.planning.surface_path import SAMPLES, SurfacePath, surface_path
from canprobe.robot.inverse import inverse_near
from canprobe.robot.kinematics import forward
from canprobe.robot.puma260 import MODELS, PumaModel
from canprobe.robot.touching import probe_pose
from canprobe.scene import ArmSettings, ProbeSettings, Scene
from canprobe.scene_geometry import T_flange_probe, approach_normal

Array = NDArray[np.float64]

_BRANCH_RAD = 0.3  # between two points of a path; farther away lies another branch


def check_motion(scene: Scene, samples: int = SAMPLES) -> tuple[JointSpeeds | None, list[str]]:
    """What the task asks of the arm, and what the arm cannot do.

    Args:
        scene: any.
        samples: points of a scan's path that are looked at.
    """
    if scene.arm is None:
        return None, []
    model = MODELS[scene.arm.model]
    problems = _start_problems(model, scene, scene.arm)
    if scene.task.kind == "free":
        return _check_swing(model, scene, scene.arm, problems)
    if scene.task.kind == "calibrate":
        return _check_ball(model, scene, scene.arm, problems)
    path, found = surface_path(scene, samples)
    problems += found
    if path is None or scene.probe is None:
        return None, problems
    problems += _hollow_problems(path, scene.probe)
    joints, found = _joints_along(model, scene, scene.arm, scene.probe, path)
    problems += found
    if joints is None:
        return None, problems
    problems += _stop_problems(model, scene, joints)
    speeds = _speeds_along(model, scene, joints, path)
    return speeds, problems + speed_problems(scene, speeds)


def _start_problems(model: PumaModel, scene: Scene, arm: ArmSettings) -> list[str]:
    start = np.radians(arm.start_deg)
    margin = math.radians(scene.limits.joint_margin_deg)
    return [
        f"arm.start_deg: joint {i + 1} at {arm.start_deg[i]:g} deg, allowed {_range(model, scene, i)}"
        for i in range(6)
        if not model.q_min[i] + margin <= start[i] <= model.q_max[i] - margin
    ]


def _range(model: PumaModel, scene: Scene, joint: int) -> str:
    margin = scene.limits.joint_margin_deg
    low, high = math.degrees(model.q_min[joint]), math.degrees(model.q_max[joint])
    return f"{low + margin:g} to {high - margin:g} deg ({margin:g} deg from its stops)"


def _hollow_problems(path: SurfacePath, probe: ProbeSettings) -> list[str]:
    radius_mm = 1e3 * path.hollow_radius
    if radius_mm > probe.radius_mm:
        return []
    return [
        f"object: a hollow of radius {radius_mm:.3g} mm is tighter than the probe of radius {probe.radius_mm:g} mm, "
        "which touches it in more than one place; use a smaller probe or another object"
    ]


def _joints_along(
    model: PumaModel, scene: Scene, arm: ArmSettings, probe: ProbeSettings, path: SurfacePath
) -> tuple[Array | None, list[str]]:
    """Joint angles at the lifted start and along the path, (n + 1, 6) rad."""
    to_flange = np.linalg.inv(T_flange_probe(probe))
    radius, first = probe.radius_mm * 1e-3, approach_normal(scene.task)
    share = scene.task.rolling_share if scene.task.kind == "scan" else 1.0
    q = np.radians(arm.start_deg)
    x_hint = (forward(model, q) @ T_flange_probe(probe))[:3, 0]
    lifted = path.points[0] + path.normals[0] * scene.task.clearance_mm * 1e-3
    found: list[Array] = []
    for point, normal in zip((lifted, *path.points), (path.normals[0], *path.normals), strict=True):
        pad = (1 - share) * normal + share * first
        pad /= np.linalg.norm(pad)
        try:
            T_base_probe = probe_pose(point + radius * (normal - pad), pad, radius, x_hint)
            q = inverse_near(model, T_base_probe @ to_flange, q, max_move_rad=_BRANCH_RAD if found else math.inf)
        except (PlanError, ValueError) as error:
            return None, [_out_of_reach(point, str(error))]
        found.append(q)
    return np.array(found), []


def _out_of_reach(point: Array, why: str) -> str:
    x, y, z = (1e3 * point).tolist()
    return (
        f"task: contact at ({x:.1f}, {y:.1f}, {z:.1f}) mm out of reach: {why}; move the object, shorten the path, "
        "or set arm.start_deg to another branch"
    )


def _stop_problems(model: PumaModel, scene: Scene, joints: Array) -> list[str]:
    margin = math.radians(scene.limits.joint_margin_deg)
    low, high = joints.min(axis=0), joints.max(axis=0)
    return [
        f"task: joint {i + 1} would move from {math.degrees(low[i]):.1f} to {math.degrees(high[i]):.1f} deg, "
        f"allowed {_range(model, scene, i)}; move the object, shorten the path, or raise task.rolling_share"
        for i in range(6)
        if low[i] < model.q_min[i] + margin or high[i] > model.q_max[i] - margin
    ]


def _speeds_along(model: PumaModel, scene: Scene, joints: Array, path: SurfacePath) -> JointSpeeds:
    """Joint speeds while the contact moves at the scan's speed; approach and travel are slow."""
    if scene.task.kind != "scan":
        return _joint_speeds(model, scene, np.zeros(6))
    steps = np.linalg.norm(np.diff(path.points, axis=0), axis=1)
    rates = np.abs(np.diff(joints[1:], axis=0)) / steps[:, None] * scene.task.speed_mm_s * 1e-3
    return _joint_speeds(model, scene, rates.max(axis=0))


def _joint_speeds(model: PumaModel, scene: Scene, needed: Array) -> JointSpeeds:
    limit = model.qd_max * scene.limits.joint_speed_share
    return JointSpeeds(
        tuple(round(rate, 3) for rate in np.degrees(needed).tolist()),
        tuple(round(rate, 3) for rate in np.degrees(limit).tolist()),
    )


def speed_problems(scene: Scene, speeds: JointSpeeds) -> list[str]:
    """One line for every joint that the task asks to be too fast."""
    worst = speeds.worst_share
    if worst <= 1:
        return []
    ways_out = (
        f"swing slower (task.swing_period_s = {scene.task.swing_period_s * worst * 1.01:.3g}) or less (task.swing_deg)"
        if scene.task.kind == "free"
        else f"lower task.speed_mm_s to {scene.task.speed_mm_s / worst * 0.99:.3g}, turn task.heading_deg, "
        "or raise task.rolling_share"
    )
    return [
        f"task: joint {i + 1} would need {need:.0f} deg/s, allowed {limit:.0f}; {ways_out}"
        for i, (need, limit) in enumerate(zip(speeds.needed_deg_s, speeds.limit_deg_s, strict=True))
        if need > limit
    ]


def _check_ball(
    model: PumaModel, scene: Scene, arm: ArmSettings, problems: list[str]
) -> tuple[JointSpeeds | None, list[str]]:
    assert scene.probe is not None
    joints, found = joints_on_ball(model, scene, arm, scene.probe)
    problems += found
    if joints is None:
        return None, problems
    return _joint_speeds(model, scene, np.zeros(6)), problems + _stop_problems(model, scene, joints)


def _check_swing(
    model: PumaModel, scene: Scene, arm: ArmSettings, problems: list[str]
) -> tuple[JointSpeeds, list[str]]:
    start, swing = np.radians(arm.start_deg), np.abs(np.radians(scene.task.swing_deg))
    speeds = _joint_speeds(model, scene, swing * 2 * math.pi / scene.task.swing_period_s)
    if not problems:
        problems = _stop_problems(model, scene, np.array((start - swing, start + swing)))
    return speeds, problems + speed_problems(scene, speeds)
