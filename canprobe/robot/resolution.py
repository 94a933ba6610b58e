"""How finely the encoders tell where the tool is."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from canprobe.robot.kinematics import forward_jacobian
from canprobe.robot.puma260 import Array, PumaModel


def count_sigma(model: PumaModel, q: npt.ArrayLike, T_flange_tool: Array, direction: npt.ArrayLike) -> float:
    """Standard deviation of the tool's position along a direction, m, as encoders round to whole counts.

    Args:
        model: the arm.
        q: joint angles (6,), rad.
        T_flange_tool: (4, 4) from the tool's frame to the flange, m.
        direction: unit vector (3,), base frame.

    Source: a rounding error is uniform over one count, of variance 1/12, and independent from motor to motor.
    """
    _, J = forward_jacobian(model, q, T_flange_tool)
    per_count = np.asarray(direction, dtype=float) @ J[:3] @ model.joints_per_count
    return float(np.linalg.norm(per_count)) / math.sqrt(12.0)
