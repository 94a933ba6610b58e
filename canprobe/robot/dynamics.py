"""Rigid-body dynamics of the arm: masses, mass matrix, Coriolis and centrifugal torques, gravity.

Equation of motion: ``M(q) q'' + b(q, q') = tau``, all at the joints; b holds gravity. Motors, gears and friction are
not in it (``canprobe.robot.model``). The recursion over the links (``mass_and_bias``) is compiled once for each
pattern of zeros in what is known of the links.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from canprobe.robot.chain import Array
from canprobe.robot.model import ArmModel
from canprobe.robot.puma import dh_rows
from canprobe.robot.straight_line import Value, call, compiled

# Masses of the PUMA 260's links. No maker ever published them: they are those of a PUMA 560, scaled by size.
#
# Source: Corke & Armstrong-Helouvry 1994 (PUMA 560, standard Denavit-Hartenberg frames), lengths times 0.4706, masses
# times 0.17.

GRAVITY_M_S2 = 9.81

_MASS_KG = (0.0, 2.97, 0.82, 0.140, 0.058, 0.015)
_COM_MM = (
    (0.0, 0.0, 0.0),
    (-171.0, 2.8, -107.0),  # z is counted from joint 1's axis: the 560's, mirrored
    (-9.6, 6.6, 33.0),  # y mirrored
    (0.0, 8.9, 0.0),
    (0.0, 0.0, 0.0),
    (0.0, 0.0, 15.0),
)
_INERTIA_KG_MM2 = (
    (0.0, 13180.0, 0.0),
    (4890.0, 19730.0, 20290.0),
    (2480.0, 3240.0, 470.0),
    (68.0, 49.0, 68.0),
    (11.0, 15.0, 11.0),
    (5.6, 5.6, 1.5),
)


@dataclass(frozen=True, slots=True, eq=False)
class LinkInertia:
    """Rigid bodies of the six links, each in its own Denavit-Hartenberg frame.

    Args:
        mass: (6,) kg.
        com: (6, 3) centres of mass, m.
        tensor: (6, 3, 3) inertia about the centres of mass, kg m^2.
    """

    mass: Array
    com: Array
    tensor: Array

    def with_payload(self, mass: float, T_flange_payload: Array, tensor: Array) -> LinkInertia:
        """The same arm with a body fixed to its flange.

        Args:
            mass: kg.
            T_flange_payload: (4, 4) frame in the body's centre of mass, m.
            tensor: (3, 3) inertia about it in that frame, kg m^2.
        """
        total = float(self.mass[5]) + mass
        if total == 0.0:
            return self
        R, at = T_flange_payload[:3, :3], T_flange_payload[:3, 3]
        com = (self.mass[5] * self.com[5] + mass * at) / total
        both = self.tensor[5] + R @ tensor @ R.T
        both = both + _steiner(float(self.mass[5]), self.com[5] - com) + _steiner(mass, at - com)
        return LinkInertia(
            np.append(self.mass[:5], total), np.vstack((self.com[:5], com)), np.concatenate((self.tensor[:5], [both]))
        )


def _steiner(mass: float, offset: Array) -> Array:
    return mass * (float(offset @ offset) * np.eye(3) - np.outer(offset, offset))


def puma260_inertia(model: ArmModel) -> LinkInertia:
    """Links of the bare arm.

    Args:
        model: the geometry; how it splits the shoulder's offset moves the frame of link 2, not the link.
    """
    com = 1e-3 * np.array(_COM_MM)
    com[1, 2] -= float(dh_rows(model)[1, 2])
    tensor = np.array([np.diag(row) for row in _INERTIA_KG_MM2]) * 1e-6
    return LinkInertia(np.array(_MASS_KG), com, tensor)


def ball_inertia(mass: float, radius: float) -> Array:
    """(3, 3) tensor of a homogeneous ball about its centre, kg m^2.

    Args:
        mass: kg.
        radius: m.
    """
    return 0.4 * mass * radius**2 * np.eye(3)


# Mass matrix and bias of the arm, link by link in the links' own frames, on symbols or plain floats.
#
# Forces go by the recursion of Newton and Euler, the mass matrix by composite bodies. All that is known about a link is
# given about the origin of its own Denavit-Hartenberg frame.
#
# Source: Luh, Walker & Paul 1980; Walker & Orin 1982 (composite bodies); Featherstone, Rigid Body Dynamics Algorithms.

Three = tuple[Value, Value, Value]
Symmetric = tuple[Value, Value, Value, Value, Value, Value]
"""xx, yy, zz, xy, xz, yz."""
Turn = tuple[Value, Value, int]
"""Cosine and sine of a joint, and the twist after it in right angles: -1, 0 or 1."""
Body = tuple[Value, Three, Symmetric]
"""Mass, first moment and tensor about the origin of the link's frame."""
_TWISTS = (1, 0, -1, 1, -1, 0)


