"""Frames on a tangent plane, and small rotations."""

from __future__ import annotations

import math

import numpy as np

from canprobe.touch._arrays import Array

_AXIS_LIMIT = 0.95
"""Above this |component| of the normal the frame's own x axis is too close to it, and y is used."""


def tangent_rotation(z_axis: Array) -> Array:
    """Right-handed axes with the given z; x is the parent frame's x axis laid on the tangent plane.

    Where z is within 18° of the parent's x axis, the parent's y axis is laid on the plane instead. The choice depends
    on z alone, so that two nearly equal normals give nearly equal axes.

    Args:
        z_axis: (3,) unit vector.

    Returns:
        (3, 3), columns x, y, z.
    """
    zx, zy, zz = float(z_axis[0]), float(z_axis[1]), float(z_axis[2])
    if abs(zx) <= _AXIS_LIMIT:
        scale = 1.0 / math.sqrt(max(zy * zy + zz * zz, 1e-300))
        xx, xy, xz = (zy * zy + zz * zz) * scale, -zx * zy * scale, -zx * zz * scale
    else:
        scale = 1.0 / math.sqrt(zx * zx + zz * zz)
        xx, xy, xz = -zy * zx * scale, (zx * zx + zz * zz) * scale, -zy * zz * scale
    return np.array(
        [
            [xx, zy * xz - zz * xy, zx],
            [xy, zz * xx - zx * xz, zy],
            [xz, zx * xy - zy * xx, zz],
        ]
    )


def transported_rotation(R: Array, z_axis: Array) -> Array:
    """Axes turned the shortest way so that z becomes `z_axis` (parallel transport over a small step).

    Args:
        R: (3, 3) axes, columns x, y, z.
        z_axis: (3,) the new unit z.

    Returns:
        (3, 3).
    """
    x, y, z = R[:, 0].tolist()
    u, v, w = z_axis.tolist()
    along = x * u + y * v + z * w
    x, y, z = x - along * u, y - along * v, z - along * w
    size = math.sqrt(x * x + y * y + z * z)
    if size < 1e-6:
        return tangent_rotation(z_axis)
    x, y, z = x / size, y / size, z / size
    return np.array([[x, v * z - w * y, u], [y, w * x - u * z, v], [z, u * y - v * x, w]])


def homogeneous(R: Array, origin: Array) -> Array:
    """The 4x4 matrix of a rotation and an origin."""
    T = np.zeros((4, 4))
    T[:3, :3] = R
    T[:3, 3] = origin
    T[3, 3] = 1.0
    return T


def inverse_transform(T: Array) -> Array:
    """The inverse of a rigid 4x4 transform."""
    R = T[:3, :3].T
    return homogeneous(R, -R @ T[:3, 3])


def cross(a: Array, b: Array) -> Array:
    """Cross product of two (3,) vectors without the overhead of `numpy.cross`."""
    a0, a1, a2 = float(a[0]), float(a[1]), float(a[2])
    b0, b1, b2 = float(b[0]), float(b[1]), float(b[2])
    return np.array([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0])


def skew(w: Array) -> Array:
    """The (3, 3) matrix of `w ×`."""
    x, y, z = float(w[0]), float(w[1]), float(w[2])
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_vector(R: Array) -> Array:
    """The rotation vector (angle times axis, rad) of a rotation below a half turn."""
    w = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = 0.5 * math.sqrt(float(w @ w))
    angle = math.atan2(sine, 0.5 * (float(np.trace(R)) - 1.0))
    return w * (0.5 if sine < 1e-12 else 0.5 * angle / sine)
