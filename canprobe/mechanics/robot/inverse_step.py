"""One step of the inverse Jacobian: damped near singular poses, or with some drives at rest."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from canprobe.mechanics.robot.inverse import ERROR_LENGTH_M
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


_MAX_DAMPING, _DAMPING_THRESHOLD = 0.05, 0.08
"""Largest damping, and the singular value below which it starts; linear rows are divided by `ERROR_LENGTH_M`."""


def damped_step(J: Floats, twist: Floats, wish: Floats | None = None) -> Floats:
    """Joint rates for a tool twist.

    Away from singular poses this is the exact inverse, of least norm where there are more joints than rows. Where the
    smallest singular value s falls below the threshold, the squared damping rises as 0.05^2 (1 - (s / 0.08)^2), equally
    in all directions, so that rates stay bounded and continuous. Why not always damped: the tool would lag at every
    pose.

    Args:
        J: (m, n) rows of the geometric Jacobian that the arm can hold, linear rows first, see `task_rows`.
        twist: (m,) twist, linear rows in m/s, then angular ones in rad/s; or a displacement, as the map is linear.
        wish: (n,) wanted joint rates; only their part in the null space, which does not move the tool, is used.

    Returns:
        (n,) joint rates, rad/s or m/s.

    Source: Nakamura & Hanafusa 1986; Maciejewski & Klein 1988 (variable damping factor); Liegeois 1977 (null space).
    """
    rows, joints = J.shape
    scale = np.array((1 / ERROR_LENGTH_M,) * 3 + (1.0,) * (rows - 3))
    scaled, aim = J * scale[:, None], scale * twist
    regular = _regular_step(scaled, aim) if rows == joints else None
    if regular is not None:
        return regular
    U, s, Vt = np.linalg.svd(scaled, full_matrices=False)
    ratio = float(s[-1]) / _DAMPING_THRESHOLD
    lambda2 = _MAX_DAMPING**2 * (1.0 - ratio**2) if ratio < 1.0 else 0.0
    step: Floats = Vt.T @ ((U.T @ aim) * (s / (s * s + lambda2)))
    return step if wish is None else step + wish - Vt.T @ (Vt @ wish)


def _regular_step(J: Floats, twist: Floats) -> Floats | None:
    """The exact step where a cheap test rules out damping (1/‖J⁻¹‖ is below every singular value); else None."""
    try:
        inverse = np.linalg.inv(J)
    except np.linalg.LinAlgError:
        return None
    if float(np.vdot(inverse, inverse)) * _DAMPING_THRESHOLD**2 >= 1.0:
        return None
    step: Floats = inverse @ twist
    return step
