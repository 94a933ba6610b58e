"""Whether a command from outside may reach the cell: by the same checks that the scene itself has to pass."""

from __future__ import annotations

import math
from dataclasses import replace

from canprobe.errors import UsageError
from canprobe.planning import make_plan
from canprobe.planning.model import Plan
from canprobe.scene_loader import dump_scene, parse_scene
from canprobe.scene_resolve import resolve

KINDS = ("start", "stop", "target_force_n", "speed_m_s")


def refuse(plan: Plan, kind: str, value: float | None) -> str | None:
    """Why a command is refused, or None.

    A target force or a speed is put into the scene, which is then checked and planned as if it had been written so:
    ranges, `limits.force_max_n`, the speeds of the joints.

    Args:
        plan: of the run.
        kind: one of `KINDS`.
        value: N or m/s; None for start and stop.
    """
    if kind in ("start", "stop"):
        return None
    needs = ("scan", "press") if kind == "target_force_n" else ("scan",)
    task = plan.scene.task
    if task.kind not in needs:
        return f'task.kind = "{task.kind}" has none'
    if value is None or not math.isfinite(value):
        return f"expected a number, got {value}"
    changed = replace(task, force_n=value) if kind == "target_force_n" else replace(task, speed_mm_s=value * 1e3)
    try:
        make_plan(resolve(parse_scene(dump_scene(replace(plan.scene, task=changed)))))
    except UsageError as error:
        return str(error).splitlines()[0].removeprefix("scene: ")
    return None
