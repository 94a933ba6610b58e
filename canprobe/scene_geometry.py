"""The geometry that a scene describes, in SI units and the base frame."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from canprobe.robot.kinematics import tool_z_offset
from canprobe.scene import ObjectSettings, ProbeSettings, TaskSettings
from canprobe.touch.objects import OBJECT_PARAMETERS, PlacedShape, make_object

Array = NDArray[np.float64]


def rotation_rpy(roll: float, pitch: float, yaw: float) -> Array:
    """Rotation about the fixed axes x, then y, then z: Rz(yaw) Ry(pitch) Rx(roll), (3, 3).

    Args:
        roll: about x, rad.
        pitch: about y, rad.
        yaw: about z, rad.
    """
    cr, sr, cp, sp, cy, sy = (f(angle) for angle in (roll, pitch, yaw) for f in (math.cos, math.sin))
    return np.array(
        (
            (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
            (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
            (-sp, cp * sr, cp * cr),
        )
    )


def T_base_object(settings: ObjectSettings) -> Array:
    """Pose of the object frame, (4, 4), m: origin on the surface, z outward."""
    T = np.eye(4)
    T[:3, :3] = rotation_rpy(*(math.radians(angle) for angle in settings.rotation_deg))
    T[:3, 3] = np.array(settings.position_mm) * 1e-3
    return T


def true_object(settings: ObjectSettings) -> PlacedShape:
    """The object that a scene describes.

    Raises:
        ValueError: for a matrix that is no surface through the object's origin with z outward.
    """
    params = {name: _parameter(settings, name) for name in OBJECT_PARAMETERS[settings.kind]}
    return make_object(settings.kind, T_base_object=T_base_object(settings), **params)


def _parameter(settings: ObjectSettings, name: str) -> object:
    """One parameter of the object in SI units."""
    if name == "matrix":
        return np.array(settings.matrix)
    if name == "angle":
        return math.radians(settings.angle_deg or 0.0)
    length: float = getattr(settings, f"{name}_mm")
    return length * 1e-3


def T_flange_probe(probe: ProbeSettings) -> Array:
    """Frame of the probe's centre on the flange, (4, 4), m; z is the pole."""
    T = tool_z_offset(probe.centre_offset_mm)
    T[:2, 3] = np.array(probe.centre_lateral_mm) * 1e-3
    return T


def approach_normal(task: TaskSettings) -> Array:
    """Unit outward normal that the approach expects, (3,)."""
    normal = np.array(task.approach_normal)
    unit: Array = normal / np.linalg.norm(normal)
    return unit


def scan_axes(task: TaskSettings) -> Array:
    """Axes of the scan plane, (3, 3): rows heading, across, approach normal; right-handed.

    The heading is given in the base xy-plane and carried into the plane perpendicular to the approach normal.
    """
    normal = approach_normal(task)
    heading = math.radians(task.heading_deg)
    along = np.array((math.cos(heading), math.sin(heading), 0.0))
    along -= normal * float(normal @ along)
    along /= np.linalg.norm(along)
    return np.array((along, np.cross(normal, along), normal))
