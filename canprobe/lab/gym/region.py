"""The region of a scan, and its touched part."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from canprobe.mechanics.types import Floats

CELL_M = 0.5e-3
"""Side of a cell of the grid, m."""
TOUCH_RADIUS_M = 1.5e-3
"""Radius round a contact within which the surface counts as touched, m: a third of the patch at 2 N on a plane."""
SECTORS = 8
"""Number of directions in which an agent sees the untouched part."""
SIGHT_RADIUS_M = 6e-3
"""Radius within which it sees, m."""


class Coverage:
    """A grid over the scan plane: a rectangle round the first contact, and the cells that were touched.

    Args:
        length, width: sides of the rectangle along the heading and across it, m.
    """

    def __init__(self, length: float, width: float) -> None:
        self._half = np.array((length, width)) / 2
        self._shape = math.ceil(length / CELL_M), math.ceil(width / CELL_M)
        # A border as wide as the sight, which counts as touched: nothing outside of the rectangle is worth a touch.
        reach = round(SIGHT_RADIUS_M / CELL_M)
        self._touched = np.pad(np.zeros(self._shape, dtype=bool), reach, constant_values=True)
        self._side = 2 * reach + 1
        i, j = np.indices((self._side, self._side)) - reach
        away = CELL_M * np.hypot(i, j)
        self._brush, self._sight = away <= TOUCH_RADIUS_M, (away > TOUCH_RADIUS_M) & (away <= SIGHT_RADIUS_M)
        angle = np.arctan2(j, i)[self._sight]
        self._sector = np.rint(angle * (SECTORS / (2 * math.pi))).astype(int) % SECTORS
        self._in_sector = np.bincount(self._sector, minlength=SECTORS)
        self._cells = 0

    @property
    def area(self) -> float:
        """Touched area so far, m²."""
        return self._cells * CELL_M**2

    @property
    def share(self) -> float:
        """Touched share of the rectangle so far."""
        return self._cells / (self._shape[0] * self._shape[1])

    def touch(self, place: Floats) -> float:
        """Touch the surface at a place (2,) along the heading and across it, m; returns the new area, m²."""
        window = self._window(place)
        if window is None:
            return 0.0
        new = int(np.count_nonzero(self._brush & ~window))
        window |= self._brush
        self._cells += new
        return new * CELL_M**2

    def left(self, place: Floats) -> Floats:
        """Untouched share within sight of a place (2,), m, by direction (`SECTORS`,).

        The first is round the heading; the others follow towards the side across.
        """
        window = self._window(place)
        if window is None:
            return np.zeros(SECTORS)
        left: Floats = np.bincount(self._sector, weights=~window[self._sight], minlength=SECTORS) / self._in_sector
        return left

    def _window(self, place: Floats) -> NDArray[np.bool_] | None:
        """The part of the grid within sight of a place, as a view; None outside of the rectangle."""
        i, j = np.floor((place + self._half) / CELL_M).astype(int).tolist()
        if not (0 <= i < self._shape[0] and 0 <= j < self._shape[1]):
            return None
        return self._touched[i : i + self._side, j : j + self._side]
