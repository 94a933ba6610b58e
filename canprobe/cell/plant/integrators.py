"""Steps of ordinary differential equations y' = f(t, y), each one function of (problem, t, y, h).

| step | order | for |
|---|---|---|
| ``runge_kutta_4`` | 4 | smooth and not stiff |
| ``rosenbrock2`` | 2 | stiff; two stages, one matrix, L-stable; second order whatever matrix the problem gives |
| ``adaptive`` | 2 | ``rosenbrock2`` in as many parts as its own error estimate asks for |

Source: Hairer & Wanner, Solving ODEs II, IV.7; Verwer, Spee, Blom & Hundsdorfer, SIAM J. Sci. Comput. 20, 1999 (ROS2).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import sqrt
from typing import NamedTuple, Protocol

import numpy as np

from canprobe.mechanics.types import Floats

GAMMA = 1.0 - sqrt(0.5)
"""Parameter γ of ROS2."""
_MAX_PARTS = 4096


class Linearised(NamedTuple):
    """The equations near one place.

    Attributes:
        rate: f.
        drift: partial derivative of f by t.
        solve: r -> x of (I - g J) x = r; J may be an approximation of the Jacobian.
    """

    rate: Floats
    drift: Floats
    solve: Callable[[Floats], Floats]


class Problem(Protocol):
    """The equations that a step needs."""

    def rate(self, t: float, y: Floats) -> Floats:
        """f(t, y)."""

    def linearised(self, t: float, y: Floats, g: float) -> Linearised:
        """All that a linearly implicit step asks for at one place."""


Step = Callable[[Problem, float, Floats, float], Floats]


def runge_kutta_4(problem: Problem, t: float, y: Floats, h: float) -> Floats:
    """The classical explicit step."""
    k1 = problem.rate(t, y)
    k2 = problem.rate(t + 0.5 * h, y + 0.5 * h * k1)
    k3 = problem.rate(t + 0.5 * h, y + 0.5 * h * k2)
    k4 = problem.rate(t + h, y + h * k3)
    return y + (h / 6.0) * (k1 + 2.0 * (k2 + k3) + k4)


def rosenbrock2(problem: Problem, t: float, y: Floats, h: float) -> Floats:
    """ROS2 with gamma = 1 - 1/sqrt(2)."""
    return _rosenbrock2(problem, t, y, h)[0]


def _rosenbrock2(problem: Problem, t: float, y: Floats, h: float) -> tuple[Floats, Floats]:
    """The step, and how far its own first-order step lies off."""
    rate, drift, solve = problem.linearised(t, y, GAMMA * h)
    drift *= GAMMA * h
    k1 = solve(rate + drift)
    k2 = solve(problem.rate(t + h, y + h * k1) - 2.0 * k1 - drift)
    return y + (1.5 * h) * k1 + (0.5 * h) * k2, (0.5 * h) * (k1 + k2)


def adaptive(problem: Problem, t: float, y: Floats, h: float, *, rtol: float = 1e-3, atol: float = 1e-5) -> Floats:
    """``rosenbrock2`` in parts whose estimated error stays within ``atol + rtol |y|``, component by component.

    Raises:
        ArithmeticError: the step needs more than 4096 parts.
    """
    done, part = 0.0, h
    for _ in range(_MAX_PARTS):
        part = min(part, h - done)
        new, error = _rosenbrock2(problem, t + done, y, part)
        size = float(np.max(np.abs(error) / (atol + rtol * np.maximum(np.abs(y), np.abs(new)))))
        if size <= 1.0:
            y, done = new, done + part
            if done >= h * (1.0 - 1e-12):
                return y
        # NaN counts as an error too large
        part *= min(4.0, max(0.2, 0.9 / sqrt(size))) if size > 0.0 else 4.0 if size == 0.0 else 0.2
    raise ArithmeticError(f"a step of {h:g} s at t = {t:g} s needs more than {_MAX_PARTS} parts")


STEPS: Mapping[str, Step] = {"rk4": runge_kutta_4, "rosenbrock": rosenbrock2, "adaptive": adaptive}
"""Name in a scene -> step."""
