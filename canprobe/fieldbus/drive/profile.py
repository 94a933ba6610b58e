"""Motion in pieces one after the other, from any position and speed: a trapezoid to a target, constant velocity, and
the motion under a constant torque.

A motor that moves the wrong way, or too fast to stop in time, is braked to rest first and turned round. One that is
faster than allowed is braked to the profile velocity.
Source: CiA 402-2, profile position mode, objects 6081h, 6083h, 6084h, motion profile type 6086h = 0; cyclic
synchronous velocity and torque modes; software position limits 607Dh.
"""

from __future__ import annotations

from math import copysign, exp, inf, log, sqrt
from typing import NamedTuple


class MotorDynamics(NamedTuple):
    """Dynamics of a motor: ``v' = gain (torque - coulomb sign v) - damping v``.

    The velocity v is in counts/s, torques are in 1/1000 of the rated torque.

    Attributes:
        gain: acceleration per permille of torque, counts/s²; positive.
        coulomb: friction torque, permille; a smaller torque does not move a motor at rest.
        damping: viscous friction over inertia, 1/s; positive.
    """

    gain: float
    coulomb: float
    damping: float


class Piece(NamedTuple):
    """Constant acceleration over some time; duration in s, then counts, counts/s and counts/s²."""

    duration_s: float
    position: float
    velocity: float
    acceleration: float

    def at(self, t_s: float) -> tuple[float, float]:
        """Position and velocity `t_s` after the piece began."""
        position = self.position + t_s * (self.velocity + 0.5 * t_s * self.acceleration)
        return position, self.velocity + t_s * self.acceleration


class Decay(NamedTuple):
    """Velocity that tends exponentially towards `final`; duration in s, then counts, counts/s, counts/s and 1/s."""

    duration_s: float
    position: float
    velocity: float
    final: float
    damping: float

    def at(self, t_s: float) -> tuple[float, float]:
        """Position and velocity `t_s` after the piece began."""
        decay = exp(-self.damping * t_s)
        excess = self.velocity - self.final
        return self.position + self.final * t_s + excess * (1.0 - decay) / self.damping, self.final + excess * decay


class Rates(NamedTuple):
    """Speed limit, counts/s, and rates of a move, counts/s²; all are positive."""

    speed: float
    acceleration: float
    deceleration: float


class Profile:
    """A reference as a function of the time since its start: pieces one after the other, at rest at `end` after them.

    Attributes:
        duration_s: duration, s; infinite for a motion without an end.
        end: position of rest, counts.
    """

    def __init__(self, pieces: tuple[Piece | Decay, ...], end: float) -> None:
        self._pieces = pieces
        self.end = end
        self.duration_s = sum(piece.duration_s for piece in pieces)
        self._low, self._high = -inf, inf

    def fenced(self, low: float, high: float) -> Profile:
        """Cut the profile off at the software limits, counts, where the motor waits; one outside may only come in."""
        start, _ = self.at(0.0)
        self._low, self._high = min(low, start), max(high, start)
        return self

    def at(self, t_s: float) -> tuple[float, float]:
        """Position (counts) and velocity (counts/s) `t_s` after the start."""
        position, velocity, over = self.end, 0.0, t_s >= self.duration_s
        for piece in () if over else self._pieces:
            if t_s < piece.duration_s:
                position, velocity = piece.at(t_s)
                break
            t_s -= piece.duration_s
        if self._low <= position <= self._high:
            return position, velocity
        return min(max(position, self._low), self._high), 0.0


def braking(position: float, velocity: float, deceleration: float) -> Profile:
    """Motion to rest with a deceleration, counts/s², positive."""
    piece = Piece(abs(velocity) / deceleration, position, velocity, -copysign(deceleration, velocity))
    return Profile((piece,), piece.at(piece.duration_s)[0])


def trapezoid(position: float, velocity: float, target: float, rates: Rates) -> Profile:
    """Motion from a position (counts) and velocity (counts/s) to rest at a target (counts)."""
    speed, acceleration, deceleration = rates
    pieces: list[Piece] = []
    stop = position + 0.5 * velocity * abs(velocity) / deceleration
    sign = copysign(1.0, target - stop) if target != stop else copysign(1.0, velocity)
    if velocity * sign < 0.0:
        pieces.append(Piece(abs(velocity) / deceleration, position, velocity, sign * deceleration))
        position, velocity = stop, 0.0
    way, v0 = sign * (target - position), abs(velocity)
    # from this speed p on braking ends at the target: (p² - v0²) / 2a + p² / 2d = way
    within = sqrt((2 * acceleration * deceleration * way + deceleration * v0**2) / (acceleration + deceleration))
    peak = min(speed, within)
    change = acceleration if peak >= v0 else -deceleration
    lengths = ((peak - v0) / change, 0.0, peak / deceleration)
    used = 0.5 * (v0 + peak) * lengths[0] + 0.5 * peak * lengths[2]
    cruise = max(0.0, (way - used) / peak) if peak > 0.0 else 0.0
    for seconds, rate in zip((lengths[0], cruise, lengths[2]), (change, 0.0, -deceleration), strict=True):
        piece = Piece(seconds, position, velocity, sign * rate)
        pieces.append(piece)
        position, velocity = piece.at(seconds)
    return Profile(tuple(pieces), target)


def uniform(position: float, velocity: float) -> Profile:
    """Motion with constant velocity, without an end."""
    return Profile((Piece(inf, position, velocity, 0.0),), position)


def torque_run(
    position: float, velocity: float, permille: float, dynamics: MotorDynamics, speed_limit: float
) -> Profile:
    """Motion under a constant torque, solved exactly; it has no end, and velocity stays within a limit.

    Friction first brings a motor to rest that moves against the torque, then keeps it there unless the torque is
    above the Coulomb torque. Gravity, contact and the other joints do not act, as in the ideal arm.

    Args:
        position: position at the start, counts.
        velocity: velocity at the start, counts/s; it is cut to the limit.
        permille: torque, 1/1000 of the rated torque.
        dynamics: dynamics of the motor.
        speed_limit: greatest speed, counts/s; it may be infinite.
    """
    gain, coulomb, damping = dynamics
    velocity = min(max(velocity, -speed_limit), speed_limit)
    pieces: list[Piece | Decay] = []
    if velocity:
        final = gain * (permille - copysign(coulomb, velocity)) / damping
        if final * velocity < 0.0:
            pieces.append(Decay(log(1.0 - velocity / final) / damping, position, velocity, final, damping))
            (position, _), velocity = pieces[0].at(pieces[0].duration_s), 0.0
    if not velocity:
        if abs(permille) <= coulomb:
            return Profile((*pieces, Piece(inf, position, 0.0, 0.0)), position)
        final = gain * (permille - copysign(coulomb, permille)) / damping
    driven = Decay(inf, position, velocity, final, damping)
    if abs(final) > speed_limit:
        limit = copysign(speed_limit, final)
        driven = driven._replace(duration_s=log((velocity - final) / (limit - final)) / damping)
        pieces.append(driven)
        return Profile((*pieces, Piece(inf, driven.at(driven.duration_s)[0], limit, 0.0)), position)
    return Profile((*pieces, driven), position)
