"""The six drive loops in plain floats: what each motor gives for what it is asked."""

from __future__ import annotations

from collections.abc import Sequence
from math import tanh
from typing import NamedTuple

import numpy as np

from canprobe.emulator.plant.cascade import Cascade
from canprobe.robot.actuation import COULOMB_NM, STICTION_RATE, VISCOUS_NMS
from canprobe.robot.puma260 import Array

Drives = tuple[list[float], list[float], list[float]]
"""Velocity error, torque asked for and torque given, of every motor."""


class LoopSlopes(NamedTuple):
    """(6,) each: slope of torque by velocity error, by angle, by rate and by integrator; slope of the integrator's own
    rate by velocity error and by itself."""

    gain: Array
    by_theta: Array
    by_rate: Array
    by_sum: Array
    sum_by_error: Array
    sum_by_sum: Array


class DriveLoops:
    """Position and velocity loops, torque limits and friction of the six motors, on straight references.

    Args:
        cascade: the drives.
        friction: whether motors and gears rub.

    Attributes:
        start, slope: (6,) reference at time 0 (rad) and its slope (rad/s).
        ahead, fed: (6,) speed (rad/s) and torque (N m) added behind the position and the velocity loop.
        gain, integral, limit: (6,) of the velocity loops and the largest torque.
        viscous, coulomb: (6,) friction.
    """

    def __init__(self, cascade: Cascade, *, friction: bool) -> None:
        on = 1.0 if friction else 0.0
        self.cascade = cascade
        self.position, self.unwind = cascade.position, cascade.unwind
        self.viscous, self.coulomb = [on * x for x in VISCOUS_NMS], [on * x for x in COULOMB_NM]
        self.gain: list[float] = cascade.velocity.tolist()
        self.integral: list[float] = cascade.integral.tolist()
        self.limit: list[float] = cascade.limit.tolist()
        self.fed, self._speed_fed = [0.0] * 6, [0.0] * 6
        self.set_reference(0.0, (0.0,) * 6, (0.0,) * 6)

    def set_reference(self, t: float, theta: Sequence[float], slope: Sequence[float]) -> None:
        """Straight reference of all motors from now on.

        Args:
            t: s.
            theta: (6,) at t, rad.
            slope: (6,) rad/s.
        """
        self.start = [x - v * t for x, v in zip(theta, slope, strict=True)]
        self.slope = list(slope)
        self._add_speeds()

    def set_loop(self, axis: int, limit: float, speed: float, torque: float) -> None:
        """Torque limit and feed-forwards of one motor from now on.

        Args:
            axis: 0 to 5.
            limit: largest torque, N m; the cascade's own if that is less.
            speed: added behind the position loop, rad/s.
            torque: added behind the velocity loop, N m.
        """
        self.limit[axis] = min(limit, float(self.cascade.limit[axis]))
        self._speed_fed[axis], self.fed[axis] = speed, torque
        self._add_speeds()

    def _add_speeds(self) -> None:
        self.ahead = [self.cascade.share * v + f for v, f in zip(self.slope, self._speed_fed, strict=True)]

    def drives(self, t: float, y: Sequence[float]) -> Drives:
        """What the cascades do.

        Args:
            t: s.
            y: (18,) state of the arm.
        """
        kp = self.position
        errors, asked, given = [], [], []
        for start, slope, ahead, gain, fed, limit, x, v, s in zip(
            self.start, self.slope, self.ahead, self.gain, self.fed, self.limit, y[:6], y[6:12], y[12:], strict=True
        ):
            error = kp * (start + slope * t - x) + ahead - v
            torque = gain * error + s + fed
            errors.append(error)
            asked.append(torque)
            given.append(limit if torque > limit else -limit if torque < -limit else torque)
        return errors, asked, given

    def slopes(self, rates: Sequence[float], drives: Drives) -> LoopSlopes:
        """Slopes of every motor's torque, friction included, and of its integrator's rate.

        Args:
            rates: (6,) of the motors, rad/s.
            drives: what the cascades do.
        """
        found = []
        for asked, given, rate, gain, integral, viscous, coulomb in zip(
            *drives[1:], rates, self.gain, self.integral, self.viscous, self.coulomb, strict=True
        ):
            free = asked == given
            slope, held = (gain, 0.0) if free else (0.0, self.unwind)
            bent = tanh(rate / STICTION_RATE)
            drag = viscous + coulomb / STICTION_RATE * (1.0 - bent * bent)
            found.append((slope, -self.position * slope, -slope - drag, float(free), integral - held * gain, -held))
        return LoopSlopes(*np.array(found).T)
