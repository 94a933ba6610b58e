"""Poses that put a spherical probe on a surface point, and the joint angles for them: start poses of a scene."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from canprobe.robot.inverse import inverse_near
from canprobe.robot.kinematics import forward
from canprobe.robot.puma260 import ELBOW_FORM, Array, PumaModel


def probe_pose(point: npt.ArrayLike, normal: npt.ArrayLike, centre_height_m: float, x_hint: npt.ArrayLike) -> Array:
    """Probe frame above a surface point, pole (z) against the outward normal.

    Args:
        point: (3,) surface point, base frame, m.
        normal: (3,) outward normal of the surface, any length.
        centre_height_m: distance of the probe's centre from the point along the normal, m
            (probe radius + clearance, or radius - depth).
        x_hint: (3,) direction that the frame's x axis follows as far as the pole allows.

    Returns:
        (4, 4) T_base_probe, m.

    Raises:
        ValueError: for a hint parallel to the normal.
    """
    n = np.asarray(normal, dtype=float) / np.linalg.norm(normal)
    hint = np.asarray(x_hint, dtype=float)
    x = hint - (hint @ n) * n
    size = float(np.linalg.norm(x))
    if size < 1e-9 * float(np.linalg.norm(hint)) or size == 0.0:
        raise ValueError(f"x_hint {hint.tolist()} is parallel to the normal {n.tolist()}")
    T_base_probe = np.eye(4)
    T_base_probe[:3, 0] = x / size
    T_base_probe[:3, 1] = np.cross(-n, x / size)
    T_base_probe[:3, 2] = -n
    T_base_probe[:3, 3] = np.asarray(point, dtype=float) + centre_height_m * n
    return T_base_probe


def start_posture(
    model: PumaModel,
    point: npt.ArrayLike,
    normal: npt.ArrayLike,
    *,
    radius_m: float,
    T_flange_probe: Array,
    clearance_m: float = 0.0,
    yaw_rad: float | None = None,
    q_near: npt.ArrayLike = ELBOW_FORM,
) -> Array:
    """Joint angles that hold the probe over a surface point, pole against the normal, nearest to a known posture.

    The turn about the normal is free: by default it is what ``q_near`` has (joint 6 moves least); with ``yaw_rad``
    the probe's x axis points at that angle from base x, in the horizontal plane, counted about base z.

    Args:
        model: the arm.
        point: (3,) surface point, base frame, m.
        normal: (3,) outward normal there.
        radius_m: probe radius, m.
        T_flange_probe: (4, 4) probe centre in the flange frame, m.
        clearance_m: gap between probe and surface, m; negative presses.
        yaw_rad: optional heading of the probe's x axis, rad.
        q_near: (6,) rad.

    Returns:
        (6,) joint angles, rad, within the limits.

    Raises:
        PlanError: when no branch reaches the pose within the limits.
    """
    if yaw_rad is None:
        x_hint = (forward(model, q_near) @ T_flange_probe)[:3, 0]
    else:
        x_hint = np.array((math.cos(yaw_rad), math.sin(yaw_rad), 0.0))
    T_base_probe = probe_pose(point, normal, radius_m + clearance_m, x_hint)
    return inverse_near(model, T_base_probe @ np.linalg.inv(T_flange_probe), q_near)
