"""Trapezoidal motion to a target, from any position and speed, as pieces of constant acceleration.

A motor that moves the wrong way, or too fast to stop in time, is braked to rest first and turned round. One that is
faster than allowed is braked to the profile velocity.
Source: CiA 402-2, profile position mode, objects 6081h, 6083h, 6084h, motion profile type 6086h = 0.
"""

from __future__ import annotations

from math import copysign, sqrt
from typing import NamedTuple


class Piece(NamedTuple):
    """Constant acceleration over some time: s, counts, counts/s, counts/s²."""

    duration_s: float
    position: float
    velocity: float
    acceleration: float

    def at(self, t_s: float) -> tuple[float, float]:
        """Position and velocity `t_s` after the piece began."""
        return (
            self.position + t_s * (self.velocity + 0.5 * t_s * self.acceleration),
            self.velocity + t_s * self.acceleration,
        )


class Profile:
    """Pieces one after the other, at rest at `end` after them.

    Attributes:
        duration_s: s.
        end: position at rest, counts.
    """

    def __init__(self, pieces: tuple[Piece, ...], end: float) -> None:
        self._pieces = pieces
        self.end = end
        self.duration_s = sum(piece.duration_s for piece in pieces)

    def at(self, t_s: float) -> tuple[float, float]:
        """Position (counts) and velocity (counts/s) `t_s` after the start."""
        if t_s >= self.duration_s:
            return self.end, 0.0
        for piece in self._pieces:
            if t_s < piece.duration_s:
                return piece.at(t_s)
            t_s -= piece.duration_s
        return self.end, 0.0


def braking(position: float, velocity: float, deceleration: float) -> Profile:
    """To rest, as soon as the deceleration (counts/s², positive) allows."""
    piece = Piece(abs(velocity) / deceleration, position, velocity, -copysign(deceleration, velocity))
    return Profile((piece,), piece.at(piece.duration_s)[0])


def trapezoid(
    position: float, velocity: float, target: float, *, speed: float, acceleration: float, deceleration: float
) -> Profile:
    """To rest at a target.

    Args:
        position: at the start, counts.
        velocity: at the start, counts/s.
        target: counts.
        speed: of the flat part, counts/s, positive.
        acceleration: counts/s², positive.
        deceleration: counts/s², positive.
    """
    pieces: list[Piece] = []
    stop = position + 0.5 * velocity * abs(velocity) / deceleration
    sign = copysign(1.0, target - stop) if target != stop else copysign(1.0, velocity)
    if velocity * sign < 0.0:
        pieces.append(Piece(abs(velocity) / deceleration, position, velocity, sign * deceleration))
        position, velocity = stop, 0.0
    way, v0 = sign * (target - position), abs(velocity)
    peak = min(
        speed, sqrt((2 * acceleration * deceleration * way + deceleration * v0**2) / (acceleration + deceleration))
    )
    change = acceleration if peak >= v0 else -deceleration
    lengths = ((peak - v0) / change, 0.0, peak / deceleration)
    used = 0.5 * (v0 + peak) * lengths[0] + 0.5 * peak * lengths[2]
    cruise = max(0.0, (way - used) / peak) if peak > 0.0 else 0.0
    for seconds, rate in zip((lengths[0], cruise, lengths[2]), (change, 0.0, -deceleration), strict=True):
        piece = Piece(seconds, position, velocity, sign * rate)
        pieces.append(piece)
        position, velocity = piece.at(seconds)
    return Profile(tuple(pieces), target)
