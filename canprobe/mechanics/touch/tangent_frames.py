"""Frames on a tangent plane."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from canprobe.mechanics.types import Floats, Vec

_MAX_AXIS_COSINE = 0.95
"""Largest |x component| of a normal at which the parent's x axis is laid on the plane; beyond it the y axis is."""


def tangent_rotation(z_axis: Sequence[float] | Floats) -> Floats:
    """Right-handed axes (3, 3), columns x, y, z, with a given unit z; x is the parent frame's x on the tangent plane.

    Where z is within 18° of the parent's x axis, the parent's y axis is laid on the plane instead. The choice depends
    on z alone, so that two nearly equal normals give nearly equal axes.
    """
    zx, zy, zz = float(z_axis[0]), float(z_axis[1]), float(z_axis[2])
    if abs(zx) <= _MAX_AXIS_COSINE:
        scale = 1.0 / math.sqrt(max(zy * zy + zz * zz, 1e-300))
        xx, xy, xz = (zy * zy + zz * zz) * scale, -zx * zy * scale, -zx * zz * scale
    else:
        scale = 1.0 / math.sqrt(zx * zx + zz * zz)
        xx, xy, xz = -zy * zx * scale, (zx * zx + zz * zz) * scale, -zy * zz * scale
    return np.array([[xx, zy * xz - zz * xy, zx], [xy, zz * xx - zx * xz, zy], [xz, zx * xy - zy * xx, zz]])


def transported(x_axis: Vec, z_axis: Vec) -> tuple[Vec, Vec]:
    """Axes x and y, turned the shortest way so that their z becomes a unit vector: parallel transport over a step."""
    x, y, z = x_axis
    u, v, w = z_axis
    along = x * u + y * v + z * w
    x, y, z = x - along * u, y - along * v, z - along * w
    size = math.sqrt(x * x + y * y + z * z)
    if size < 1e-6:
        first, second, _ = tangent_rotation(z_axis).T.tolist()
        return first, second
    x, y, z = x / size, y / size, z / size
    return (x, y, z), (v * z - w * y, w * x - u * z, u * y - v * x)


def homogeneous(R: Floats, origin: Sequence[float] | Floats) -> Floats:
    """The 4x4 matrix of a rotation and an origin."""
    T = np.zeros((4, 4))
    T[:3, :3] = R
    T[:3, 3] = origin
    T[3, 3] = 1.0
    return T
