"""The PUMA 260 as numbers, and its forward kinematics and geometric Jacobian in closed form, on plain floats.

The chain is written out for the PUMA pattern: joints 2 and 3 are parallel, the wrist axes meet in one point.
Unrolled floats cost a third of a product of 4x4 arrays.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import cos, sin
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

# The PUMA 260 as numbers: link geometry, joint ranges, speeds, motor counts and wrist coupling.
#
# Two published geometries are shipped. They disagree by millimetres, which makes their difference a realistic
# calibration error. Joint zero positions and ranges follow the UPenn convention in both.

Array = npt.NDArray[np.float64]

_INCH = 0.0254
_ALPHA = (math.pi / 2, 0.0, -math.pi / 2, math.pi / 2, -math.pi / 2, 0.0)

GEAR_RATIOS = (46.72, 69.9733, 42.9867, 43.5111, 39.3846, 31.7692)
ENCODER_COUNTS_PER_TURN = (1000, 1000, 1000, 800, 800, 800)
COUPLING_J4_J5 = -9.8462
COUPLING_J4_J6 = 1.0
COUPLING_J5_J6 = -5.6


@dataclass(frozen=True, slots=True, eq=False)
class PumaModel:
    """Geometry and drive numbers of one arm; compared by identity.

    Args:
        name: key in ``MODELS``.
        dh: (6, 3) standard Denavit-Hartenberg rows: a in m, alpha in rad, d in m. Closed forms need the PUMA
            pattern: alpha (+90, 0, -90, +90, -90, 0) degrees, a non-zero in rows 2 and 3 only, d5 = 0.
        q_min: (6,) lower joint limits, rad.
        q_max: (6,) upper joint limits, rad.
        qd_max: (6,) joint speed limits, rad/s.
        counts: (6, 6) motor encoder counts per radian of each joint; wrist motors are coupled.

    Raises:
        ValueError: for a geometry outside the PUMA pattern.
    """

    name: str
    dh: Array
    q_min: Array
    q_max: Array
    qd_max: Array
    counts: Array
    joints_per_count: Array = field(init=False)
    links: tuple[float, float, float, float, float, float] = field(init=False)
    """d1, a2, d2 + d3, a3, d4, d6 in m: all that the closed forms need (d2 and d3 lie on parallel axes)."""

    def __post_init__(self) -> None:
        a, alpha, d = np.asarray(self.dh, dtype=float).T
        if np.any(np.abs(alpha - _ALPHA) > 1e-12) or np.any(a[[0, 3, 4, 5]] != 0.0) or d[4] != 0.0:
            raise ValueError(f"model {self.name!r}: DH rows do not follow the PUMA pattern: {self.dh!r}")
        links = (float(d[0]), float(a[1]), float(d[1] + d[2]), float(a[2]), float(d[3]), float(d[5]))
        object.__setattr__(self, "links", links)
        object.__setattr__(self, "joints_per_count", np.linalg.inv(self.counts))
        for name in ("dh", "q_min", "q_max", "qd_max", "counts", "joints_per_count"):
            array = np.array(getattr(self, name), dtype=float)
            array.setflags(write=False)
            object.__setattr__(self, name, array)


def joints_to_counts(model: PumaModel, q: npt.ArrayLike) -> Array:
    """Motor positions of joint angles.

    Args:
        model: the arm.
        q: (6,) joint angles, rad (or rates, rad/s).

    Returns:
        (6,) motor positions in encoder counts, not rounded (or counts/s).
    """
    counts: Array = model.counts @ np.asarray(q, dtype=float)
    return counts


def counts_to_joints(model: PumaModel, counts: npt.ArrayLike) -> Array:
    """Joint angles of motor positions, the inverse of ``joints_to_counts``.

    Args:
        model: the arm.
        counts: (6,) motor positions in encoder counts.

    Returns:
        (6,) joint angles, rad.
    """
    q: Array = model.joints_per_count.dot(np.asarray(counts, dtype=float))
    return q


def coupling_matrix() -> Array:
    """Motor turns per joint turn, (6, 6).

    Turning joint 4 drags the motors of joints 5 and 6 along, joint 5 that of joint 6.

    Source: gear ratios and wrist coupling of the PUMA 200 series as used by YARP's Babybot driver.
    """
    turns = np.diag(GEAR_RATIOS)
    turns[4, 3], turns[5, 3], turns[5, 4] = COUPLING_J4_J5, COUPLING_J4_J6, COUPLING_J5_J6
    return turns


def _model(name: str, *, a2: float, a3: float, d2: float, d3: float, d6: float) -> PumaModel:
    d1, d4 = 13 * _INCH, 8 * _INCH
    a, d = (0.0, a2, a3, 0.0, 0.0, 0.0), (d1, d2, d3, d4, 0.0, d6)
    return PumaModel(
        name=name,
        dh=np.column_stack((a, _ALPHA, d)),
        q_min=np.radians((-180.0, -75.0, -235.0, -580.0, -30.0, -215.0)),
        q_max=np.radians((110.0, 240.0, 60.0, 40.0, 200.0, 295.0)),
        qd_max=np.radians((210.0, 210.0, 210.0, 675.0, 675.0, 1350.0)),
        counts=np.diag(ENCODER_COUNTS_PER_TURN) @ coupling_matrix() / (2 * math.pi),
    )


UPENN = _model("upenn", a2=8 * _INCH, a3=0.0, d2=-2.5 * _INCH, d3=-2.5 * _INCH, d6=2.5 * _INCH)
"""UPenn MEAM 520: upper arm 203.2 mm, no elbow offset, shoulder offset 127.0 mm, flange 63.5 mm."""

UNIMATE = _model("unimate", a2=7.8 * _INCH, a3=-0.75 * _INCH, d2=-4.9 * _INCH, d3=0.0, d6=2.2 * _INCH)
"""After the Unimate manual (RPI 260B, YARP Babybot): 198.1 mm, -19.05 mm elbow, 124.5 mm shoulder, 55.9 mm flange.

