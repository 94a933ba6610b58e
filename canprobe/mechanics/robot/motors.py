"""Motor coordinates: the position of a drive divided by its units per own joint.

Without coupling they are the joint positions. Rotor inertia, friction and drive torque act there, one motor each; rigid
bodies move at the joints.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from canprobe.mechanics.robot.chain import forward_jacobian
from canprobe.mechanics.robot.model import ArmModel
from canprobe.mechanics.types import Floats


def units_per_motor(model: ArmModel) -> Floats:
    """(n,) drive units per motor coordinate, negative where a drive counts backwards.

    Args:
        model: the arm.
    """
    return np.diag(model.units_per_q).copy()


def joints_per_motor(model: ArmModel) -> Floats:
    """(n, n) joint positions per motor coordinate.

    Args:
        model: the arm.
    """
    return np.array(model.q_per_unit * units_per_motor(model), dtype=np.float64)


def position_sigma(model: ArmModel, q: npt.ArrayLike, T_flange_tool: Floats, direction: npt.ArrayLike) -> float:
    """Standard deviation of the tool's position along a direction, m, by the rounding of drives to whole units.

    Args:
        model: the arm.
        q: (n,) joint positions, rad or m.
        T_flange_tool: (4, 4) tool in the flange frame, m.
        direction: (3,) unit vector, base frame.

    Source: a rounding error is uniform over one unit, of variance 1/12, and independent from drive to drive.
    """
    return float(np.linalg.norm(position_per_unit(model, q, T_flange_tool, direction))) / math.sqrt(12.0)


def position_per_unit(model: ArmModel, q: npt.ArrayLike, T_flange_tool: Floats, direction: npt.ArrayLike) -> Floats:
    """(n,) motion of the tool along a direction by one unit of each drive, m; arguments as for `position_sigma`."""
    _, J = forward_jacobian(model.chain, q, T_flange_tool)
    per_unit: Floats = np.asarray(direction, dtype=float) @ J[:3] @ model.q_per_unit
    return per_unit
