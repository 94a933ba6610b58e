"""The path that a scan will take over the object as the scene describes it: points, normals, curvature."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from canprobe.planning.contact_window import PITCH_M
from canprobe.protocol.tactile import SIDE
from canprobe.scene_setup import Approach, Touch
from canprobe.touch.objects import PlacedShape

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