def cross(a: Three, b: Three) -> Three:
    """a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _plus(*vectors: Three) -> Three:
    x, y, z = vectors[0]
    for v in vectors[1:]:
        x, y, z = x + v[0], y + v[1], z + v[2]
    return x, y, z


def _scaled(factor: Value, v: Three) -> Three:
    return factor * v[0], factor * v[1], factor * v[2]


def _times(tensor: Symmetric, v: Three) -> Three:
    xx, yy, zz, xy, xz, yz = tensor
    return xx * v[0] + xy * v[1] + xz * v[2], xy * v[0] + yy * v[1] + yz * v[2], xz * v[0] + yz * v[1] + zz * v[2]


def _out(turn: Turn, v: Three) -> Three:
    """Into the next link's frame."""
    c, s, twist = turn
    x, y, z = c * v[0] + s * v[1], c * v[1] - s * v[0], v[2]
    return (x, y, z) if twist == 0 else (x, twist * z, -twist * y)


def _back(turn: Turn, v: Three) -> Three:
    """Into the previous link's frame."""
    c, s, twist = turn
    x, y, z = v if twist == 0 else (v[0], -twist * v[2], twist * v[1])
    return c * x - s * y, s * x + c * y, z


def _tensor_back(turn: Turn, tensor: Symmetric) -> Symmetric:
    """A tensor into the previous link's frame."""
    c, s, twist = turn
    xx, yy, zz, xy, xz, yz = tensor
    if twist:
        yy, zz, xy, xz, yz = zz, yy, -twist * xz, twist * xy, -yz
    cc, ss, cs = c * c, s * s, c * s
    across, mixed = cs * (2.0 * xy), cs * (xx - yy)
    return (
        cc * xx + ss * yy - across, ss * xx + cc * yy + across, zz,
        mixed + (cc - ss) * xy, c * xz - s * yz, s * xz + c * yz,
    )  # fmt: skip


def _symmetric(values: Iterable[Value]) -> Symmetric:
    xx, yy, zz, xy, xz, yz = values
    return xx, yy, zz, xy, xz, yz


def _moved(mass: Value, first: Three, tensor: Symmetric, r: Three) -> tuple[Three, Symmetric]:
    """First moment and tensor about a point from which the old one lies at r."""
    (x, y, z), (a, b, d) = first, r
    ax, by, dz = 2.0 * a * x + mass * (a * a), 2.0 * b * y + mass * (b * b), 2.0 * d * z + mass * (d * d)
    xx, yy, zz, xy, xz, yz = tensor
    moved = (
        xx + by + dz,
        yy + ax + dz,
        zz + ax + by,
        xy - (a * y + b * x + mass * (a * b)),
        xz - (a * z + d * x + mass * (a * d)),
        yz - (b * z + d * y + mass * (b * d)),
    )
    return _plus(first, _scaled(mass, r)), moved


def mass_and_bias(
    q: Sequence[Value],
    qd: Sequence[Value],
    links: Sequence[Value],
    lengths: Sequence[Value],
    gravity: Value,
) -> tuple[list[list[Value]], list[Value]]:
    """Mass matrix and bias at the joints.

    Args:
        q: (6,) rad.
        qd: (6,) rad/s.
        links: (60,) of each link mass (kg), first moment (3, kg m) and tensor (6: xx, yy, zz, xy, xz, yz, kg m^2),
            about the origin of its frame.
        lengths: (12,) Denavit-Hartenberg a and d of each link, m.
        gravity: m/s^2, along base -z.

    Returns:
        (6, 6) M and (6,) bias.
    """
    turns: list[Turn] = [(call("cos", x), call("sin", x), twist) for x, twist in zip(q, _TWISTS, strict=True)]
    steps: list[Three] = [
        (a, twist * d, 0.0) if twist else (a, 0.0, d)
        for a, d, twist in zip(lengths[::2], lengths[1::2], _TWISTS, strict=True)
    ]
    bodies: list[Body] = [
        (links[i], (links[i + 1], links[i + 2], links[i + 3]), _symmetric(links[i + 4 : i + 10]))
        for i in range(0, 60, 10)
    ]
    return _masses(turns, steps, bodies), _bias(turns, steps, bodies, qd, gravity)


