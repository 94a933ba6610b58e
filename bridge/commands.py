"""Check of commands from other tools, by the same checks that the scene itself has to pass."""

from __future__ import annotations

import math
from typing import Any

from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.tasks import Trajectory
from canprobe.errors import UsageError
from canprobe.mechanics.types import Floats


def refuse(plan: Plan, kind: str, value: float | None) -> str | None:
    """Why a command is refused, or None.

    A target force or a speed is put into the scene, which is then checked and planned as if its file had it:
    ranges, `limits.force_max_n`, the speeds of the joints.

    Args:
        plan: plan of the run.
        kind: kind of the command: start, stop, resume, target_force_n or speed_m_s.
        value: value in N or m/s; None for start, stop and resume.
    """
    if kind in ("start", "stop", "resume"):
        return None
    needs = ("scan", "press") if kind == "target_force_n" else ("scan",)
    task = plan.scene.task
    if task.kind not in needs:
        return f'task.kind = "{task.kind}" has none'
    if value is None or not math.isfinite(value):
        return f"expected a number, got {value}"
    changed = {"task.force_n": value} if kind == "target_force_n" else {"task.speed_mm_s": value * 1e3}
    try:
        make_plan(resolve(load_scene(plan.scene, changed)))
    except UsageError as error:
        return str(error).splitlines()[0].removeprefix(f"{plan.scene.name} as changed: ")
    return None


def trajectory_of(plan: Plan, message: Any, q: Floats | None) -> dict[str, Any]:
    """The trajectory of a `trajectory_msgs/msg/JointTrajectory`, checked from the present position of the arm.

    Args:
        plan: plan of the run.
        message: trajectory with joint names and points; positions in each point, velocities in all of them or in none.
        q: present joint positions (n,), rad or m; None as long as they are not known.

    Returns:
        `points` and `velocities` of a `canprobe.cell.tasks.Trajectory`.

    Raises:
        UsageError: when the cell cannot or must not follow it.
    """
    arm = plan.setup.arm
    if arm is None or plan.scene.task.kind != "free":
        raise UsageError(f'task.kind = "{plan.scene.task.kind}" follows no trajectory: task.kind = "free" does')
    if q is None:
        raise UsageError("the joints have not reported yet")
    names, known = list(message.joint_names), list(arm.model.chain.joints)
    if sorted(names) != sorted(known):
        raise UsageError(f"expected the joints {', '.join(known)}, got {', '.join(names) or 'none'}")
    order = [names.index(name) for name in known]

    def ordered(values: Any) -> list[float]:
        if len(values) != len(names):
            raise UsageError(f"expected {len(names)} numbers for {len(names)} joints, got {len(values)}")
        return [float(values[i]) for i in order]

    times = [point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec for point in message.points]
    points = [(t, ordered(point.positions)) for t, point in zip(times, message.points, strict=True)]
    moving = [point.velocities for point in message.points if len(point.velocities)]
    velocities = [ordered(one) for one in moving] if moving else None
    if reason := Trajectory(plan, points, velocities).inspect(q):
        raise UsageError(reason)
    return {"points": points, "velocities": velocities}
