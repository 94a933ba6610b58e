"""A path that asks too much of the joints is turned; where no direction will do, the plan says what speed is possible.

The surface is felt as well in any direction, the joints are not as fast in any: near the shoulder's singular cone or
where the pad turns much over a short way, one of them sets the pace.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

from canprobe.planning.model import Choice, JointSpeeds
from canprobe.planning.reach import check_motion, speed_problems
from canprobe.scene import Scene

STEP_DEG = 5.0
COARSE = 60
"""Points of the path that a direction is judged by at first; the one that is taken is looked at in full."""


@dataclass(frozen=True, slots=True)
class _Best:
    """The fastest direction that was found; without one, speed 0."""

    speed_mm_s: float = 0.0
    heading_deg: float = 0.0


def plan_motion(scene: Scene) -> tuple[Scene, JointSpeeds | None, list[str], tuple[Choice, ...]]:
    """What the task asks of the arm, its path turned where only that makes the joints fast enough.

    Returns:
        The scene (with another heading where it was turned), its joint speeds, what the arm cannot do, and the turn.
    """
    speeds, problems = check_motion(scene)
    if speeds is None or scene.task.kind != "scan" or speeds.worst_share <= 1.0:
        return scene, speeds, problems, ()
    too_fast = speed_problems(scene, speeds)
    if problems != too_fast or scene.task.turn_max_deg < STEP_DEG:
        return scene, speeds, problems, ()  # other things are wrong too, or the scene does not want it
    best = _Best()
    for turn in _turns(scene.task.turn_max_deg):
        candidate = _turned(scene, turn)
        speed = _possible_speed(candidate, COARSE)
        if speed > best.speed_mm_s:
            best = _Best(speed, candidate.task.heading_deg)
        if speed >= scene.task.speed_mm_s:
            found, none = check_motion(candidate)
            if found is not None and not none:
                return candidate, found, [], (_choice(candidate, turn, scene, speeds),)
    return scene, speeds, [*too_fast, _limit(scene, speeds, best)], ()


def _turns(most_deg: float) -> Iterator[float]:
    """Turns, the smallest first, to both sides."""
    for step in range(1, math.floor(most_deg / STEP_DEG) + 1):
        yield step * STEP_DEG
        yield -step * STEP_DEG


def _turned(scene: Scene, turn_deg: float) -> Scene:
    heading = math.remainder(scene.task.heading_deg + turn_deg, 360.0)
    return replace(scene, task=replace(scene.task, heading_deg=heading))


def _possible_speed(scene: Scene, samples: int) -> float:
    """Contact speed (mm/s) that the joints allow along a path; 0 where it is no path."""
    speeds, problems = check_motion(scene, samples)
    if speeds is None or problems != speed_problems(scene, speeds):
        return 0.0
    return scene.task.speed_mm_s / speeds.worst_share


def _slowest_joint(speeds: JointSpeeds) -> str:
    pairs = list(zip(speeds.needed_deg_s, speeds.limit_deg_s, strict=True))
    joint = max(range(len(pairs)), key=lambda i: pairs[i][0] / pairs[i][1])
    need, limit = pairs[joint]
    return f"joint {joint + 1} would need {need:.0f} deg/s, allowed {limit:.0f}"


def _choice(turned: Scene, turn_deg: float, asked: Scene, speeds: JointSpeeds) -> Choice:
    task = asked.task
    return Choice(
        "task.heading_deg",
        f"{turned.task.heading_deg:g}",
        f"path turned by {turn_deg:g} deg: at {task.speed_mm_s:g} mm/s along {task.heading_deg:g} deg "
        f"{_slowest_joint(speeds)}",
    )


def _limit(scene: Scene, speeds: JointSpeeds, best: _Best) -> str:
    task, here = scene.task, scene.task.speed_mm_s / speeds.worst_share
    tried = f"task: turned by up to {task.turn_max_deg:g} deg the path cannot have {task.speed_mm_s:g} mm/s either"
    if best.speed_mm_s <= here:
        return f"{tried}: {here:.0f} mm/s as it is are the most"
    return f"{tried}: {best.speed_mm_s:.0f} mm/s are the most, at task.heading_deg = {best.heading_deg:g}"
