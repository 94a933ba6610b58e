"""Chains from Denavit-Hartenberg rows."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, sin

import numpy as np
import numpy.typing as npt

from canprobe.errors import PlanError
from canprobe.mechanics.robot.chain import Chain, Convention
from canprobe.mechanics.types import Floats


def from_dh(
    rows: npt.ArrayLike,
    convention: Convention = "standard",
    *,
    name: str = "arm",
    joints: Sequence[str] | None = None,
    prismatic: Sequence[bool] | None = None,
    T_base_mount: Floats | None = None,
    T_last_flange: Floats | None = None,
) -> Chain:
    """A chain from Denavit-Hartenberg rows.

    Args:
        rows: (n, 4) a in m, alpha in rad, d in m, theta in rad; q is added to theta, for a prismatic joint to d.
        convention: "standard": a row is Rz(theta) Tz(d) Tx(a) Rx(alpha). "modified" (Craig): a row is
            Rx(alpha) Tx(a) Rz(theta) Tz(d), with a and alpha of the link before the joint.
        name: name of the arm.
        joints: names of the joints; joint_1, joint_2, … by default.
        prismatic: whether each joint slides; none by default.
        T_base_mount: (4, 4) frame in which the first row begins, in base, m; base itself by default.
        T_last_flange: (4, 4) flange in the frame behind the last row, m; that frame by default.

    Raises:
        PlanError: the convention is another one, the rows are not (n, 4), or `Chain` refuses the result.

    Source: Siciliano et al., Robotics, 2.8.2 (standard); Craig, Introduction to Robotics, 3.4 (modified).
    """
    table = np.asarray(rows, dtype=float)
    if table.ndim != 2 or table.shape[1] != 4:
        raise PlanError([f"chain {name!r}: expected DH rows (n, 4) of a, alpha, d, theta, got shape {table.shape}"])
    if convention not in ("standard", "modified"):
        raise PlanError([f"chain {name!r}: expected DH convention standard or modified, got {convention!r}"])
    mount = np.eye(4) if T_base_mount is None else T_base_mount
    flange = np.eye(4) if T_last_flange is None else T_last_flange
    steps = [dh_step(*row, convention=convention) for row in table.tolist()]
    n = len(steps)
    if convention == "standard":  # what a row holds besides the motion of its joint lies behind the joint
        fixed = [mount, *steps[:-1], steps[-1] @ flange]
    else:
        fixed = [mount @ steps[0], *steps[1:], flange]
    return Chain(
        name=name,
        joints=tuple(joints) if joints is not None else tuple(f"joint_{i}" for i in range(1, n + 1)),
        prismatic=tuple(prismatic) if prismatic is not None else (False,) * n,
        fixed=np.array(fixed[:-1]),
        T_last_flange=fixed[-1],
    )


def dh_step(a: float, alpha: float, d: float, theta: float, *, convention: Convention = "standard") -> Floats:
    """(4, 4) transform of one Denavit-Hartenberg row in m and rad, see `from_dh`."""
    ct, st, ca, sa = cos(theta), sin(theta), cos(alpha), sin(alpha)
    if convention == "standard":
        rows = ((ct, -st * ca, st * sa, a * ct), (st, ct * ca, -ct * sa, a * st), (0.0, sa, ca, d))
    else:
        rows = ((ct, -st, 0.0, a), (st * ca, ct * ca, -sa, -d * sa), (st * sa, ct * sa, ca, d * ca))
    return np.array((*rows, (0.0, 0.0, 0.0, 1.0)))


def rotation_rpy(roll: float, pitch: float, yaw: float) -> Floats:
    """Rotation about the fixed axes x, then y, then z: Rz(yaw) Ry(pitch) Rx(roll), (3, 3).

    Args:
        roll: angle about x, rad.
        pitch: angle about y, rad.
        yaw: angle about z, rad.
    """
    cr, sr, cp, sp, cy, sy = (f(angle) for angle in (roll, pitch, yaw) for f in (cos, sin))
    return np.array(
        (
            (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
            (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
            (-sp, cp * sr, cp * cr),
        )
    )


def tool_z_offset(offset_mm: float) -> Floats:
    """A tool frame along the flange's z axis, axes parallel.

    Args:
        offset_mm: distance from the flange, mm.

    Returns:
        (4, 4) T_flange_tool, m.
    """
    T_flange_tool = np.eye(4)
    T_flange_tool[2, 3] = 1e-3 * offset_mm
    return T_flange_tool