def _masses(turns: Sequence[Turn], steps: Sequence[Three], bodies: Sequence[Body]) -> list[list[Value]]:
    """Turning joint i alone, the bodies beyond it push along its own axis and along those before it."""
    masses: list[list[Value]] = [[0.0] * 6 for _ in range(6)]
    mass: Value = 0.0
    first: Three = (0.0, 0.0, 0.0)
    tensor: Symmetric = (0.0,) * 6
    for i in reversed(range(6)):
        own_mass, own_first, own_tensor = bodies[i]
        mass, first = mass + own_mass, _plus(first, own_first)
        tensor = _symmetric(a + b for a, b in zip(tensor, own_tensor, strict=True))
        first, tensor = _moved(mass, first, tensor, steps[i])
        first, tensor = _back(turns[i], first), _tensor_back(turns[i], tensor)
        masses[i][i] = tensor[2]
        force, moment = (-first[1], first[0], 0.0), (tensor[4], tensor[5], tensor[2])
        for j in reversed(range(i)):
            force, moment = _back(turns[j], force), _back(turns[j], _plus(moment, cross(steps[j], force)))
            masses[i][j] = masses[j][i] = moment[2]
    return masses


def _bias(
    turns: Sequence[Turn], steps: Sequence[Three], bodies: Sequence[Body], qd: Sequence[Value], gravity: Value
) -> list[Value]:
    """Out: how the links move; back: what carries them."""
    omega, alpha, lift = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, gravity)
    loads: list[tuple[Three, Three]] = []
    for turn, r, (mass, first, tensor), rate in zip(turns, steps, bodies, qd, strict=True):
        alpha = _out(turn, (alpha[0] + omega[1] * rate, alpha[1] - omega[0] * rate, alpha[2]))
        omega = _out(turn, (omega[0], omega[1], omega[2] + rate))
        field = _field(omega, alpha)
        lift = _plus(_out(turn, lift), _applied(field, r))
        force = _plus(_scaled(mass, lift), _applied(field, first))
        moment = _plus(_times(tensor, alpha), cross(omega, _times(tensor, omega)), cross(first, lift))
        loads.append((force, moment))
    bias: list[Value] = []
    force = moment = (0.0, 0.0, 0.0)
    for turn, r, (own_force, own_moment) in zip(reversed(turns), reversed(steps), reversed(loads), strict=True):
        force = _plus(own_force, force)
        moment = _plus(own_moment, moment, cross(r, force))
        force, moment = _back(turn, force), _back(turn, moment)
        bias.insert(0, moment[2])
    return bias


def _field(omega: Three, alpha: Three) -> tuple[Three, Three, Three]:
    """Acceleration of a point per its place: alpha x r + omega x (omega x r)."""
    (x, y, z), (a, b, d) = omega, alpha
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    return (-(yy + zz), xy - d, xz + b), (xy + d, -(xx + zz), yz - a), (xz - b, yz + a, -(xx + yy))


def _applied(rows: tuple[Three, Three, Three], v: Three) -> Three:
    x, y, z = (row[0] * v[0] + row[1] * v[1] + row[2] * v[2] for row in rows)
    return x, y, z


# Rigid-body dynamics of the arm: mass matrix, Coriolis and centrifugal torques, gravity.

LOWER = tuple((i, j) for i in range(6) for j in range(i + 1))
"""Where the entries of a symmetric 6 x 6 matrix stand, row by row of its lower half."""
_WHOLE = [LOWER.index((max(i, j), min(i, j))) for i in range(6) for j in range(6)]


