"""One step of the tool with some drives at rest: the others share the motion."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from canprobe.mechanics.robot.model import ArmModel
from canprobe.mechanics.types import Floats

MAX_GAIN = 30.0
"""Largest joint motion per motion of the tool, rad/m; with more the remaining drives are badly placed for it."""
_MAX_ERROR_SHARE = 1e-6


def lifting_step(model: ArmModel, J: Floats, move: Floats, free: NDArray[np.bool_]) -> Floats | None:
    """Drive steps that move the tool's point, with free orientation, while some drives stand still.

    Of all such steps it is the one with the least joint motion. Couplings between joints are included: where a drive
    stands still its joint may move.

    Args:
        model: the arm.
        J: (3, n) velocity of the point per joint rate, base frame.
        move: (3,) displacement of the point, m, base frame.
        free: (n,) whether each drive may move.

    Returns:
        (n,) steps in drive units; None where the free drives cannot make this move within `MAX_GAIN`.

    Source: least-norm solution of an underdetermined system (Golub and Van Loan, Matrix Computations, 5.6).
    """
    turns = (model.q_per_unit / model.radian[:, None])[:, free]
    scale = 1.0 / np.linalg.norm(turns, axis=0)  # units of a drive for one rad of joints
    shares, *_ = np.linalg.lstsq(J @ model.q_per_unit[:, free] * scale, move, rcond=None)
    units = np.zeros(len(free))
    units[free] = scale * shares
    dq = model.q_per_unit @ units
    size = float(np.linalg.norm(move))
    if np.linalg.norm(J @ dq - move) > _MAX_ERROR_SHARE * size or np.linalg.norm(dq / model.radian) > MAX_GAIN * size:
        return None
    return units
