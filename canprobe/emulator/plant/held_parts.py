"""What the step in straight-line code is made of, in symbols: a motor, a touch, and a 6 x 6 system."""

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

    def drive(self, kp: Value, t: Value, state: Row) -> tuple[Value, Value, Value]:
        """Velocity error, torque asked for and torque given; of angle, rate and integrator."""
        x, v, s = state
        error = kp * (self.start + self.slope * t - x) + self.ahead - v
        asked = self.gain * error + s + self.fed
        low = where("<", asked, -self.limit, -self.limit, asked)
        return error, asked, where(">", asked, self.limit, self.limit, low)

    def drag(self, v: Value) -> tuple[Value, Value]:
        """Friction, and its slope by the rate."""
        bent = call("tanh", v / STICTION_RATE)
        steep = self.coulomb / STICTION_RATE * (1.0 - bent * bent)
        return self.viscous * v + self.coulomb * bent, self.viscous + steep


class Pressing(NamedTuple):
    """What a touch does at a state.

    Push (6), elastic force, factor of damping, slip along s and t, its square, friction per slip, force per depth.
    """

    push: Row
    elastic: Value
    factor: Value
    along: Value
    across: Value
    square: Value
    drag: Value
    spring: Value


class Touch:
    """One touch, see ``pushing.OneTouch``."""

    def __init__(self, n: Row, s: Row, t: Row, law: Row) -> None:
        self.n, self.s, self.t = n, s, t
        self.offset, self.coefficient, self.damping, self.friction = law

    def press(self, theta: Row, v: Row) -> Pressing:
        """Forces at a state."""
        depth = self.offset - dot(self.n, theta)
        elastic = where(">", depth, 0.0, self.coefficient * depth * depth, 0.0)
        factor = 1.0 - self.damping * dot(self.n, v)
        factor = where(">", factor, 0.0, factor, 0.0)
        force, along, across = elastic * factor, dot(self.s, v), dot(self.t, v)
        square = along * along + across * across + SLIP_M_S**2
        drag = self.friction * force / call("sqrt", square)
        a, b = drag * along, drag * across
        push = [force * x - a * y - b * z for x, y, z in zip(self.n, self.s, self.t, strict=True)]
        spring = where(">", depth, 0.0, 2.0 * self.coefficient * depth * factor, 0.0)
        return Pressing(push, elastic, factor, along, across, square, drag, spring)

    def stiffen(self, inner: list[list[Value]], p: Pressing, g: Value) -> None:
        """Add what the touch does to the lower half of the system for the rates."""
        normal = g * where(">", p.factor, 0.0, self.damping * p.elastic, 0.0) + g * g * p.spring
        rubbed = g * p.drag
        slip = [p.along * x + p.across * y for x, y in zip(self.s, self.t, strict=True)]
        for i, j in LOWER:
            held = self.s[i] * self.s[j] + self.t[i] * self.t[j] - slip[i] * (slip[j] / p.square)
            inner[i][j] = inner[i][j] + (normal * self.n[i]) * self.n[j] + rubbed * held


class System:
    """A symmetric positive system, factored as L D L' with ones on the diagonal of L.

    Args:
        lower: (6, 6) of which the lower half counts.
    """

    def __init__(self, lower: Sequence[Row]) -> None:
        columns: list[list[Value]] = [[0.0] * 6 for _ in range(6)]  # of L D
        self._inverse: list[Value] = []
        for j in range(6):
            before = [self._inverse[k] * columns[j][k] for k in range(j)]
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


def symmetric_times(lower: Row, x: Row) -> list[Value]:
    """Product of a symmetric matrix, entries ``LOWER``, with a vector."""
    entries = dict(zip(LOWER, lower, strict=True))
    return [dot([entries[max(i, j), min(i, j)] for j in range(6)], x) for i in range(6)]


def dot(a: Row, b: Row) -> Value:
    """Inner product."""
    return sum((x * y for x, y in zip(a, b, strict=True)), 0.0)
