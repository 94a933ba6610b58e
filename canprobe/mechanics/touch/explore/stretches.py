"""Stretches of path in the scan plane: a turn at constant radius, then straight; and the way back."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canprobe.mechanics.types import Floats

STEP_M = 1e-3
"""Distance between the points at which a stretch is looked at, m."""
CLEARANCE_M = 2e-3
"""Distance that paths keep from the middle of a closed cell, m."""


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
        """(n,) paths from the start to the end, m, at most a step apart, of the points at which it is looked at."""
        count = max(1, math.ceil(self.length / STEP_M))
        return self.length / count * np.arange(1.0, count + 1.0)

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


def stretches_to(start: Heading, end: Heading, radius: float, onward: float) -> list[tuple[Stretch, Stretch]]:
    """Smooth paths from a place and direction to another and straight on, the shortest first.

    Each is a turn, a straight line, a turn, and the line onward.

    Args:
        start, end: places and directions.
        radius: radius of the turns, m.
        onward: length of the line behind the end, m.

    Source: Dubins, "On curves of minimal length with a constraint on average curvature", 1957 (paths CSC).
    """
    found = []
    for first in (1.0, -1.0):
        for second in (1.0, -1.0):
            a, b = start.centre(radius, first), end.centre(radius, second)
            apart = math.dist(a, b)
            bearing = math.atan2(b[1] - a[1], b[0] - a[0]) if apart > 1e-9 else start.angle  # one and the same circle
            beside = radius * (first - second)  # 0, or ± a diameter where the line crosses from circle to circle
            if apart < abs(beside):
                continue
            angle = bearing + (math.asin(beside / apart) if beside else 0.0)
            turn, straight = _turned(angle - start.angle, first), math.sqrt(apart**2 - beside**2)
            to_end = Stretch(start, turn, radius, straight)
            found.append(
                (to_end, Stretch(to_end.at(to_end.length), _turned(end.angle - angle, second), radius, onward))
            )
    return sorted(found, key=lambda path: path[0].length + path[1].length)


def _turned(angle: float, side: float) -> float:
    """The angle, rad, as a turn to a side, +1: left, −1: right; less than a full one."""
    turn = (side * angle) % (2.0 * math.pi)
    return side * (turn if turn < 2.0 * math.pi - 1e-7 else 0.0)  # −1e-17 is no full turn


def leading_to(start: Heading, side: float, radius: float, target: tuple[float, float]) -> Stretch | None:
    """The turn to a side, +1: left, −1: right, and straight to a target (m, m); None: it lies within the circle."""
    cx, cy = start.centre(radius, side)
    away, bearing = math.dist((cx, cy), target), math.atan2(target[1] - cy, target[0] - cx)
    if away <= radius:
        return None
    leaves = bearing + side * math.asin(radius / away)  # direction of the tangent through the target
    return Stretch(start, _turned(leaves - start.angle, side), radius, math.sqrt(away**2 - radius**2))


class Room:
    """Where a stretch may go: the rectangle without its closed cells, and so that the next one can turn.

    Args:
        size: length and width of the rectangle, m.
        radius: smallest radius of a turn, m.

    Attributes:
        closed: (k, 2) middles of the closed cells, m.
    """

    def __init__(self, size: tuple[float, float], radius: float) -> None:
        self._half = 0.5 * np.array(size)
        self._radius = radius
        self.closed: Floats = np.zeros((0, 2))

    def inside(self, points: Floats, margin: float = 0.0) -> NDArray[np.bool_]:
        """(n,) whether points (n, 2), m, are in the rectangle less a margin, m, and as far from closed places."""
        within: NDArray[np.bool_] = np.asarray((np.abs(points) <= self._half - margin + 1e-9).all(axis=1))
        if len(self.closed):
            apart = np.linalg.norm(points[:, None] - self.closed, axis=2).min(axis=1)
            within = within & (apart >= CLEARANCE_M + margin)
        return within

    def holds(self, stretch: Stretch) -> bool:
        """Whether all of a stretch is inside."""
        return bool(self.inside(np.array([stretch.point(way) for way in stretch.ways().tolist()])).all())

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
