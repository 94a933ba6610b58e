"""The contact's path as segments: thinned, lifted off the surface, and cut into chunks by time."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from canprobe.cell.tasks.probing import Phase
from canprobe.lab.bridge.view.colours import Colours, scale
from canprobe.mechanics.touch.shapes import PlacedShape
from canprobe.mechanics.types import Floats

SPACING_M = 4e-4
"""Distance between two drawn points of the path, m."""
LIFT_M = 6e-4
"""Distance of the path from the surface along the normal, m, so that the surface does not hide it."""
GAP_M = 8e-3
"""Distance of two contacts above which they are not joined, m: the probe was lifted between them."""
OFF_PATH = (Phase.APPROACH, Phase.RETREAT, Phase.DONE)
"""Phases whose contacts are not points of the path."""
SHARE, LEAST_PER_M, UNCERTAIN_PER_M = 0.05, 0.5, 2.0


@dataclass(frozen=True, slots=True)
class DeviationScale:
    """Scale of the colours of the recovered surface.

    Attributes:
        high: value of the last colour, 1/m; the first is 0.
        text: name of the coloured quantity, for a legend.
    """

    high: float
    text: str

    def colours(self, values: Floats) -> Colours:
        """Colours (n, 3) of values (n,), 1/m: bright for a small deviation, grey where a value is not finite."""
        return scale(self.high - np.asarray(values), 0.0, self.high)


def deviation_scale(shape: PlacedShape | None) -> DeviationScale:
    """Up to five per cent of the object's curvature; up to 2 1/m where no object is known.

    Args:
        shape: the true object, or None.
    """
    high = UNCERTAIN_PER_M
    if shape is not None:
        kappa = shape.closest(shape.T_base_object[:3, 3]).kappa
        high = max(SHARE * float(np.linalg.norm(kappa)), LEAST_PER_M)
    return DeviationScale(high, "stated deviation of K (1/m)")


class Trail:
    """Collects contacts into segments."""

    def __init__(self) -> None:
        self._last: Floats | None = None
        self.segments: list[Floats] = []
        self.times: list[float] = []

    def __len__(self) -> int:
        return len(self.segments)

    def add(self, t_s: float, point: Floats, normal: Floats) -> bool:
        """Take one contact; returns whether it has made a segment.

        Args:
            t_s: time of the contact, s.
            point: contact point (3,), m.
            normal: outward normal (3,).
        """
        lifted = point + LIFT_M * normal
        if self._last is None:
            self._last = lifted
            return False
        step = float(np.linalg.norm(lifted - self._last))
        if step < SPACING_M:
            return False
        joined = step < GAP_M
        if joined:
            self.segments.append(np.stack([self._last, lifted]))
            self.times.append(t_s)
        self._last = lifted
        return joined

    def chunks(self, most: int = 240, least_s: float = 0.08) -> list[slice]:
        """Neighbouring segments in groups of even time.

        Args:
            most: number of groups.
            least_s: least time of a group, s.
        """
        if not self.times:
            return []
        span = max((self.times[-1] - self.times[0]) / most, least_s)
        group = [math.floor((t - self.times[0]) / span) for t in self.times]
        edges = [0, *(i for i in range(1, len(group)) if group[i] != group[i - 1]), len(group)]
        return [slice(a, b) for a, b in pairwise(edges)]
