"""The geometry that a scene describes, in SI units and the base frame, and what a calibration found of it."""

from __future__ import annotations

import math

import numpy as np

from canprobe.cell.scene.hardware import Vec3
from canprobe.cell.scene.model import ObjectSettings, ProbeSettings, TaskSettings
from canprobe.cell.scene.surface_files import object_of_file
from canprobe.mechanics.robot.denavit_hartenberg import rotation_rpy, tool_z_offset
from canprobe.mechanics.touch.objects import OBJECT_PARAMETERS, make_object
from canprobe.mechanics.touch.shapes import PlacedShape
from canprobe.mechanics.types import Floats


def transform(position_mm: Vec3, rotation_deg: Vec3) -> Floats:
    """(4, 4), m, of a position, mm, and roll, pitch and yaw about the fixed axes, deg."""
    T = np.eye(4)
    T[:3, :3] = rotation_rpy(*(math.radians(angle) for angle in rotation_deg))
    T[:3, 3] = np.array(position_mm) * 1e-3
    return T


def T_base_object(settings: ObjectSettings) -> Floats:
    """Pose of the object frame, (4, 4), m: origin on the surface, z outward."""
    return transform(settings.position_mm, settings.rotation_deg)


def true_object(settings: ObjectSettings) -> PlacedShape:
    """The object that a scene describes.

    Raises:
        ValueError: the matrix describes no surface through the object's origin with z outward, or the file
            holds none.
        UsageError: a mesh, and no trimesh is installed.
    """
    if settings.file is not None:
        return object_of_file(settings, T_base_object(settings))
    values: dict[str, object] = {"matrix": np.array(settings.matrix), "angle": math.radians(settings.angle_deg or 0.0)}
    params = {
        name: values[name] if name in values else getattr(settings, f"{name}_mm") * 1e-3
        for name in OBJECT_PARAMETERS[settings.kind]
    }
    return make_object(settings.kind, T_base_object=T_base_object(settings), **params)


def T_flange_probe(probe: ProbeSettings) -> Floats:
    """Frame of the probe's centre on the flange, (4, 4), m; z is the pole."""
    T = tool_z_offset(probe.centre_offset_mm)
    T[:2, 3] = np.array(probe.centre_lateral_mm) * 1e-3
    return T


def approach_normal(task: TaskSettings) -> Floats:
    """Unit outward normal that the approach expects, (3,)."""
    normal = np.array(task.approach_normal)
    unit: Floats = normal / np.linalg.norm(normal)
    return unit


def scan_axes(task: TaskSettings) -> Floats:
    """Axes of the scan plane, (3, 3): rows heading, across, approach normal; right-handed.

    The heading is given in the base xy-plane and carried into the plane perpendicular to the approach normal.
    """
    normal = approach_normal(task)
    heading = math.radians(task.heading_deg)
    along = np.array((math.cos(heading), math.sin(heading), 0.0))
    along -= normal * float(normal @ along)
    along /= np.linalg.norm(along)
    return np.array((along, np.cross(normal, along), normal))


def expected_ball(task: TaskSettings) -> tuple[Floats, float]:
    """Centre (3,), m, base frame, and radius, m, of the ball: its top is at `start_mm`."""
    radius = task.ball_radius_mm * 1e-3
    return np.array(task.start_mm) * 1e-3 - radius * approach_normal(task), radius
