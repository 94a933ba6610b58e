"""Lanes along the sides of a rectangle, from its border inwards, until the lanes of opposite sides meet.

Contour-parallel coverage, as pockets are milled. Side k = 0 … 3 is walked in the direction of k quarter turns, so that
what is not known lies to the left; a quarter turn leads from a lane to the next. What lies between two opposite sides
is divided evenly, with each lane anew, by the spacing that holds then. An edge moves the border.

Why not lanes to and fro: between two lanes, on the side where no turn joins them, the border is left untouched.

Source: Held, "On the computational geometry of pocket machining", 1991.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from canprobe.mechanics.touch.explore.spacing import Spacing
from canprobe.mechanics.touch.explore.stretches import Heading


class Lane(NamedTuple):
    """A straight lane: its beginning with its direction, and its length, m."""

    start: Heading
    length: float


class InwardLanes:
    """The lanes of a rectangle, whose middle is the origin.

    Args:
        size: length and width of the rectangle, m.
        radius: radius of the turn between two lanes, m.
    """

    def __init__(self, size: tuple[float, float], radius: float) -> None:
        length, width = size
        self._radius = radius
        self._outermost = [0.5 * width, 0.5 * length, 0.5 * width, 0.5 * length]
        self._is_lane = [False] * 4
        self._side = 0 if length >= width else 1
        self._agreed: float | None = None

    def next(self, spacing: Spacing) -> Lane | None:
        """The next lane; None where two opposite sides are no farther apart than the spacing allows."""
        if not self._wants(spacing):
            return None
        side, before, after = self._side, (self._side - 1) % 4, (self._side + 1) % 4
        away = self._place(side, spacing) if self._agreed is None else self._agreed
        begin = self._radius - (self._outermost[before] if self._is_lane[before] else self._place(before, spacing))
        end = self._agreed = self._place(after, spacing)
        self._outermost[side], self._is_lane[side], self._side = away, True, after
        if self._wants(spacing):  # another lane follows: room for the turn to it
            end -= self._radius
        along, across = _quarter(side)
        start = Heading(begin * along + away * across, begin * across - away * along, 0.5 * math.pi * side)
        return Lane(start, max(end - begin, 0.0))

    def close(self, x: float, y: float, angle: float) -> None:
        """Move the border that lies ahead, rad, to a place (m, m) where the ground ends."""
        ahead = round(angle / (0.5 * math.pi))
        along, across = _quarter(ahead)
        side, place = (ahead + 1) % 4, x * along + y * across
        if place < self._outermost[side]:
            self._outermost[side], self._is_lane[side], self._agreed = place, False, None

    def _wants(self, spacing: Spacing) -> bool:
        """Whether both pairs of opposite sides leave room for a lane."""
        return min(self._count(side, spacing) for side in (0, 1)) > 0

    def _count(self, side: int, spacing: Spacing) -> int:
        """Number of lanes that are due between a side and the opposite one."""
        opposite = (side + 2) % 4
        if (width := self._outermost[side] + self._outermost[opposite]) <= 0.0:
            return 0
        shown = self._distance(side, spacing) + self._distance(opposite, spacing) - spacing.gap
        return max(math.ceil((width - shown) / spacing.gap - 1e-9), 0)

    def _place(self, side: int, spacing: Spacing) -> float:
        """Distance of the next lane of a side from the middle, m: all distances shrink alike, so that lanes fit in."""
        opposite, between = (side + 2) % 4, max(self._count(side, spacing), 1) - 1
        width = self._outermost[side] + self._outermost[opposite]
        near, far = self._distance(side, spacing), self._distance(opposite, spacing)
        return self._outermost[side] - near * width / (near + between * spacing.gap + far)

    def _distance(self, side: int, spacing: Spacing) -> float:
        """Largest distance of a lane from what a side has now, a lane or a border, m."""
        return spacing.gap if self._is_lane[side] else spacing.margin


def _quarter(turns: int) -> tuple[int, int]:
    """Unit vector after some quarter turns from the first axis."""
    return ((1, 0), (0, 1), (-1, 0), (0, -1))[turns % 4]
