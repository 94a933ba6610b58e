"""What the step in straight-line code is made of, in symbols: a motor's loop, a touch, and a 6 x 6 system."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from canprobe.emulator.plant.pushing import SLIP_M_S
from canprobe.robot.actuation import STICTION_RATE
from canprobe.robot.dynamics import LOWER
from canprobe.robot.straight_line import Value, call, where

Row = Sequence[Value]


class Motor(NamedTuple):
    """One motor with its loop, see ``loops.DriveLoops``."""

    start: Value
    slope: Value
    ahead: Value
    fed: Value
    gain: Value
    integral: Value
    limit: Value
    viscous: Value
    coulomb: Value

    def limited(self, asked: Value) -> Value:
        """Torque given for the torque asked for."""
        low = where("<", asked, -self.limit, -self.limit, asked)
        return where(">", asked, self.limit, self.limit, low)

    def drag(self, v: Value) -> tuple[Value, Value]:
        """Friction, and its slope by the rate."""
        bent = call("tanh", v * (1.0 / STICTION_RATE))
        steep = self.coulomb * (1.0 / STICTION_RATE) * (1.0 - bent * bent)
        return self.viscous * v + self.coulomb * bent, self.viscous + steep


class Meeting(NamedTuple):
    """How the probe moves at the touch: depth, speed along the normal, and along the two tangents."""

    depth: Value
    away: Value
    along: Value
    across: Value


class Forces(NamedTuple):
    """What a touch does: elastic force, factor of its damping, force, friction per slip, slip's square."""

    elastic: Value
    factor: Value
    force: Value
    drag: Value
    square: Value


class Touch:
    """One touch, see ``pushing.OneTouch``."""

    def __init__(self, n: Row, s: Row, t: Row, plane: Row, law: Row) -> None:
        self.n, self.s, self.t, self.plane = n, s, t, plane
        self.offset, self.coefficient, self.damping, self.friction = law

    def meeting(self, theta: Row, v: Row) -> Meeting:
        """Of a state."""
        return Meeting(self.offset - dot(self.n, theta), dot(self.n, v), dot(self.s, v), dot(self.t, v))

    def forces(self, m: Meeting) -> Forces:
        """Of a meeting."""
        elastic = where(">", m.depth, 0.0, self.coefficient * m.depth * m.depth, 0.0)
        factor = 1.0 - self.damping * m.away
        factor = where(">", factor, 0.0, factor, 0.0)
        square = m.along * m.along + m.across * m.across + SLIP_M_S**2
        force = elastic * factor
        return Forces(elastic, factor, force, self.friction * force / call("sqrt", square), square)

    def spring(self, m: Meeting, f: Forces) -> Value:
        """Force per depth."""
        return where(">", m.depth, 0.0, 2.0 * self.coefficient * m.depth * f.factor, 0.0)

    def damper(self, f: Forces) -> Value:
        """Force per speed along the normal."""
        return where(">", f.factor, 0.0, self.damping * f.elastic, 0.0)

    def slip(self, m: Meeting) -> list[Value]:
        """Slip per motor, times the slip."""
        return [m.along * x + m.across * y for x, y in zip(self.s, self.t, strict=True)]

    def stiffness(self, normal: Value, rubbing: Value, slip: Row, square: Value) -> list[Value]:
        """What the touch adds to the system, entries ``LOWER``.

        Args:
            normal: factor of n n'.
            rubbing: factor of s s' + t t' less what acts along the slip.
            slip: see ``slip``.
            square: of the slip.
        """
        pressed, ratio = [normal * x for x in self.n], rubbing / square
        slipped = [ratio * x for x in slip]
        return [
            pressed[i] * self.n[j] + rubbing * both - slipped[i] * slip[j]
            for (i, j), both in zip(LOWER, self.plane, strict=True)
        ]


class System:
    """A symmetric positive system, factored as L D L' with ones on the diagonal of L.

    Args:
        lower: (6, 6) of which the lower half counts.
    """

    def __init__(self, lower: Sequence[Row]) -> None:
        columns: list[list[Value]] = [[0.0] * 6 for _ in range(6)]  # of L D
        self._inverse: list[Value] = []
        for j in range(6):
            before = [columns[j][k] * self._inverse[k] for k in range(j)]
            for i in range(j, 6):
                columns[i][j] = lower[i][j] - dot(columns[i][:j], before)
            self._inverse.append(1.0 / columns[j][j])
        self._L = [[columns[i][j] * self._inverse[j] for j in range(i)] for i in range(6)]

    def solve(self, right: Row) -> list[Value]:
        """Forward, then backward."""
        x: list[Value] = []
        for i in range(6):
            x.append(right[i] - dot(self._L[i], x))
        x = [a * d for a, d in zip(x, self._inverse, strict=True)]
        for i in reversed(range(6)):
            x[i] = x[i] - dot([self._L[k][i] for k in range(i + 1, 6)], x[i + 1 :])
        return x


def plus(a: Row, b: Row, share: Value = 1.0) -> list[Value]:
    """a + share b."""
    return [x + share * y for x, y in zip(a, b, strict=True)]


def dot(a: Row, b: Row) -> Value:
    """Inner product."""
    return sum((x * y for x, y in zip(a, b, strict=True)), 0.0)
