"""Endless references: constant velocity, and what a constant torque does to the motor; both end at a fence.

Source: CiA 402-2, cyclic synchronous velocity and torque modes; software position limits 607Dh.
"""

from __future__ import annotations

from math import copysign, exp, inf, log
from typing import Protocol

from canprobe.emulator.plant.motor import MotorDynamics


class Trajectory(Protocol):
    """A reference as a function of the time since its start."""

    duration_s: float

    def at(self, t_s: float) -> tuple[float, float]:
        """Position (counts) and velocity (counts/s)."""


class ConstantVelocity:
    """A straight line without an end."""

    duration_s = inf

    def __init__(self, position: float, velocity: float) -> None:
        self._position, self._velocity = position, velocity

    def at(self, t_s: float) -> tuple[float, float]:
        """Position (counts) and velocity (counts/s)."""
        return self._position + self._velocity * t_s, self._velocity


class TorqueRun:
    """Motion under a constant torque, solved exactly; velocity stays within a limit.

    Friction first brings a motor to rest that moves against the torque, then keeps it there unless the torque is
    above the Coulomb torque. Gravity, contact and the other joints do not act, as in the ideal arm.
    """

    duration_s = inf

    def __init__(
        self, position: float, velocity: float, permille: float, dynamics: MotorDynamics, speed_limit: float
    ) -> None:
        """Start.

        Args:
            position: counts.
            velocity: counts/s; cut to the limit.
            permille: torque, 1/1000 of the rated torque.
            dynamics: of the motor.
            speed_limit: counts/s, may be infinite.
        """
        self._torque, self._dynamics, self._limit = permille, dynamics, speed_limit
        velocity = min(max(velocity, -speed_limit), speed_limit)
        self._first = self._phase(position, velocity, copysign(1.0, velocity)) if velocity else None
        rest_s, position = self._first.rest(position) if self._first else (0.0, position)
        self._turn_s = rest_s
        self._rest = position
        moves = abs(permille) > dynamics.coulomb
        self._second = self._phase(position, 0.0, copysign(1.0, permille)) if moves and rest_s < inf else None

    def at(self, t_s: float) -> tuple[float, float]:
        """Position (counts) and velocity (counts/s)."""
        if self._first is not None and t_s < self._turn_s:
            return self._first.at(t_s)
        if self._second is None:
            return self._rest, 0.0
        return self._second.at(t_s - self._turn_s)

    def _phase(self, position: float, velocity: float, sign: float) -> _Phase:
        gain, coulomb, damping = self._dynamics
        final = gain * (self._torque - sign * coulomb) / damping
        return _Phase(position, velocity, final, damping, self._limit)


class _Phase:
    """Velocity from `velocity` towards `final`, exponentially, without a change of sign; cut at the limit."""

    def __init__(self, position: float, velocity: float, final: float, damping: float, limit: float) -> None:
        self._position, self._velocity, self._final, self._damping = position, velocity, final, damping
        self._cut_s, self._cut_velocity = inf, 0.0
        if abs(final) > limit and final * velocity >= 0.0:
            self._cut_velocity = copysign(limit, final)
            self._cut_s = log((velocity - final) / (self._cut_velocity - final)) / damping

    def rest(self, position: float) -> tuple[float, float]:
        """When and where the motor is at rest; (inf, position) if never."""
        if self._final * self._velocity >= 0.0:
            return inf, position
        t_s = log(1.0 - self._velocity / self._final) / self._damping
        return t_s, self.at(t_s)[0]

    def at(self, t_s: float) -> tuple[float, float]:
        """Position (counts) and velocity (counts/s)."""
        free = min(t_s, self._cut_s)
        decay = exp(-self._damping * free)
        excess = self._velocity - self._final
        velocity = self._final + excess * decay
        position = self._position + self._final * free + excess * (1.0 - decay) / self._damping
        if t_s > self._cut_s:
            return position + self._cut_velocity * (t_s - self._cut_s), self._cut_velocity
        return position, velocity


class Fenced:
    """A trajectory whose part outside the software limits is cut off: the motor waits at the limit."""

    def __init__(self, inner: Trajectory, low: float, high: float) -> None:
        """`low` and `high` in counts, infinite for none; a motor outside already may only come in."""
        start, _ = inner.at(0.0)
        self._inner, self._low, self._high = inner, min(low, start), max(high, start)
        self.duration_s = inner.duration_s

    def at(self, t_s: float) -> tuple[float, float]:
        """Position (counts) and velocity (counts/s)."""
        position, velocity = self._inner.at(t_s)
        if self._low <= position <= self._high:
            return position, velocity
        return min(max(position, self._low), self._high), 0.0
