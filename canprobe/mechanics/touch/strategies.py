"""Strategies: where the contact goes next, as a heading in the scan plane.

The scan plane is perpendicular to the approach direction. A strategy is a closed curve in that plane, followed by arc
length, so that the contact has one speed everywhere; the servo lifts the heading into the surface's tangent plane.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

TURN_PERIODS = 3.0
"""Time of a turn by a radian over the time constant of the servo's normal."""
CROSS_TRACK_PER_M = 60.0
"""Turn of the heading back to the curve, as the tangent of an angle over the distance, 1/m."""
MIN_PACE = 0.05
"""Share of the speed with which a path turns back."""


class Strategy(Protocol):
    """A closed curve in the scan plane that starts at the origin."""

    def point(self, phase: float) -> tuple[float, float]:
        """Point of the curve (m, m: along the heading, across) at ``phase`` (rad)."""

    def tangent(self, phase: float) -> tuple[float, float]:
        """Derivative of `point` by the phase (m/rad)."""


class Weave:
    """To and fro along the heading with a sine across it, which excites the curvature in both directions everywhere.

    Along the heading it is a triangle wave without its sharp tips (three terms of its series). Why not a plain sine:
    the path would linger at its ends and leave the curvature along the heading without excitation there.

    Args:
        length_m: full size along the heading, m.
        width_m: full size across it, m.
        wavelength_m: mean distance along the heading of one full weave, m. It sets the even ratio ``m`` of the two
            frequencies: with an even ratio the path turns round smoothly at the ends and comes back beside itself; with
            an odd one it would reverse on itself.
    """

    def __init__(self, length_m: float, width_m: float, wavelength_m: float) -> None:
        # over the value of the series at its tip, so that the size is the full one
        self._a, self._b = length_m / 2 / (1 + 1 / 9 + 1 / 25), width_m / 2
        self._m = max(2, 2 * round(length_m / wavelength_m))

    def point(self, phase: float) -> tuple[float, float]:
        along = math.sin(phase) - math.sin(3.0 * phase) / 9.0 + math.sin(5.0 * phase) / 25.0
        return self._a * along, self._b * math.sin(self._m * phase)

    def tangent(self, phase: float) -> tuple[float, float]:
        along = math.cos(phase) - math.cos(3.0 * phase) / 3.0 + math.cos(5.0 * phase) / 5.0
        return self._a * along, self._b * self._m * math.cos(self._m * phase)


class Circle:
    """A circle through the start point with its centre ``diameter/2`` along the heading.

    Args:
        diameter_m: diameter, m.
    """

    def __init__(self, diameter_m: float) -> None:
        self._r = diameter_m / 2

    def point(self, phase: float) -> tuple[float, float]:
        return self._r * (1 - math.cos(phase)), self._r * math.sin(phase)

    def tangent(self, phase: float) -> tuple[float, float]:
        return self._r * math.sin(phase), self._r * math.cos(phase)


class Straight:
    """To and fro along the heading: a triangle wave, one stroke of ``length/2`` per quarter turn of the phase.

    A straight path leaves the curvature across it unobserved; the strategy serves to show that.

    Args:
        length_m: full size along the heading, m.
    """

    def __init__(self, length_m: float) -> None:
        self._slope = length_m / math.pi

    def point(self, phase: float) -> tuple[float, float]:
        folded = (phase + math.pi / 2) % (2 * math.pi)
        return self._slope * (min(folded, 2 * math.pi - folded) - math.pi / 2), 0.0

    def tangent(self, phase: float) -> tuple[float, float]:
        return (self._slope if (phase + math.pi / 2) % (2 * math.pi) < math.pi else -self._slope), 0.0

    def way_to_turn(self, phase: float) -> float:
        """Way along the curve from ``phase`` to the nearest end, where it turns back at once, m."""
        folded = (phase + math.pi / 2) % math.pi
        return self._slope * min(folded, math.pi - folded)


@dataclass(frozen=True, slots=True)
class Rectangle:
    """A rectangle that is explored: no curve, the path follows from what is known (`mechanics.touch.explore`).

    Attributes:
        length: full size along the heading, m; its middle is the end of the approach.
        width: full size across it, m.
        target_sigma: standard deviation of the height that is wanted everywhere in it, m.
    """

    length: float
    width: float
    target_sigma: float


def turn_radius(speed: float, tilt_hz: float) -> float:
    """Smallest radius of a turn of an explored path, m: the heading turns with a third of the servo's bandwidth.

    Args:
        speed: speed of the contact, m/s.
        tilt_hz: bandwidth with which the servo's normal follows the contacts, Hz.
    """
    return TURN_PERIODS * speed / (2 * math.pi * tilt_hz)


def make_strategy(name: str, length_m: float, width_m: float, wavelength_m: float = 0.012) -> Strategy:
    """A strategy by name: ``weave``, ``circle`` or ``straight``; each takes of the sizes, m, those that it has.

    Raises:
        KeyError: the name is another one.
    """
    makers: dict[str, Callable[[], Strategy]] = {
        "weave": lambda: Weave(length_m, width_m, wavelength_m),
        "circle": lambda: Circle(length_m),
        "straight": lambda: Straight(length_m),
    }
    return makers[name]()


class PathFollower:
    """Follows a curve by arc length.

    Args:
        strategy: the curve.
        brake_m: way on which it brakes before it turns back, and gets faster behind that, m.

    Attributes:
        pace: share of the speed. Why not 1 everywhere: where the path turns back at once, the drives cannot, and the
            probe would leave the surface.
    """

    pace = 1.0

    def __init__(self, strategy: Strategy, brake_m: float = 0.0) -> None:
        self._strategy = strategy
        self._turning = strategy if isinstance(strategy, Straight) else None
        self._brake = brake_m
        self._phase = 0.0
        self._tangent = strategy.tangent(0.0)

    @property
    def heading(self) -> tuple[float, float]:
        """Unit tangent (along, across) of the curve where the follower is."""
        tx, ty = self._tangent
        norm = max(math.hypot(tx, ty), 1e-9)
        return tx / norm, ty / norm

    def step(self, x: float, y: float, distance_m: float) -> tuple[float, float]:
        """Unit heading (along, across) in the scan plane for the next step.

        Args:
            x, y: place of the contact in the scan plane, m.
            distance_m: way of the contact in that plane until the next call, m.
        """
        tx, ty = self._tangent
        norm = math.hypot(tx, ty)
        self._phase += distance_m / max(norm, 1e-4)
        self._tangent = self._strategy.tangent(self._phase)
        if self._turning is not None and self._brake > 0.0:
            # a constant deceleration: v² = 2 a s
            self.pace = min(1.0, max(MIN_PACE, math.sqrt(self._turning.way_to_turn(self._phase) / self._brake)))
        px, py = self._strategy.point(self._phase)
        hx = tx / max(norm, 1e-9) + CROSS_TRACK_PER_M * (px - x)
        hy = ty / max(norm, 1e-9) + CROSS_TRACK_PER_M * (py - y)
        scale = math.hypot(hx, hy)
        return (hx / scale, hy / scale) if scale > 1e-9 else (1.0, 0.0)
