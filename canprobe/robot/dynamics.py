"""Rigid-body dynamics of the arm: mass matrix, Coriolis and centrifugal torques, gravity.

Equation of motion: ``M(q) q'' + b(q, q') = tau``, all at the joints; b holds gravity. Motors, gears and friction are
not in it (``canprobe.robot.actuation``). The recursion over the links (``recursion``) is compiled once for each
pattern of zeros in what is known of the links.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
import numpy.typing as npt

from canprobe.robot.inertia import GRAVITY_M_S2, LinkInertia
from canprobe.robot.puma260 import Array, PumaModel
from canprobe.robot.recursion import mass_and_bias
from canprobe.robot.straight_line import Value, compiled

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
        model: PumaModel,
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
            tuple(model.dh[:, (0, 2)].ravel().tolist()),
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
