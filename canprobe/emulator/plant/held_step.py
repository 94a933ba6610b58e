"""The default step of the dynamic arm in straight-line code: ``rosenbrock2`` on held dynamics with at most one touch.

The same numbers as ``equations.rosenbrock2`` on ``ArmEquations``, but for rounding, at a seventh of the time. The
rows of the rates are multiplied by the mass matrix on both sides, so that its inverse is never needed; the rates of
angles and integrators are eliminated, which leaves a 6 x 6 system for the accelerations. What the mass matrix does to
the first stage's accelerations is known from that stage's right-hand side.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np

from canprobe.emulator.plant.equations import GAMMA, ArmEquations, State, rosenbrock2
from canprobe.emulator.plant.ideal_arm import STICTION_RATE
from canprobe.emulator.plant.pushing import SLIP_M_S, OneTouch
from canprobe.robot.dynamics import LOWER
from canprobe.robot.straight_line import Value, call, compiled, where

# What the step in straight-line code is made of, in symbols: a motor's loop, a touch, and a 6 x 6 system.

Row = Sequence[Value]


class Motor(NamedTuple):
    """One motor with its loop, see ``equations.DriveLoops``."""

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


# The default step of the dynamic arm in straight-line code: ``rosenbrock2`` on held dynamics with at most one touch.

_LOOPS = ("start", "slope", "ahead", "fed", "gain", "integral", "limit", "viscous", "coulomb")


def held_rosenbrock2(equations: ArmEquations, t: float, y: State, h: float) -> State:
    """``equations.rosenbrock2``; what is not held, or touches in several places, takes that one.

    Args:
        equations: of the arm.
        t: s.
        y: (18,) state.
        h: length of the step, s.

    Returns:
        (18,) state after the step.
    """
    touch, loops = equations.contact, equations.loops
    if not equations.held or (touch is not None and not isinstance(touch, OneTouch)):
        stepped: list[float] = rosenbrock2(equations, t, np.array(y), h).tolist()
        return stepped
    known: tuple[Sequence[float], ...] = (
        y, (t, h), equations.lower_mass, equations.bias, (loops.position, loops.unwind),
        loops.start, loops.slope, loops.ahead, loops.fed, loops.gain, loops.integral, loops.limit,
        loops.viscous, loops.coulomb,
    )  # fmt: skip
    if touch is not None:
        known = *known, touch.n, touch.s, touch.t, touch.plane, touch.law
    return _step(touch is not None)(*known)


@cache
def _step(touching: bool) -> Callable[..., tuple[float, ...]]:
    """The step, compiled once; its arguments are those of ``_rosenbrock2``."""
    touch = {"n": 6, "s": 6, "t": 6, "plane": 21, "law": 4} if touching else {}
    functions = {"tanh": math.tanh, "sqrt": math.sqrt}
    arguments = {"y": 18, "time": 2, "mass": 21, "bias": 6, "gains": 2, **dict.fromkeys(_LOOPS, 6), **touch}
    return compiled("held_step", _rosenbrock2, functions, **arguments)


def _rosenbrock2(*, y: Row, time: Row, mass: Row, bias: Row, gains: Row, **known: Row) -> list[Value]:
    """One step; time: of its start, and its length; gains: position loop and unwinding; known: loops and touch."""
    t, h = time
    g = GAMMA * h
    drives = [
        _Drive(Motor(*(known[name][i] for name in _LOOPS)), gains, t, g, (y[i], y[i + 6], y[i + 12])) for i in range(6)
    ]
    names = ("n", "s", "t", "plane", "law")
    touch = _Touching(Touch(*(known[name] for name in names)), y, h, g) if "law" in known else None
    inner: list[list[Value]] = [[0.0] * 6 for _ in range(6)]
    for (i, j), entry in zip(LOWER, plus(mass, touch.stiffness) if touch else mass, strict=True):
        inner[i][j] = entry + drives[i].resistance if i == j else entry
    system = System(inner)
    first = [d.torque - b for d, b in zip(drives, bias, strict=True)]
    first = touch.pushed(first) if touch else first
    w1 = system.solve(first)
    for d, w in zip(drives, w1, strict=True):
        d.go(w, h)
    second = [d.later_torque - b - 2.0 * x for d, b, x in zip(drives, bias, first, strict=True)]
    second = touch.pushed_later(second, w1) if touch else second
    stepped = [d.end(w, h) for d, w in zip(drives, system.solve(second), strict=True)]
    return [value for part in zip(*stepped, strict=True) for value in part]


class _Drive:
    """One motor through a step: what it adds to the system, and its three rates in both stages.

    With f' the rates at the end of the first stage and r = f' - 2 k1 - g f_t, each system (I - g J) k = r is
    eliminated down to the acceleration. At its limit the torque depends on nothing, and the integrator runs to it with
    the rate of unwinding (``DriveLoops``: ``integral = unwind gain``).
    """

    def __init__(self, motor: Motor, gains: Row, t: Value, g: Value, state: Row) -> None:
        self.motor, (self.kp, self.unwind), self.g = motor, gains, g
        self.x, self.v, self.s = state
        self.error = self.kp * (motor.start + motor.slope * t - self.x) + motor.ahead - self.v
        self.asked = motor.gain * self.error + (self.s + motor.fed)
        self.given = motor.limited(self.asked)
        self.reach = g * self.kp
        self.stiff = motor.gain + g * motor.integral
        self.behind = motor.slope - self.v
        pull = self.stiff * (self.error + self.reach * self.behind) + (self.s + motor.fed)
        drag, steep = motor.drag(self.v)
        self.torque = self._free(pull, self.given) - drag
        self.resistance = self._free((g + g * self.reach) * self.stiff, 0.0) + g * steep

    def _free(self, yes: Value, no: Value) -> Value:
        """Whether the torque was within its limit at the start of the step."""
        return where("==", self.asked, self.given, yes, no)

    def _wound(self, w: Value) -> Value:
        """What an acceleration takes from the integrator."""
        return (self.g + self.g * self.reach) * w

    def go(self, w: Value, h: Value) -> None:
        """The first stage's rates; then all that the second stage asks.

        Args:
            w: acceleration of the first stage.
            h: length of the step.
        """
        motor, g = self.motor, self.g
        unwound = self.unwind * (self.given - (self.s + motor.fed)) / (1.0 + g * self.unwind)
        self.w = w
        self.a = self.v + g * w
        self.b = self._free(motor.integral * (self.error + self.reach * self.behind - self._wound(w)), unwound)
        moved = h * (self.kp * (motor.slope - self.a) - w)
        error, asked = self.error + moved, self.asked + motor.gain * moved + h * self.b
        given = motor.limited(asked)
        self.r1 = (h - 2.0 * g) * w - self.v
        slope = self.reach * motor.slope
        self.r3 = motor.integral * error - self.unwind * (asked - given) - 2.0 * self.b
        self.r3 = self.r3 - self._free(slope * motor.integral, 0.0)
        pull = g * self.r3 - slope * motor.gain - self.reach * self.stiff * self.r1
        self.later_torque = given - motor.drag(self.v + h * w)[0] + self._free(pull, 0.0) + 2.0 * self.resistance * w

    def end(self, w: Value, h: Value) -> tuple[Value, Value, Value]:
        """State after the step.

        Args:
            w: acceleration of the second stage.
            h: length of the step.
        """
        long, short = 1.5 * h, 0.5 * h
        wound = self.r3 - self.motor.integral * (self.reach * self.r1 + self._wound(w))
        b = self._free(wound, self.r3 / (1.0 + self.g * self.unwind))
        return (
            self.x + long * self.a + short * (self.r1 + self.g * w),
            self.v + long * self.w + short * w,
            self.s + long * self.b + short * b,
        )


class _Touching:
    """A touch through a step: what it adds to the system, and its push in both stages."""

    def __init__(self, touch: Touch, y: Row, h: Value, g: Value) -> None:
        self.touch, self.h, self.g = touch, h, g
        self.now = touch.meeting(y[:6], y[6:12])
        self.forces = forces = touch.forces(self.now)
        spring = touch.spring(self.now, forces)
        self.spring, self.normal = g * spring, g * touch.damper(forces) + g * g * spring
        self.rubbing, self.slip = g * forces.drag, touch.slip(self.now)
        self.stiffness = touch.stiffness(self.normal, self.rubbing, self.slip, forces.square)

    def pushed(self, torque: Row) -> list[Value]:
        """The first stage's right-hand side with the push."""
        normal = self.forces.force - self.spring * self.now.away
        return plus(plus(torque, self.touch.n, normal), self.slip, -self.forces.drag)

    def pushed_later(self, torque: Row, w: Row) -> list[Value]:
        """The second stage's, with the push there and twice what the matrix does to the first stage's w."""
        touch, now, h, g = self.touch, self.now, self.h, self.g
        away, along, across = dot(touch.n, w), dot(touch.s, w), dot(touch.t, w)
        later = Meeting(
            now.depth - h * (now.away + g * away), now.away + h * away, now.along + h * along, now.across + h * across
        )
        there: Forces = touch.forces(later)
        r1 = (h - 2.0 * g) * away - now.away
        mean = (now.along * along + now.across * across) / self.forces.square
        twice = 2.0 * self.rubbing
        torque = plus(torque, touch.n, there.force + 2.0 * self.normal * away - self.spring * r1)
        torque = plus(torque, touch.s, twice * (along - mean * now.along) - there.drag * later.along)
        return plus(torque, touch.t, twice * (across - mean * now.across) - there.drag * later.across)
