"""Stretches of path in the scan plane: a turn at constant radius, then straight; and the way back."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canprobe.mechanics.types import Floats

STEP_M = 1e-3
"""Distance between the points at which a stretch is looked at, m."""
LONGEST_M = 24e-3
"""Longest straight part of a stretch, m."""
TURNS = tuple(math.radians(angle) for angle in (0, 20, 45, 75, 110, 150, 200))
"""Angles of turn to either side, rad."""
RADII = (1.0, 3.0)
"""Radii of turns, in smallest radii."""


class Heading(NamedTuple):
    """A place of the scan plane, m, and a direction, rad from its first axis."""

    x: float
    y: float
    angle: float

    def centre(self, radius: float, side: float) -> tuple[float, float]:
        """Centre of the circle of a radius, m, that is entered to a side, +1: left, −1: right."""
        return self.x - side * radius * math.sin(self.angle), self.y + side * radius * math.cos(self.angle)


class Stretch(NamedTuple):
    """A turn at constant radius, then straight: a curve for `PathFollower`, whose phase is the path in m.

    Attributes:
        start: place and direction of its beginning.
        turn: angle of the turn, rad, positive to the left.
        radius: radius of the turn, m.
        straight: length of the straight part, m.
    """

    start: Heading
    turn: float
    radius: float
    straight: float

    @property
    def length(self) -> float:
        """Length, m."""
        return abs(self.turn) * self.radius + self.straight

    def at(self, way: float) -> Heading:
        """Place and direction at a path from the start, m; behind the end it goes straight on."""
        side = math.copysign(1.0, self.turn)
        cx, cy = self.start.centre(self.radius, side)
        turned = side * min(way / self.radius, abs(self.turn))
        angle = self.start.angle + turned
        straight = max(0.0, way - abs(self.turn) * self.radius)
        return Heading(
            cx + side * self.radius * math.sin(angle) + straight * math.cos(angle),
            cy - side * self.radius * math.cos(angle) + straight * math.sin(angle),
            angle,
        )

    def cut(self, length: float) -> Stretch:
        """Its beginning of a length, m."""
        turning = min(length / self.radius, abs(self.turn))
        return self._replace(
            turn=math.copysign(turning, self.turn), straight=max(0.0, length - abs(self.turn) * self.radius)
        )

    def ways(self) -> Floats:
        """(n,) paths from the start, m, a step apart, of the points at which it is looked at."""
        return STEP_M * np.arange(1.0, max(1, round(self.length / STEP_M)) + 1.0)

    def point(self, phase: float) -> tuple[float, float]:
        """Place at a path from the start, m."""
        return self.at(phase)[:2]

    def tangent(self, phase: float) -> tuple[float, float]:
        """Unit direction there."""
        angle = self.at(phase).angle
        return math.cos(angle), math.sin(angle)


class WalkedBack:
    """The path that was walked, backwards: a curve for `PathFollower`, whose phase is the path in m.

    Args:
        walked: (n, 2) places that were walked last, the newest last, m.
    """

    def __init__(self, walked: Sequence[tuple[float, float]]) -> None:
        self._places = [walked[-1]]
        self._ways = [0.0]
        for place in reversed(walked):
            if (step := math.dist(place, self._places[-1])) > 0.5 * STEP_M:
                self._places.append(place)
                self._ways.append(self._ways[-1] + step)
        self.length = self._ways[-1]

    def at(self, way: float) -> Heading:
        """Place and direction at a path from the start, m."""
        if len(self._places) < 2:
            return Heading(*self._places[0], 0.0)
        i = min(max(bisect_right(self._ways, way), 1), len(self._ways) - 1)
        (ax, ay), (bx, by) = self._places[i - 1], self._places[i]
        share = (way - self._ways[i - 1]) / (self._ways[i] - self._ways[i - 1])
        return Heading(ax + share * (bx - ax), ay + share * (by - ay), math.atan2(by - ay, bx - ax))

    def point(self, phase: float) -> tuple[float, float]:
        """Place at a path from the start, m."""
        return self.at(phase)[:2]

    def tangent(self, phase: float) -> tuple[float, float]:
        """Unit direction there."""
        angle = self.at(phase).angle
        return math.cos(angle), math.sin(angle)


def fan(start: Heading, radius: float, target: tuple[float, float]) -> Iterator[Stretch]:
    """The stretches that may begin at a place, those that lead to a target (m, m) first.

    Args:
        start: place and direction.
        radius: smallest radius of a turn, m.
        target: place that is to be reached.
    """
    for side in (1.0, -1.0):
        if (leading := _leading_to(start, side, radius, target)) is not None:
            yield leading
    for turn in TURNS:
        for factor in RADII if turn else RADII[:1]:
            for side in (1.0, -1.0) if turn else (1.0,):
                yield Stretch(start, side * turn, factor * radius, LONGEST_M)


def _leading_to(start: Heading, side: float, radius: float, target: tuple[float, float]) -> Stretch | None:
    """The turn to a side, and straight to a target; None where that lies within the circle."""
    cx, cy = start.centre(radius, side)
    away, bearing = math.dist((cx, cy), target), math.atan2(target[1] - cy, target[0] - cx)
    if away <= radius:
        return None
    leaves = bearing + side * math.asin(radius / away)  # direction of the tangent through the target
    return Stretch(
        start, side * ((side * (leaves - start.angle)) % (2.0 * math.pi)), radius, math.sqrt(away**2 - radius**2)
    )


class Room:
    """Where a stretch may go: the rectangle without its closed cells, and so that the next one can turn.

    Args:
        size: length and width of the rectangle, m.
        radius: smallest radius of a turn, m.
    """

    def __init__(self, size: tuple[float, float], radius: float) -> None:
        self._half = 0.5 * np.array(size)
        self._radius = radius
        self._closed: Floats = np.zeros((0, 2))
        self._clearance = 0.0

    def close(self, places: Floats, clearance: float) -> None:
        """Set the closed places (k, 2), m, and the distance, m, that is kept from each."""
        self._closed, self._clearance = places, clearance

    def inside(self, points: Floats, margin: float = 0.0) -> NDArray[np.bool_]:
        """(n,) whether points (n, 2), m, are in the rectangle less a margin, m, and as far from closed places."""
        within: NDArray[np.bool_] = np.asarray((np.abs(points) <= self._half - margin + 1e-9).all(axis=1))
        if len(self._closed):
            apart = np.linalg.norm(points[:, None] - self._closed, axis=2).min(axis=1)
            within = within & (apart >= self._clearance + margin)
        return within

    def reach(self, stretch: Stretch) -> float:
        """Length of a stretch up to its last point, m, that is inside and behind which it can turn; 0: none."""
        ways = stretch.ways()
        places = [stretch.at(way) for way in ways.tolist()]
        points = np.array([place[:2] for place in places])
        blocked = np.flatnonzero(~self.inside(points))
        free = len(ways) if not len(blocked) else int(blocked[0])
        turns = np.zeros(len(ways), bool)
        for side in (1.0, -1.0):
            turns |= self.inside(np.array([place.centre(self._radius, side) for place in places]), self._radius)
        ends = np.flatnonzero(turns[:free])
        return float(ways[ends[-1]]) if len(ends) else 0.0

    def circle(self, start: Heading) -> Stretch:
        """A full turn to the side where there is room for it."""
        centres = np.array([start.centre(self._radius, side) for side in (1.0, -1.0)])
        left, right = self.inside(centres, self._radius).tolist()
        side = 1.0 if left or not right else -1.0
        return Stretch(start, side * 2.0 * math.pi, self._radius, 0.0)