class RigidBody:
    """Dynamics of one arm with what it carries, along the joint angles or other coordinates x.

    Args:
        model: its geometry.
        inertia: its links.
        gravity: acceleration of free fall along base -z, m/s^2.
        joints_per_coordinate: (6, 6) joint angles per coordinate; then ``M x'' + b`` are the torques along x, and q
            and qd of the methods stand for x and x'.
        rotors: (6,) inertia along each coordinate that is not the links', kg m^2.
    """

    def __init__(
        self,
        model: ArmModel,
        inertia: LinkInertia,
        gravity: float = GRAVITY_M_S2,
        *,
        joints_per_coordinate: Array | None = None,
        rotors: Sequence[float] = (0.0,) * 6,
    ) -> None:
        self.model, self.inertia = model, inertia
        back = np.eye(6) if joints_per_coordinate is None else joints_per_coordinate
        self._known = (
            _about_the_frames(inertia),
            tuple(dh_rows(model)[:, (0, 2)].ravel().tolist()),
            (gravity,),
            tuple(back.ravel().tolist()),
            tuple(rotors),
        )
        self._terms = _terms_for(*(tuple(float(x != 0.0) for x in values) for values in self._known))

    def lower_terms(self, q: Sequence[float], qd: Sequence[float]) -> tuple[float, ...]:
        """Mass matrix and bias in plain floats.

        Args:
            q: (6,) rad.
            qd: (6,) rad/s.

        Returns:
            (27,) the entries ``LOWER`` of the mass matrix, then the bias.
        """
        return self._terms(q, qd, *self._known)

    def along(self, joints_per_coordinate: Array, rotors: Sequence[float], *, weight: bool = True) -> RigidBody:
        """The same arm along other coordinates.

        Args:
            joints_per_coordinate: (6, 6).
            rotors: (6,) inertia along each coordinate that is not the links', kg m^2.
            weight: whether gravity acts.
        """
        gravity = self._known[2][0] if weight else 0.0
        return RigidBody(self.model, self.inertia, gravity, joints_per_coordinate=joints_per_coordinate, rotors=rotors)

    def terms(self, q: npt.ArrayLike, qd: npt.ArrayLike) -> tuple[Array, Array]:
        """Mass matrix and bias.

        Args:
            q: (6,) rad.
            qd: (6,) rad/s.

        Returns:
            (6, 6) M, kg m^2, and (6,) bias: torque that holds the joint rates constant against gravity, Coriolis and
            centrifugal effects, N m.
        """
        found = self.lower_terms(np.asarray(q, dtype=float).tolist(), np.asarray(qd, dtype=float).tolist())
        return dense(found[:21]), np.array(found[21:])

    def gravity(self, q: npt.ArrayLike) -> Array:
        """(6,) torque that carries the arm's weight at rest, N m.

        Args:
            q: (6,) rad.
        """
        return self.terms(q, np.zeros(6))[1]


def dense(lower: Sequence[float]) -> Array:
    """(6, 6) symmetric matrix of its entries ``LOWER``.

    Args:
        lower: (21,).
    """
    return np.array(lower)[_WHOLE].reshape(6, 6)


def _about_the_frames(inertia: LinkInertia) -> tuple[float, ...]:
    """(60,) mass, first moment and tensor of each link about the origin of its frame, as ``mass_and_bias`` takes them.

    Source: parallel axes (Steiner).
    """
    known: list[float] = []
    for mass, com, tensor in zip(inertia.mass, inertia.com, inertia.tensor, strict=True):
        T = tensor + mass * (float(com @ com) * np.eye(3) - np.outer(com, com))
        known += [float(mass), *(mass * com).tolist(), *np.diag(T).tolist(), *T[(0, 0, 1), (1, 2, 2)].tolist()]
    return tuple(known)


@cache
def _terms_for(*patterns: tuple[float, ...]) -> Callable[..., tuple[float, ...]]:
    """The recursion for what is known, zeros where that is zero."""
    known = dict(zip(("links", "lengths", "gravity", "back", "rotors"), patterns, strict=True))
    return compiled("mass_and_bias", _terms, {"cos": math.cos, "sin": math.sin}, q=6, qd=6, **known)


def _terms(
    *,
    q: list[Value],
    qd: list[Value],
    links: list[Value],
    lengths: list[Value],
    gravity: list[Value],
    back: list[Value],
    rotors: list[Value],
) -> list[Value]:
    """``B'MB`` and ``B'b`` with the joints' M and b and B = back, and the rotors."""
    B = [back[i : i + 6] for i in range(0, 36, 6)]
    joints = [[_dot(row, of) for row in B] for of in (q, qd)]
    M, bias = mass_and_bias(joints[0], joints[1], links, lengths, gravity[0])
    columns = list(zip(*B, strict=True))
    MB = list(zip(*([_dot(row, column) for column in columns] for row in M), strict=True))
    masses = [_dot(columns[i], MB[j]) + (rotors[i] if i == j else 0.0) for i, j in LOWER]
    return [*masses, *(_dot(column, bias) for column in columns)]


def _dot(a: Sequence[Value], b: Sequence[Value]) -> Value:
    return sum((x * y for x, y in zip(a, b, strict=True)), 0.0)
