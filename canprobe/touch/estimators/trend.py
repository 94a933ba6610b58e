"""How fast the fitted curvature changes along the path, and how much of that an answer may lag behind.

A memory is a mean over the path. Where curvature changes along it the mean is that of an earlier place; the terms that
a quadric leaves out (`misfit`) follow most of the change, not all. What is left has the direction of the change, and is
taken to be that of a small share of the memory: so it is nothing where the data show one curvature, however long the
path, and grows by itself where they show another, as on the way from a plane to an arc.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from canprobe.touch._arrays import Array

SPAN = 0.25
"""Path, over the memory, along which a change is looked for; less just after a start."""
LAG = 0.075
"""Path, over the memory, that an answer lags behind: one standard deviation. Three steps of the filter's path; set on
`canprobe study pipeline`'s calibration seeds of the wave and the torus."""


class Trend:
    """Curvature tensors along the path, over a span.

    Args:
        length: the memory, m.
    """

    def __init__(self, length: float) -> None:
        self._length = length
        self._travelled = 0.0
        self._past: deque[tuple[float, Array]] = deque()

    def reset(self) -> None:
        """What was before is of another surface."""
        self._travelled = 0.0
        self._past.clear()

    def take(self, c: Array, T: Array, moved: float) -> None:
        """Take parameters (9,) in units of the memory and of a working frame (4, 4), after a step of the path (m)."""
        self._travelled += moved
        c11, c12, c22 = c[6:].tolist()
        x, y = T[:3, 0], T[:3, 1]
        mixed = np.outer(x, y)
        self._past.append((self._travelled, c11 * np.outer(x, x) + c12 * (mixed + mixed.T) + c22 * np.outer(y, y)))
        while self._travelled - self._past[0][0] > SPAN * self._length:
            self._past.popleft()

    def lag(self, T: Array) -> Array:
        """(9,) change of the parameters in a working frame (4, 4) over the path that an answer lags behind."""
        found = np.zeros(9)
        if len(self._past) > 1:
            (then, before), (now, here) = self._past[0], self._past[-1]
            P = T[:3, :2]
            change = P.T @ (here - before) @ P * (LAG * self._length / (now - then))
            found[6:] = change[0, 0], change[0, 1], change[1, 1]
        return found
