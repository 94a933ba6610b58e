"""The tree of frames, base to contact, as every viewer with tf wants it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from canprobe.bridge.sample import FLANGE, FRAME_NAMES
from canprobe.robot.puma260 import PumaModel

Array = NDArray[np.float64]
LINKS = FRAME_NAMES[:7]
"""base_link, then the frame that each joint turns."""


def link_transforms(model: PumaModel, q: Array) -> list[tuple[str, str, Array]]:
    """Frame of every link in that of the one before.

    Args:
        model: the arm.
        q: (6,) joint angles, rad.

    Returns:
        (parent, child, (4, 4) T_parent_child) of the six links, m; `link_6` and the flange are the same.

    Source: standard Denavit-Hartenberg transform.
    """
    return [(LINKS[i], LINKS[i + 1], _dh(float(q[i]), *model.dh[i].tolist())) for i in range(6)]


def flange_transform() -> tuple[str, str, Array]:
    """The flange lies in the last link's frame."""
    return (LINKS[6], FLANGE, np.eye(4))


def _dh(theta: float, a: float, alpha: float, d: float) -> Array:
    ct, st, ca, sa = math.cos(theta), math.sin(theta), math.cos(alpha), math.sin(alpha)
    return np.array(
        [
            [ct, -st * ca, st * sa, a * ct],
            [st, ct * ca, -ct * sa, a * st],
            [0.0, sa, ca, d],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def quaternion_of(R: Array) -> tuple[float, float, float, float]:
    """Unit quaternion x, y, z, w of a rotation (3, 3), w ≥ 0.

    Source: Shepperd's choice of the largest of the four squares, which divides by no small number.
    """
    m = R.tolist()
    trace = m[0][0] + m[1][1] + m[2][2]
    squares = (1 - trace + 2 * m[0][0], 1 - trace + 2 * m[1][1], 1 - trace + 2 * m[2][2], 1 + trace)
    i = squares.index(max(squares))
    big = math.sqrt(squares[i]) / 2
    if i == 3:
        q = [(m[2][1] - m[1][2]), (m[0][2] - m[2][0]), (m[1][0] - m[0][1]), 4 * big * big]
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        q = [0.0] * 4
        q[i] = 4 * big * big
        q[j], q[k] = m[i][j] + m[j][i], m[i][k] + m[k][i]
        q[3] = m[k][j] - m[j][k]
    scale = math.copysign(1 / (4 * big), q[3])
    return (q[0] * scale, q[1] * scale, q[2] * scale, q[3] * scale)
