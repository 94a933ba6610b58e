"""The default step of the dynamic arm in straight-line code: ``rosenbrock2`` on held dynamics with at most one touch.

The same numbers as ``integrators.rosenbrock2`` on ``ArmEquations``, but for rounding, at a third of the time. The rows
of the rates are multiplied by the mass matrix on both sides, so that its inverse is never needed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache

import numpy as np

from canprobe.emulator.plant.equations import ArmEquations
from canprobe.emulator.plant.held_parts import Motor, Row, System, Touch, dot, symmetric_times
from canprobe.emulator.plant.integrators import GAMMA, Problem, rosenbrock2
from canprobe.emulator.plant.pushing import OneTouch
from canprobe.robot.dynamics import LOWER
from canprobe.robot.puma260 import Array
from canprobe.robot.straight_line import Value, compiled, where

_LOOPS = ("start", "slope", "ahead", "fed", "gain", "integral", "limit", "viscous", "coulomb")


def held_rosenbrock2(problem: Problem, t: float, y: Array, h: float) -> Array:
    """``integrators.rosenbrock2``; what is not a held arm with at most one touch takes that one."""
    touch = problem.contact if isinstance(problem, ArmEquations) else None
    if not isinstance(problem, ArmEquations) or not problem.held or not isinstance(touch, OneTouch | None):
        return rosenbrock2(problem, t, y, h)
    loops = problem.loops
    known: tuple[Sequence[float], ...] = (
        y.tolist(), (t, h), problem.lower_mass, problem.bias, (loops.position, loops.unwind),
        loops.start, loops.slope, loops.ahead, loops.fed, loops.gain, loops.integral, loops.limit,
        loops.viscous, loops.coulomb,
    )  # fmt: skip
    if touch is not None:
        known = *known, touch.n, touch.s, touch.t, touch.law
    return np.array(_step(touch is not None)(*known))


@cache
def _step(touching: bool) -> Callable[..., tuple[float, ...]]:
    """The step, compiled once; its arguments are those of ``_rosenbrock2``."""
    touch = {"n": 6, "s": 6, "t": 6, "law": 4} if touching else {}
    functions = {"tanh": math.tanh, "sqrt": math.sqrt}
    arguments = {"y": 18, "time": 2, "mass": 21, "bias": 6, "gains": 2, **dict.fromkeys(_LOOPS, 6), **touch}
    return compiled("held_step", _rosenbrock2, functions, **arguments)


def _rosenbrock2(*, y: Row, time: Row, mass: Row, bias: Row, gains: Row, **known: Row) -> list[Value]:
    """One step; time: of its start, and its length; gains: position loop and unwinding; known: loops and touch."""
    t, step = time
    touch = Touch(known["n"], known["s"], known["t"], known["law"]) if "law" in known else None
    motors = [Motor(*(known[name][i] for name in _LOOPS)) for i in range(6)]
    stage = _Stage(motors, touch, mass, bias, gains)
    solve, pull, wind = stage.linearised(t, y, GAMMA * step)
    net, wound = stage.rates(t, y)
    k1 = solve([*y[6:12], *_plus(net, pull), *_plus(wound, wind)])
    net, wound = stage.rates(t + step, [x + step * k for x, k in zip(y, k1, strict=True)])
    later = [x + step * k for x, k in zip(y[6:12], k1[6:12], strict=True)]
    carried = [*k1[:6], *symmetric_times(mass, k1[6:12]), *k1[12:]]
    rates = [*later, *_plus(net, pull, -1.0), *_plus(wound, wind, -1.0)]
    k2 = solve(_plus(rates, carried, -2.0))
    long, short = 1.5 * step, 0.5 * step
    return [x + long * a + short * b for x, a, b in zip(y, k1, k2, strict=True)]


class _Stage:
    """The equations in symbols; rows of the rates multiplied by the mass matrix."""

    def __init__(self, motors: list[Motor], touch: Touch | None, mass: Row, bias: Row, gains: Row) -> None:
        self.motors, self.touch, self.mass, self.bias = motors, touch, mass, bias
        self.kp, self.unwind = gains

    def rates(self, t: Value, y: Row) -> tuple[list[Value], list[Value]]:
        """Net torques, and rates of the integrators."""
        push = self.touch.press(y[:6], y[6:12]).push if self.touch else (0.0,) * 6
        net, wound = [], []
        for motor, b, pushed, *state in zip(self.motors, self.bias, push, y[:6], y[6:12], y[12:], strict=True):
            error, asked, given = motor.drive(self.kp, t, state)
            net.append(given - b - motor.drag(state[1])[0] + pushed)
            wound.append(motor.integral * error - self.unwind * (asked - given))
        return net, wound

    def linearised(self, t: Value, y: Row, g: Value) -> tuple[Callable[[Row], list[Value]], Row, Row]:
        """Solver of (I - g J) x = r, and g times the slopes by time of net torques and integrators.

        By elimination as in ``ArmEquations.linearised``, whose names these are.
        """
        kp, touch = self.kp, self.touch
        inner: list[list[Value]] = [[0.0] * 6 for _ in range(6)]
        for (i, j), m in zip(LOWER, self.mass, strict=True):
            inner[i][j] = m
        spring: Value = 0.0
        if touch:
            pressing = touch.press(y[:6], y[6:12])
            touch.stiffen(inner, pressing, g)
            spring = g * pressing.spring
        leak, fed, back, first_back, by_theta, pull, wind = ([0.0] * 6 for _ in range(7))
        for i, (motor, *state) in enumerate(zip(self.motors, y[:6], y[6:12], y[12:], strict=True)):
            _, asked, given = motor.drive(kp, t, state)
            gain, free = where("==", asked, given, motor.gain, 0.0), where("==", asked, given, 1.0, 0.0)
            held = where("==", asked, given, 0.0, self.unwind)
            by_error = motor.integral - held * motor.gain
            leak[i] = 1.0 / (1.0 + g * held)
            fed[i] = g * free * leak[i]
            back[i], first_back[i] = g * (1.0 + g * kp) * by_error, g * kp * by_error
            by_theta[i] = -(g * kp * gain)
            pull[i], wind[i] = g * kp * motor.slope * gain, g * kp * motor.slope * by_error
            inner[i][i] += fed[i] * back[i] + g * (gain + motor.drag(state[1])[1]) - g * by_theta[i]
        system = System(inner)

        def solve(r: Row) -> list[Value]:
            first = r[:6]
            third = [c - b * a for c, b, a in zip(r[12:], first_back, first, strict=True)]
            torque = [x + b * a + f * c for x, b, a, f, c in zip(r[6:12], by_theta, first, fed, third, strict=True)]
            if touch:
                torque = _plus(torque, touch.n, -(spring * dot(touch.n, first)))
            rates = system.solve(torque)
            angles = _plus(first, rates, g)
            return [*angles, *rates, *(f * (c - b * v) for f, c, b, v in zip(leak, third, back, rates, strict=True))]

        return solve, pull, wind


def _plus(a: Row, b: Row, share: Value = 1.0) -> list[Value]:
    return [x + share * y for x, y in zip(a, b, strict=True)]
