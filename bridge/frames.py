"""The tree of frames from base to contact, for viewers with tf."""

from __future__ import annotations

import math

import numpy as np

from canprobe.lab.bridge.sample import BASE, FLANGE
from canprobe.mechanics.robot import chain as serial
from canprobe.mechanics.robot.chain import Chain
from canprobe.mechanics.types import Floats


def link_transforms(chain: Chain, q: Floats) -> list[tuple[str, str, Floats]]:
    """Frame of every link in the frame of the link before.

    Args:
        chain: the arm.
        q: joint positions (n,), rad or m.

    Returns:
        (parent, child, (4, 4) T_parent_child) of the n links, m, base_link first; the last link and the flange are the
        same.
    """
    names = [BASE, *(f"link_{i}" for i in range(1, chain.n + 1))]
    return [(names[i], names[i + 1], T) for i, T in enumerate(serial.link_transforms(chain, q))]


def flange_transform(chain: Chain) -> tuple[str, str, Floats]:
    """The flange lies in the last link's frame."""
    return (f"link_{chain.n}", FLANGE, np.eye(4))


def quaternion_of(R: Floats) -> tuple[float, float, float, float]:
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
