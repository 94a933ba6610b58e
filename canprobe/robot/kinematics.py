"""Forward kinematics and geometric Jacobian in closed form, on plain floats.

The chain is written out for the PUMA pattern: joints 2 and 3 are parallel, the wrist axes meet in one point.
Unrolled floats cost a third of a product of 4x4 arrays.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin

import numpy as np
import numpy.typing as npt

from canprobe.robot.puma260 import Array, PumaModel

Vec = tuple[float, float, float]
Six = tuple[float, float, float, float, float, float]


@dataclass(slots=True, eq=False)
class Chain:
    """Points and axes of the arm in the base frame, as plain floats (one evaluation of the chain).

    Columns x, y, z of the flange; the flange origin; wrist centre; elbow point; the axes of joints 2 and 3 (parallel),
    4, 5, 6. Joint 1 turns about base z through the origin; joint 2 passes through (0, 0, d1).
    """

    x: Vec
    y: Vec
    z: Vec
    flange: Vec
    wrist: Vec
    elbow: Vec
    axis2: Vec
    axis4: Vec
    axis5: Vec
    d1: float


def chain(model: PumaModel, q: npt.ArrayLike) -> Chain:
    """Evaluate the chain.

    Args:
        model: the arm.
        q: (6,) joint angles, rad.

    Source: product of the standard DH transforms, worked out by hand; checked against the matrix product in tests.
    """
    d1, a2, offset, a3, d4, d6 = model.links
    q1, q2, q3, q4, q5, q6 = q if isinstance(q, (list, tuple)) else np.asarray(q, dtype=float).tolist()
    c1, s1, c2, s2, c23, s23 = cos(q1), sin(q1), cos(q2), sin(q2), cos(q2 + q3), sin(q2 + q3)
    c4, s4, c5, s5, c6, s6 = cos(q4), sin(q4), cos(q5), sin(q5), cos(q6), sin(q6)
    # Elbow and wrist centre in the vertical plane of the arm, then turned by joint 1.
    re, he = a2 * c2, d1 + a2 * s2
    rw, hw = re + a3 * c23 - d4 * s23, he + a3 * s23 + d4 * c23
    wrist = (rw * c1 + offset * s1, rw * s1 - offset * c1, hw)
    # Frame 3: x3 = (c23 c1, c23 s1, s23), y3 = (-s1, c1, 0), z3 = (-s23 c1, -s23 s1, c23).
    x0, x1, x2 = c23 * c1, c23 * s1, s23
    z0, z1, z2 = -s23 * c1, -s23 * s1, c23
    # Rotation 3 -> 6 is Rz(q4) Ry(-q5) Rz(q6); its columns one by one.
    m00, m10, m20 = c4 * c5 * c6 - s4 * s6, s4 * c5 * c6 + c4 * s6, s5 * c6
    m01, m11, m21 = -c4 * c5 * s6 - s4 * c6, -s4 * c5 * s6 + c4 * c6, -s5 * s6
    m02, m12, m22 = -c4 * s5, -s4 * s5, c5
    zx, zy, zz = x0 * m02 - s1 * m12 + z0 * m22, x1 * m02 + c1 * m12 + z1 * m22, x2 * m02 + z2 * m22
    return Chain(
        x=(x0 * m00 - s1 * m10 + z0 * m20, x1 * m00 + c1 * m10 + z1 * m20, x2 * m00 + z2 * m20),
        y=(x0 * m01 - s1 * m11 + z0 * m21, x1 * m01 + c1 * m11 + z1 * m21, x2 * m01 + z2 * m21),
        z=(zx, zy, zz),
        flange=(wrist[0] + d6 * zx, wrist[1] + d6 * zy, wrist[2] + d6 * zz),
        wrist=wrist,
        elbow=(re * c1, re * s1, he),
        axis2=(s1, -c1, 0.0),
        axis4=(z0, z1, z2),
        axis5=(s4 * x0 + c4 * s1, s4 * x1 - c4 * c1, s4 * x2),
        d1=d1,
    )


def _pose(c: Chain) -> Array:
    (x0, x1, x2), (y0, y1, y2), (z0, z1, z2), (p0, p1, p2) = c.x, c.y, c.z, c.flange
    flat = (x0, y0, z0, p0, x1, y1, z1, p1, x2, y2, z2, p2, 0.0, 0.0, 0.0, 1.0)  # nested ones take numpy longer
    return np.array(flat).reshape(4, 4)


def forward(model: PumaModel, q: npt.ArrayLike) -> Array:
    """Flange pose.

    Args:
        model: the arm.
        q: (6,) joint angles, rad.

    Returns:
        (4, 4) T_base_flange, m.
    """
    return _pose(chain(model, q))


def forward_jacobian(model: PumaModel, q: npt.ArrayLike, T_flange_tool: Array) -> tuple[Array, Array]:
    """Tool pose and geometric Jacobian of the tool origin.

    Args:
        model: the arm.
        q: (6,) joint angles, rad.
        T_flange_tool: (4, 4) tool in the flange frame, m.

    Returns:
        (4, 4) T_base_tool and (6, 6) J in the base frame: rows 0-2 velocity of the tool origin (m/s per rad/s),
        rows 3-5 angular velocity.
    """
    c = chain(model, q)
    T_base_tool = _pose(c) @ T_flange_tool
    (fx, fy, fz), (gx, gy, gz), (hx, hy, hz) = c.axis4, c.axis5, c.z
    px, py, pz = T_base_tool[:3, 3].tolist()
    ax, ay, _ = c.axis2
    x, y, z = point_jacobian(c, (px, py, pz))
    turns = (0.0, ax, ax, fx, gx, hx, 0.0, ay, ay, fy, gy, hy, 1.0, 0.0, 0.0, fz, gz, hz)
    return T_base_tool, np.array((*x, *y, *z, *turns)).reshape(6, 6)


def point_jacobian(c: Chain, point: Vec) -> tuple[Six, Six, Six]:
    """Velocity of a point fixed to the flange, per joint rate.

    Args:
        c: the evaluated chain.
        point: the point now, base frame, m.

    Returns:
        Rows x, y and z in the base frame, m/s per rad/s.
    """
    px, py, pz = point
    ax, ay, _ = c.axis2
    (fx, fy, fz), (gx, gy, gz), (hx, hy, hz) = c.axis4, c.axis5, c.z
    ex, ey, ez = px - c.elbow[0], py - c.elbow[1], pz - c.elbow[2]
    wx, wy, wz = px - c.wrist[0], py - c.wrist[1], pz - c.wrist[2]
    sz = pz - c.d1
    return (
        (-py, ay * sz, ay * ez, fy * wz - fz * wy, gy * wz - gz * wy, hy * wz - hz * wy),
        (px, -ax * sz, -ax * ez, fz * wx - fx * wz, gz * wx - gx * wz, hz * wx - hx * wz),
        (0.0, ax * py - ay * px, ax * ey - ay * ex, fx * wy - fy * wx, gx * wy - gy * wx, hx * wy - hy * wx),
    )


def point_on_flange(c: Chain, offset: Vec) -> Vec:
    """Place of a point fixed to the flange, base frame, m.

    Args:
        c: the evaluated chain.
        offset: of the point in the flange frame, m.
    """
    a, b, d = offset
    (x0, x1, x2), (y0, y1, y2), (z0, z1, z2), (p0, p1, p2) = c.x, c.y, c.z, c.flange
    return p0 + x0 * a + y0 * b + z0 * d, p1 + x1 * a + y1 * b + z1 * d, p2 + x2 * a + y2 * b + z2 * d


def point_velocity(c: Chain, point: Vec, qd: npt.ArrayLike) -> Vec:
    """Velocity of a point fixed to the flange, without building the Jacobian.

    Args:
        c: the evaluated chain.
        point: the point now, base frame, m.
        qd: (6,) joint rates, rad/s.

    Returns:
        Velocity in the base frame, m/s.
    """
    w1, w2, w3, w4, w5, w6 = qd if isinstance(qd, (list, tuple)) else np.asarray(qd, dtype=float).tolist()
    px, py, pz = point
    (ax, ay, _), (fx, fy, fz), (gx, gy, gz), (hx, hy, hz) = c.axis2, c.axis4, c.axis5, c.z
    ox, oy, oz = w4 * fx + w5 * gx + w6 * hx, w4 * fy + w5 * gy + w6 * hy, w4 * fz + w5 * gz + w6 * hz
    wx, wy, wz = px - c.wrist[0], py - c.wrist[1], pz - c.wrist[2]
    ex, ey, ez = px - c.elbow[0], py - c.elbow[1], pz - c.elbow[2]
    lift = w2 * (pz - c.d1) + w3 * ez
    return (
        -w1 * py + ay * lift + oy * wz - oz * wy,
        w1 * px - ax * lift + oz * wx - ox * wz,
        w2 * (ax * py - ay * px) + w3 * (ax * ey - ay * ex) + ox * wy - oy * wx,
    )


def tool_z_offset(offset_mm: float) -> Array:
    """A tool frame along the flange's z axis, axes parallel.

    Args:
        offset_mm: distance from the flange, mm.

    Returns:
        (4, 4) T_flange_tool, m.
    """
    T_flange_tool = np.eye(4)
    T_flange_tool[2, 3] = 1e-3 * offset_mm
    return T_flange_tool
