"""Motion along a way from rest to rest, as quick as speed, acceleration and jerk allow; and the braking of one.

The profile has at most seven stretches of constant jerk: up to the acceleration, at it, down from it; at the speed; and
the same three back to rest. Braking is three of them, from whatever speed and acceleration the motion has.

Source: Biagiotti and Melchiorri, Trajectory Planning for Automatic Machines and Robots (2008), 3.4.
"""

from __future__ import annotations

import math
from collections.abc import Iterable


def smooth_step(u: float) -> float:
    """Quintic from 0 to 1 over ``u`` in 0…1, with zero slope and bend at both ends; constant outside."""
    u = min(max(u, 0.0), 1.0)
    return u * u * u * (10 - 15 * u + 6 * u * u)


class MotionProfile:
    """Place and speed along a way, by time.

    Args:
        length: length of the way, in any unit, at least 0.
        speed, acceleration, jerk: limits above 0, in that unit per s, s² and s³.
    """

    def __init__(self, length: float, speed: float, acceleration: float, jerk: float) -> None:
        self.acceleration, self.jerk = acceleration, jerk
        peak = min(speed, _peak_speed(length, acceleration, jerk))
        ramp_s, held_s = self._ramp(peak)
        cruise_s = max(0.0, length / peak - (2.0 * ramp_s + held_s)) if peak > 0.0 else 0.0
        stretches = [(ramp_s, jerk), (held_s, 0.0), (ramp_s, -jerk), (cruise_s, 0.0)]
        self._stretches = self._joined([*stretches, (ramp_s, -jerk), (held_s, 0.0), (ramp_s, jerk)])

    @property
    def duration_s(self) -> float:
        """Time from rest to rest, s."""
        return sum(stretch[0] for stretch in self._stretches)

    @property
    def length(self) -> float:
        """Length of the way; after `brake` where the motion ends."""
        return self.at(self.duration_s)[0]

    def at(self, t_s: float) -> tuple[float, float]:
        """Place and speed at a time from the start, s; before and after the motion those at its ends."""
        s, v, _ = self._state(t_s)
        return s, v

    def brake(self, t_s: float) -> None:
        """Come to rest from a time on, as quickly as acceleration and jerk allow."""
        _, v, a = self._state(t_s)
        lowest = min(self.acceleration, math.sqrt(max(0.0, self.jerk * v + 0.5 * a * a)))
        held_s = max(0.0, (v + (0.5 * a * a - lowest * lowest) / self.jerk) / self.acceleration)
        before: list[tuple[float, float]] = []
        left = min(max(t_s, 0.0), self.duration_s)
        for seconds, jerk, _ in self._stretches:
            before.append((min(seconds, left), jerk))
            left -= before[-1][0]
        rest = [(max(0.0, a + lowest) / self.jerk, -self.jerk), (held_s, 0.0), (lowest / self.jerk, self.jerk)]
        self._stretches = self._joined([*before, *rest])

    def _ramp(self, peak: float) -> tuple[float, float]:
        """Seconds of growing and of constant acceleration up to a speed."""
        ramp_s = min(self.acceleration / self.jerk, math.sqrt(peak / self.jerk))
        return ramp_s, max(0.0, peak / self.acceleration - ramp_s) if ramp_s == self.acceleration / self.jerk else 0.0

    def _state(self, t_s: float) -> tuple[float, float, float]:
        left = min(max(t_s, 0.0), self.duration_s)
        for seconds, jerk, state in self._stretches:
            if left <= seconds:
                return _after(state, left, jerk)
            left -= seconds
        return _after(state, seconds, jerk)

    @staticmethod
    def _joined(stretches: Iterable[tuple[float, float]]) -> list[tuple[float, float, tuple[float, float, float]]]:
        """Duration, jerk and first state (place, speed, acceleration) of each stretch, from rest."""
        joined, state = [], (0.0, 0.0, 0.0)
        for seconds, jerk in stretches:
            joined.append((seconds, jerk, state))
            state = _after(state, seconds, jerk)
        return joined


def _after(state: tuple[float, float, float], t: float, jerk: float) -> tuple[float, float, float]:
    s, v, a = state
    return s + t * (v + t * (a / 2.0 + t * jerk / 6.0)), v + t * (a + t * jerk / 2.0), a + t * jerk


def _peak_speed(length: float, acceleration: float, jerk: float) -> float:
    """Highest speed on a way that is too short for a speed limit."""
    full = acceleration * acceleration / jerk  # speed from which on the acceleration is reached
    if length <= 2.0 * full * acceleration / jerk:
        return float((0.25 * length * length * jerk) ** (1.0 / 3.0))
    return 0.5 * (math.sqrt(full * full + 4.0 * acceleration * length) - full)
