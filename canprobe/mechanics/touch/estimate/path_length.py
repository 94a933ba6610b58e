"""How far a contact has moved beyond its noise, and how its places spread."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from canprobe.mechanics.types import Floats

_MEDIAN_POINTS, _MEAN_POINTS = 5, 8
_MAX_SQUARE_RATIO, _USUAL_UPDATE_SHARE = 16.0, 0.05
"""Largest squared distance from the median, over the usual one, at full weight; share of one point in the usual one."""


class PathLength:
    """Path of a noisy point: its running mean over some samples, taken in steps well above the noise.

    Why not the sum of distances between samples: noise alone would add up to a path, and a filter that forgets along
    the path would forget at rest. A point that stands still never makes a step here, however long it stands. Nor does a
    single wrong point among right ones, as the mean is taken of medians.

    Args:
        step: least distance that counts, m; some standard deviations of the point.

    Attributes:
        total: path so far, m.
        weight: weight of the last point, below 1 where it lies several times further from the median than usual.
        measured: number of points over which the path was measured; those before the first mean do not count.
    """

    def __init__(self, step: float) -> None:
        self.total = 0.0
        self.weight = 1.0
        self.measured = 0
        self._usual2 = 0.0
        self._step2 = step * step
        self._last: deque[list[float]] = deque(maxlen=_MEDIAN_POINTS)
        self._mean = self._mark = (0.0, 0.0, 0.0)
        self._count = 0

    def add(self, point: Floats) -> float:
        """Take a point (3,), m; returns the length of the step that it completes, m, or 0."""
        px, py, pz = here = point.tolist()
        self._last.append(here)
        middle = len(self._last) // 2
        # np.median of five points takes 18 µs, this takes 2; it runs for every sample, twice
        a, b, c = [sorted(axis)[middle] for axis in zip(*self._last, strict=True)]
        self._weigh((px - a) ** 2 + (py - b) ** 2 + (pz - c) ** 2)
        self._count = min(self._count + 1, _MEAN_POINTS)
        share = 1.0 / self._count
        x, y, z = self._mean
        self._mean = x, y, z = x + share * (a - x), y + share * (b - y), z + share * (c - z)
        if self._count < _MEAN_POINTS:
            self._mark = self._mean
            return 0.0
        self.measured += 1
        u, v, w = self._mark
        square = (x - u) ** 2 + (y - v) ** 2 + (z - w) ** 2
        if square < self._step2:
            return 0.0
        self._mark = self._mean
        length = math.sqrt(square)
        self.total += length
        return length

    def _weigh(self, square: float) -> None:
        """Weigh a point by its squared distance from the median: a contact does not jump from one frame to the next."""
        limit = max(_MAX_SQUARE_RATIO * self._usual2, self._step2)
        ratio = limit / max(square, limit)
        self.weight = ratio * ratio
        # capped at the limit: one wrong point must not open the way for the next
        self._usual2 += _USUAL_UPDATE_SHARE * (min(square, limit) - self._usual2)


class Spread:
    """Weighted covariance of points, with forgetting: second moments about the first point."""

    def __init__(self) -> None:
        self._origin: Floats | None = None
        self._moments = np.zeros((4, 4))

    @property
    def weight(self) -> float:
        """Sum of weights."""
        return float(self._moments[3, 3])

    @property
    def covariance(self) -> Floats:
        """(3, 3) covariance of the points, m²."""
        M = self._moments / max(self.weight, 1e-300)
        mean = M[:3, 3]
        return M[:3, :3] - mean[:, None] * mean

    def fade(self, kept: float) -> None:
        """Weigh everything so far by a factor."""
        self._moments *= kept

    def add(self, points: Floats, weights: Floats) -> None:
        """Take points (n, 3) with weights (n,)."""
        if self._origin is None:
            self._origin = points[0].copy()
        X = np.ones((len(points), 4))
        # about the origin of the base, half a metre away, the covariance of a path of millimetres loses six digits
        X[:, :3] = points - self._origin
        self._moments += (X.T * weights).dot(X)
