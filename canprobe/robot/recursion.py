"""Mass matrix and bias of the arm, link by link in the links' own frames, on symbols or plain floats.

Forces go by the recursion of Newton and Euler, the mass matrix by composite bodies. All that is known about a link is
given about the origin of its own Denavit-Hartenberg frame.

Source: Luh, Walker & Paul 1980; Walker & Orin 1982 (composite bodies); Featherstone, Rigid Body Dynamics Algorithms.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from canprobe.robot.straight_line import Value, call

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
