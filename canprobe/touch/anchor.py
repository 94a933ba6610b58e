"""From a fit in a working frame to the estimated contact frame."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from canprobe.touch._arrays import Array, inverted, solved
from canprobe.touch.estimate import Solution
from canprobe.touch.evidence import curvature_covariance
from canprobe.touch.frames import homogeneous, tangent_rotation
from canprobe.touch.quadric import transport
from canprobe.touch.rank import Decision, turned


class Anchor(NamedTuple):
    """A solution in its own contact frame.

    Attributes:
        c: (9,) dimensionless, c14 = c24 = c44 = 0.
        M: (9, 9) d(c)/d(c of the working frame).
        T_frame_contact: (4, 4), m.
        turn: angle of the contact frame's x axis from the working frame's, rad.
    """

    c: Array
    M: Array
    T_frame_contact: Array
    turn: float


def foot(c: Array, start: Array) -> tuple[Array, Array]:
    """Foot of a nearby point (3,) on the model's surface and the inward unit normal there, dimensionless."""
    c14, c24, c44, c13, c23, c33, c11, c12, c22 = c.tolist()
    sx, sy, sz = x, y, z = start.tolist()
    for last in (False, False, False, False, True):
        gx = 2.0 * (c11 * x + c12 * y + c13 * z + c14)
        gy = 2.0 * (c12 * x + c22 * y + c23 * z + c24)
        gz = 2.0 * (c13 * x + c23 * y + c33 * z) - 1.0
        square = gx * gx + gy * gy + gz * gz
        if last:
            break
        f = 0.5 * (x * (gx + 2.0 * c14) + y * (gy + 2.0 * c24) + z * (gz - 1.0)) + c44
        # along the gradient to the surface, and back over the start along the tangent plane
        ox, oy, oz = x - sx, y - sy, z - sz
        k = (ox * gx + oy * gy + oz * gz - f) / square
        x, y, z = sx + k * gx, sy + k * gy, sz + k * gz
    size = -1.0 / math.sqrt(square)
    return np.array([x, y, z]), np.array([gx * size, gy * size, gz * size])


def anchor(c: Array, T_frame_work: Array, point: Array, length: float) -> Anchor:
    """Re-express a model at the foot of a point.

    Args:
        c: (9,) in the working frame, in units of `length`.
        T_frame_work: (4, 4), m.
        point: (3,) in the working frame, in units of `length`.
        length: m.
    """
    x, z = foot(c, point)
    R_work = T_frame_work[:3, :3]
    R = tangent_rotation(R_work @ z)
    R_work_contact = R_work.T @ R
    c_new, M = transport(c, homogeneous(R_work_contact, x))
    c_new[:3] = 0.0
    origin = T_frame_work[:3, 3] + R_work @ (length * x)
    turn = math.atan2(R_work_contact[1, 0] - R_work_contact[0, 1], R_work_contact[0, 0] + R_work_contact[1, 1])
    return Anchor(c_new, M, homogeneous(R, origin), turn)


def solution(a: Anchor, root: Array, decision: Decision, has_prior: bool) -> Solution:
    """Covariance of K by the delta method.

    Args:
        a: where the answer is given.
        root: (9, 9) information root in the working frame.
        decision: rank decision there; its axes are turned into the contact frame.
        has_prior: the root is regular whatever the data.
    """
    decision = decision._replace(vectors=turned(a.turn) @ decision.vectors)
    here = solved(a.M.T, root.T).T
    if decision.rank < 3 and not has_prior:
        return Solution(a.c, np.full((3, 3), math.nan), decision, has_prior, here)
    return Solution(a.c, curvature_covariance(a.c, a.M @ inverted(root)), decision, has_prior, here)
