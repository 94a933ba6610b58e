"""Rotation matrices as the unit quaternions that viewers want."""

from __future__ import annotations

import math

import numpy as np

from canprobe.bridge.view.meshes import Array


def quaternion(R: Array) -> Array:
    """(4,) unit quaternion w, x, y, z of a rotation matrix (3, 3), w ≥ 0.

    Source: Shepperd, "Quaternion from rotation matrix", J. Guidance and Control 1, 1978: the largest part first.
    """
    squares = np.array([1.0 + np.trace(R), *(1.0 + 2.0 * R[i, i] - np.trace(R) for i in range(3))])
    k = int(np.argmax(squares))
    cross = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    q = np.empty(4)
    if k == 0:
        q[:] = (squares[0], *cross)
    else:
        i = k - 1
        q[0] = cross[i]
        q[1:] = R[i] + R[:, i]
        q[1 + i] = squares[k]
    q /= math.sqrt(float(q @ q))
    return q if q[0] >= 0.0 else -q
