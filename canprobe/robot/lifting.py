"""Moving the tool with the motors that are left: what the others would have done is shared among them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from canprobe.robot.puma260 import Array

WORST_GAIN = 30.0
"""Joint motion per motion of the tool, rad/m, beyond which the motors that are left are badly placed for it."""
_EXACT = 1e-6


def lifting_step(J: Array, joints_per_count: Array, move: Array, free: NDArray[np.bool_]) -> Array | None:
    """Motor steps that move the tool's point, its orientation left open, while some motors stand still.

    Of all steps the one with the least joint motion. The motors' coupling in the wrist is in it: a motor that stands
    still is not a joint that stands still.

    Args:
        J: (3, 6) velocity of the point per joint rate, m/rad, base frame.
        joints_per_count: (6, 6) joint angles of motor counts, rad.
        move: (3,) of the point, m, base frame.
        free: (6,) motors that may turn.

    Returns:
        (6,) counts; None where the free motors cannot make this move, or only by turning far.

    Source: least-norm solution of an underdetermined system (Golub and Van Loan, Matrix Computations, 5.6).
    """
    turns = joints_per_count[:, free]
    scale = 1.0 / np.linalg.norm(turns, axis=0)  # counts of a motor for one rad of joints
    shares, *_ = np.linalg.lstsq(J @ turns * scale, move, rcond=None)
    counts = np.zeros(len(free))
    counts[free] = scale * shares
    dq = joints_per_count @ counts
    size = float(np.linalg.norm(move))
    if np.linalg.norm(J @ dq - move) > _EXACT * size or np.linalg.norm(dq) > WORST_GAIN * size:
        return None
    return counts
