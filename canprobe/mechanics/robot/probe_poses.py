"""Poses that put a spherical probe on a surface point, and the joints for them: start poses of a scene."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from canprobe.mechanics.robot.chain import forward
from canprobe.mechanics.robot.inverse import inverse_near
from canprobe.mechanics.robot.model import ArmModel
from canprobe.mechanics.types import Floats


def probe_pose(point: npt.ArrayLike, normal: npt.ArrayLike, centre_height_m: float, x_hint: npt.ArrayLike) -> Floats:
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
        ValueError: the hint is parallel to the normal.
    """
    n = np.asarray(normal, dtype=float) / np.linalg.norm(normal)
    hint = np.asarray(x_hint, dtype=float)
    x = hint - (hint @ n) * n
    size = float(np.linalg.norm(x))
    if size < 1e-9 * float(np.linalg.norm(hint)) or size == 0.0:
        raise ValueError(f"x_hint {hint.tolist()} is parallel to the normal {n.tolist()}")
    T_base_probe = np.eye(4)
    T_base_probe[:3] = np.column_stack((x / size, np.cross(-n, x / size), -n, np.asarray(point) + centre_height_m * n))
    return T_base_probe


def start_posture(
    model: ArmModel,
    point: npt.ArrayLike,
    normal: npt.ArrayLike,
    q_near: npt.ArrayLike,
    *,
    radius_m: float,
    T_flange_probe: Floats,
    clearance_m: float = 0.0,
) -> Floats:
    """Joints that hold the probe over a surface point, pole against the normal, near a known posture.

    The turn about the normal is free; it is taken from `q_near`.

    Args:
        model: the arm.
        point: (3,) surface point, base frame, m.
        normal: (3,) outward normal there.
        q_near: (n,) known posture, rad or m.
        radius_m: probe radius, m.
        T_flange_probe: (4, 4) probe centre in the flange frame, m.
        clearance_m: gap between probe and surface, m; negative presses.

    Returns:
        (n,) joint positions, rad or m, within the limits.

    Raises:
        PlanError: the pose cannot be reached from there within the limits.
    """
    x_hint = (forward(model.chain, q_near) @ T_flange_probe)[:3, 0]
    T_base_probe = probe_pose(point, normal, radius_m + clearance_m, x_hint)
    return inverse_near(model, T_base_probe, T_flange_probe, q_near)
