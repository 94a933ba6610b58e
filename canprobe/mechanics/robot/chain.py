"""A serial arm as a chain of frames: places of its axes and its flange, and the motion of points on the flange.

A chain is any geometry of 1 to 8 joints, revolute or prismatic. Joint i turns about, or slides along, the z axis of its
own frame; a fixed transform leads from the frame of joint i - 1, moved by that joint, to the frame of joint i. The
first transform holds the mount pose of the arm, the last one leads to the flange.

One evaluation (`posture`) goes through the chain once and keeps axes and origins, from which poses, Jacobians and
velocities follow. It is a loop on plain floats. Why not matrix products: a cycle of 2.5 ms has no time for many small
numpy calls. A frame may be turned about its own z axis if the angle of its joint is counted from there. With that
freedom every fixed rotation becomes a turn about x alone, which costs half of a product of matrices
(`Chain._straighten`).

Joint vectors q are in rad, or in m for prismatic joints. Frames are spelled in names: `T_base_flange` takes flange
coordinates to base.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate
from math import atan2, cos, sin
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from canprobe.errors import PlanError
from canprobe.mechanics.types import Floats, Vec

Convention = Literal["standard", "modified"]
MAX_JOINTS = 8
_RIGIDITY_TOLERANCE = 1e-9
"""Largest error of a fixed transform as a rotation."""


class _Link(NamedTuple):
    """From the frame of a joint to the next one: a turn or slide by q, then a translation and a turn about x.

    Attributes:
        prismatic: whether the joint slides.
        offset: angle of the joint at q = 0, rad.
        px, py, pz: translation, m.
        c, s: cosine and sine of the turn about x.
    """

    prismatic: bool
    offset: float
    px: float
    py: float
    pz: float
    c: float
    s: float


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """Geometry of a serial arm; compared by identity.

    Args:
        name: name of the arm.
        joints: names of the n joints, from the base.
        prismatic: whether each joint slides along z; the others turn about z.
        fixed: (n, 4, 4) transforms from the frame of each joint at q = 0 to that of the joint before, of the first
            joint to base, m.
        T_last_flange: (4, 4) flange to the frame of the last joint, m.

    Raises:
        PlanError: there is no joint or more than 8, lengths differ, or a transform is not rigid.
    """

    name: str
    joints: tuple[str, ...]
    prismatic: tuple[bool, ...]
    fixed: Floats
    T_last_flange: Floats
    _first: tuple[float, ...] = field(init=False, repr=False)
    _links: tuple[_Link, ...] = field(init=False, repr=False)
    _last: tuple[float, float] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        fixed, flange = np.array(self.fixed, dtype=float), np.array(self.T_last_flange, dtype=float)
        self._refuse_odd(fixed, flange)
        for name, array in (("fixed", fixed), ("T_last_flange", flange)):
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        self._straighten()

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.joints)

    def _refuse_odd(self, fixed: Floats, flange: Floats) -> None:
        n, where = len(self.joints), f"chain {self.name!r}"
        if not 1 <= n <= MAX_JOINTS:
            raise PlanError([f"{where}: expected 1 to {MAX_JOINTS} joints, got {n}"])
        if len(set(self.joints)) < n:
            raise PlanError([f"{where}: expected a name of its own for each joint, got {', '.join(self.joints)}"])
        if len(self.prismatic) != n or fixed.shape != (n, 4, 4) or flange.shape != (4, 4):
            raise PlanError(
                [
                    f"{where}: expected {n} joint types, {n} transforms (4, 4) and one to the flange, got "
                    f"{len(self.prismatic)}, {fixed.shape} and {flange.shape}"
                ]
            )
        for place, T in zip((*self.joints, "flange"), (*fixed, flange), strict=True):
            R = T[:3, :3]
            rigid = np.abs(R @ R.T - np.eye(3)).max() < _RIGIDITY_TOLERANCE and np.linalg.det(R) > 0.0
            if not (np.all(np.isfinite(T)) and rigid and np.array_equal(T[3], (0.0, 0.0, 0.0, 1.0))):
                raise PlanError([f"{where}: the transform to {place} is not a rotation with a translation: {T!r}"])

    def _straighten(self) -> None:
        """Turn every frame about its own z axis until the turn to the next one is about x alone.

        A rotation is Rz(b) Rx(a) Rz(c). The turn b is taken over by the joint before it, c by the joint behind it.
        """
        first, links, before = self.fixed[0], [], 0.0
        for prismatic, T in zip(self.prismatic, (*self.fixed[1:], self.T_last_flange), strict=True):
            R, p = T[:3, :3], T[:3, 3]
            b = atan2(R[0, 2], -R[1, 2])
            M = _turn_z(-b) @ R  # Rx(a) Rz(c), whatever b is where the axes are parallel
            px, py, pz = (_turn_z(-b) @ p).tolist()
            links.append(_Link(prismatic, before + b, px, py, pz, float(M[2, 2]), float(-M[1, 2])))
            before = atan2(-M[0, 1], M[0, 0])
        object.__setattr__(self, "_first", tuple(first[:3, :].T.ravel().tolist()))
        object.__setattr__(self, "_links", tuple(links))
        object.__setattr__(self, "_last", (cos(before), sin(before)))


def ending_in(chain: Chain, T_flange_tool: Floats) -> Chain:
    """The same arm with the frame of a tool in place of its flange, so that its posture is that of the tool.

    Args:
        chain: the arm.
        T_flange_tool: (4, 4) tool to flange, m.

    Raises:
        PlanError: the tool's frame is not a rotation with a translation.
    """
    return replace(chain, T_last_flange=chain.T_last_flange @ T_flange_tool)


@dataclass(slots=True, eq=False)
class Posture:
    """Axes and origins of a chain at some q, and its flange, in the base frame, as plain floats.

    Attributes:
        axes: unit vector of each joint's axis.
        origins: a point on each joint's axis, m.
        prismatic: whether each joint slides.
        x, y, z: axes of the flange.
        flange: origin of the flange, m.
    """

    axes: list[Vec]
    origins: list[Vec]
    prismatic: tuple[bool, ...]
    x: Vec
    y: Vec
    z: Vec
    flange: Vec


def posture(chain: Chain, q: npt.ArrayLike) -> Posture:
    """Evaluate a chain.

    Args:
        chain: the arm.
        q: (n,) joint positions, rad or m.
    """
    values: Sequence[float] = q if isinstance(q, (list, tuple)) else np.asarray(q, dtype=float).tolist()
    axes: list[Vec] = []
    origins: list[Vec] = []
    x0, x1, x2, y0, y1, y2, z0, z1, z2, p0, p1, p2 = chain._first
    for (prismatic, offset, px, py, pz, ca, sa), value in zip(chain._links, values, strict=True):
        axes.append((z0, z1, z2))
        origins.append((p0, p1, p2))
        angle, rise = (offset, pz + value) if prismatic else (offset + value, pz)
        c, s = cos(angle), sin(angle)
        # x and the turned y; the next frame has this x, and y and z turned about it
        w0, w1, w2 = c * y0 - s * x0, c * y1 - s * x1, c * y2 - s * x2
        x0, x1, x2 = c * x0 + s * y0, c * x1 + s * y1, c * x2 + s * y2
        p0 += px * x0 + py * w0 + rise * z0
        p1 += px * x1 + py * w1 + rise * z1
        p2 += px * x2 + py * w2 + rise * z2
        y0, y1, y2 = ca * w0 + sa * z0, ca * w1 + sa * z1, ca * w2 + sa * z2
        z0, z1, z2 = ca * z0 - sa * w0, ca * z1 - sa * w1, ca * z2 - sa * w2
    c, s = chain._last
    return Posture(
        axes,
        origins,
        chain.prismatic,
        (c * x0 + s * y0, c * x1 + s * y1, c * x2 + s * y2),
        (c * y0 - s * x0, c * y1 - s * x1, c * y2 - s * x2),
        (z0, z1, z2),
        (p0, p1, p2),
    )


def forward(chain: Chain, q: npt.ArrayLike) -> Floats:
    """Flange pose.

    Args:
        chain: the arm.
        q: (n,) joint positions, rad or m.

    Returns:
        (4, 4) T_base_flange, m.
    """
    return pose_of(posture(chain, q))


def forward_jacobian(chain: Chain, q: npt.ArrayLike, T_flange_tool: Floats) -> tuple[Floats, Floats]:
    """Tool pose and geometric Jacobian of the tool origin.

    Args:
        chain: the arm.
        q: (n,) joint positions, rad or m.
        T_flange_tool: (4, 4) tool in the flange frame, m.

    Returns:
        (4, 4) T_base_tool and (6, n) J in the base frame: rows 0-2 velocity of the tool origin (m/s), rows 3-5 angular
        velocity (rad/s), per rate of each joint (rad/s or m/s).
    """
    at = posture(chain, q)
    T_base_tool = pose_of(at) @ T_flange_tool
    return T_base_tool, jacobian(at, tuple(T_base_tool[:3, 3].tolist()))


def jacobian(at: Posture, point: Vec) -> Floats:
    """Geometric Jacobian of a point fixed to the flange.

    Args:
        at: the evaluated chain.
        point: the point now, base frame, m.

    Returns:
        (6, n) J in the base frame, see `forward_jacobian`.
    """
    px, py, pz = point
    flat: list[float] = []
    for (ax, ay, az), (ox, oy, oz), slides in zip(at.axes, at.origins, at.prismatic, strict=True):
        if slides:
            flat += (ax, ay, az, 0.0, 0.0, 0.0)
            continue
        dx, dy, dz = px - ox, py - oy, pz - oz
        flat += (ay * dz - az * dy, az * dx - ax * dz, ax * dy - ay * dx, ax, ay, az)
    return np.array(flat).reshape(-1, 6).T


def point_velocity(at: Posture, point: Vec, qd: npt.ArrayLike) -> Vec:
    """Velocity of a point fixed to the flange, without building the Jacobian.

    Args:
        at: the evaluated chain.
        point: the point now, base frame, m.
        qd: (n,) joint rates, rad/s or m/s.

    Returns:
        Velocity in the base frame, m/s.
    """
    rates: Sequence[float] = qd if isinstance(qd, (list, tuple)) else np.asarray(qd, dtype=float).tolist()
    px, py, pz = point
    vx = vy = vz = 0.0
    for (ax, ay, az), (ox, oy, oz), slides, rate in zip(at.axes, at.origins, at.prismatic, rates, strict=True):
        if slides:
            vx, vy, vz = vx + rate * ax, vy + rate * ay, vz + rate * az
            continue
        dx, dy, dz = px - ox, py - oy, pz - oz
        vx += rate * (ay * dz - az * dy)
        vy += rate * (az * dx - ax * dz)
        vz += rate * (ax * dy - ay * dx)
    return vx, vy, vz


def link_transforms(chain: Chain, q: npt.ArrayLike) -> list[Floats]:
    """Frames of all links, each in that of the link before.

    The frame of a link is the one where the next joint begins, as of a standard Denavit-Hartenberg row; that of the
    last link is the flange.

    Args:
        chain: the arm.
        q: (n,) joint positions, rad or m.

    Returns:
        n transforms (4, 4), m; the first is in base, and the product of all is the flange pose.
    """
    moved = [_motion(slides, value) for slides, value in zip(chain.prismatic, np.asarray(q).tolist(), strict=True)]
    links = [motion @ T for motion, T in zip(moved, (*chain.fixed[1:], chain.T_last_flange), strict=True)]
    return [chain.fixed[0] @ links[0], *links[1:]]


def link_frames(chain: Chain, q: npt.ArrayLike) -> Floats:
    """Frames of the base and of every link.

    Args:
        chain: the arm.
        q: joint positions (n,), rad or m.

    Returns:
        Poses T_base_link (n + 1, 4, 4); the last is the flange.
    """
    return np.array([*accumulate(link_transforms(chain, q), np.matmul, initial=np.eye(4))])


def pose_of(at: Posture) -> Floats:
    """(4, 4) T_base_flange, m, of an evaluated chain."""
    (x0, x1, x2), (y0, y1, y2), (z0, z1, z2), (p0, p1, p2) = at.x, at.y, at.z, at.flange
    flat = (x0, y0, z0, p0, x1, y1, z1, p1, x2, y2, z2, p2, 0.0, 0.0, 0.0, 1.0)  # nested ones take numpy longer
    return np.array(flat).reshape(4, 4)


def _turn_z(angle: float) -> Floats:
    c, s = cos(angle), sin(angle)
    return np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))


def _motion(slides: bool, value: float) -> Floats:
    T = np.eye(4)
    if slides:
        T[2, 3] = value
    else:
        T[:3, :3] = _turn_z(value)
    return T