The elbow offset is taken as the DH length a3, at right angles to the forearm.
"""

MODELS: Mapping[str, PumaModel] = MappingProxyType({"upenn": UPENN, "unimate": UNIMATE})

ELBOW_FORM = np.radians((90.0, 65.0, 15.0, 0.0, 100.0, 0.0))
"""Well-conditioned pose with the flange pointing down at the scan region; the usual ``q_near``, rad."""
ELBOW_FORM.setflags(write=False)


# Forward kinematics and geometric Jacobian in closed form, on plain floats.

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


# Motors, gears and friction of the arm, each seen at its own joint.
#
# Motor coordinates: the angle of motor i divided by its gear ratio, so that without the wrist's coupling they are the
# joint angles. Rotor inertia, friction and drive torque act there, one motor each; the rigid body lives at the joints.
#
# Source: PUMA 560 (Corke & Armstrong-Helouvry 1994) scaled by size; torque limits of a CRS A255-like arm, peak assumed.

REFLECTED_INERTIA = (0.030, 0.088, 0.022, 0.0072, 0.0064, 0.0073)
"""Motor inertia at the joint, kg m^2."""
COULOMB_NM = (2.2, 1.1, 0.57, 0.10, 0.083, 0.064)
VISCOUS_NMS = (0.32, 0.52, 0.22, 0.023, 0.023, 0.012)
CONTINUOUS_TORQUE_NM = (6.4, 6.4, 6.4, 1.4, 0.7, 0.7)
PEAK_PERMILLE = 2000
"""Of the continuous torque."""
STICTION_RATE = 0.01
"""rad/s over which the Coulomb torque turns its sign."""


def motors_per_joint() -> Array:
    """(6, 6) motor coordinates per joint angle: one on the diagonal, the wrist's coupling below it."""
    turns: Array = coupling_matrix() / np.array(GEAR_RATIOS)[:, None]
    return turns


def joints_per_motor() -> Array:
    """(6, 6) joint angles per motor coordinate, the inverse of ``motors_per_joint``."""
    return np.array(np.linalg.inv(motors_per_joint()), dtype=np.float64)


def counts_per_radian(model: PumaModel) -> Array:
    """(6,) encoder counts per radian of each motor coordinate.

    Args:
        model: the arm.
    """
    return np.diag(model.counts).copy()


# How finely the encoders tell where the tool is.


def count_sigma(model: PumaModel, q: npt.ArrayLike, T_flange_tool: Array, direction: npt.ArrayLike) -> float:
    """Standard deviation of the tool's position along a direction, m, as encoders round to whole counts.

    Args:
        model: the arm.
        q: joint angles (6,), rad.
        T_flange_tool: (4, 4) from the tool's frame to the flange, m.
        direction: unit vector (3,), base frame.

    Source: a rounding error is uniform over one count, of variance 1/12, and independent from motor to motor.
    """
    _, J = forward_jacobian(model, q, T_flange_tool)
    per_count = np.asarray(direction, dtype=float) @ J[:3] @ model.joints_per_count
    return float(np.linalg.norm(per_count)) / math.sqrt(12.0)
