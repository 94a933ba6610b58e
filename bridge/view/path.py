"""The contact's path as segments: thinned, lifted off the surface, cut into chunks by time, and drawn by viser.

In the browser each stretch of it is a node, so that a growing path is not sent again and again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from canprobe.cell.scene.setup import Scan
from canprobe.cell.tasks.task import Phase
from canprobe.lab.bridge.view.colours import Colours, scale
from canprobe.mechanics.touch.shapes import PlacedShape
from canprobe.mechanics.touch.strategies import Rectangle
from canprobe.mechanics.types import Floats

SPACING_M = 4e-4
"""Distance between two drawn points of the path, m."""
LIFT_M = 6e-4
"""Distance of the path from the surface along the normal, m, so that the surface does not hide it."""
GAP_M = 8e-3
"""Distance of two contacts above which they are not joined, m: the probe was lifted between them."""
OFF_PATH = (Phase.APPROACH, Phase.RETREAT, Phase.DONE)
"""Phases whose contacts are not points of the path."""
EXPLORED_TARGETS = 4.0
"""Deviation of the last colour of an exploration, in targets."""
PATH, AHEAD = (40, 44, 52), (214, 94, 0)
THICKNESS_M = 4e-4
STRETCH = 150
"""Number of segments in one node of a live path."""
SHARE, LEAST_PER_M, UNCERTAIN_PER_M = 0.05, 0.5, 2.0


@dataclass(frozen=True, slots=True)
class DeviationScale:
    """Scale of the colours of the recovered surface.

    Attributes:
        high: value of the last colour; the first is 0.
        text: name of the coloured quantity with its unit, for a legend.
        of_height: it is the deviation of the height, in µm; else of the curvature, in 1/m.
    """

    high: float
    text: str
    of_height: bool = False

    def colours(self, values: Floats) -> Colours:
        """Colours (n, 3) of values (n,): bright for a small deviation, grey where a value is not finite."""
        return scale(self.high - np.asarray(values), 0.0, self.high)


def deviation_scale(shape: PlacedShape | None, scan: Scan | None) -> DeviationScale:
    """Up to five per cent of the object's curvature; up to 2 1/m where no object is known.

    Of an exploration the height's deviation, up to some times the target.

    Args:
        shape: the true object, or None.
        scan: the scan that is shown, if any.
    """
    if scan is not None and isinstance(scan.strategy, Rectangle):
        high = EXPLORED_TARGETS * 1e6 * scan.strategy.target_sigma
        return DeviationScale(high, "deviation of the height, without tool and arm (µm)", of_height=True)
    high = UNCERTAIN_PER_M
    if shape is not None:
        kappa = shape.closest(shape.T_base_object[:3, 3]).kappa
        high = max(SHARE * float(np.linalg.norm(kappa)), LEAST_PER_M)
    return DeviationScale(high, "stated deviation of K (1/m)")


class Trail:
    """Collects contacts into segments."""

    def __init__(self) -> None:
        self._last: Floats = np.full(3, np.inf)  # no contact is joined to it
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


class Parts:
    """Nodes of viser's scene that appear one after the other."""

    def __init__(self) -> None:
        self._starts: list[float] = []
        self._nodes: list[Any] = []
        self._shown = 0

    def add(self, t_s: float, node: Any) -> None:
        """Add a hidden node that appears at an instant, s, no earlier than those before."""
        self._starts.append(t_s)
        self._nodes.append(node)

    def until(self, t_s: float) -> None:
        """Show the nodes that have appeared by an instant, and hide the others."""
        wanted = int(np.searchsorted(self._starts, t_s, side="right"))
        low, high = sorted((self._shown, wanted))
        for node in self._nodes[low:high]:
            node.visible = wanted > self._shown
        self._shown = wanted


class LoadedPath(Parts):
    """A whole recorded path, shown up to an instant.

    Args:
        api: viser's scene.
        trail: path of the contact in the run.
    """

    def __init__(self, api: Any, trail: Trail) -> None:
        super().__init__()
        for number, chunk in enumerate(trail.chunks()):
            self.add(trail.times[chunk.start], _add(api, f"/path/{number:03d}", trail, chunk, visible=False))


class GrowingPath:
    """A path that grows while the cell runs.

    Args:
        api: viser's scene.
        trail: path that the owner extends.
    """

    def __init__(self, api: Any, trail: Trail) -> None:
        self._api, self._trail = api, trail
        self._sent = 0

    def refresh(self) -> None:
        """Send the new segments."""
        while self._sent < len(self._trail):
            number = self._sent // STRETCH  # of the last stretch, which is sent again while it grows
            self._sent = min((number + 1) * STRETCH, len(self._trail))
            _add(self._api, f"/path/{number:04d}", self._trail, slice(number * STRETCH, self._sent), visible=True)


class PathAhead:
    """The path ahead of an exploration, which is drawn anew where it changes.

    Args:
        api: viser's scene.
    """

    def __init__(self, api: Any) -> None:
        self._api = api
        self._new: Floats | None = None

    def take(self, points: Floats) -> None:
        """Take the points (n, 3) of the path ahead, m."""
        self._new = points

    def refresh(self) -> None:
        """Send it if it has changed."""
        points, self._new = self._new, None
        if points is not None and len(points) > 1:
            segments = np.stack([points[:-1], points[1:]], axis=1).astype(np.float32)
            self._api.add_line_segments(
                "/ahead", segments, AHEAD, thickness=2.0 * THICKNESS_M, thickness_units="world", visible=True
            )


def _add(api: Any, name: str, trail: Trail, chunk: slice, *, visible: bool) -> Any:
    return api.add_line_segments(
        name, np.array(trail.segments[chunk], np.float32), PATH, thickness=THICKNESS_M, thickness_units="world",
        visible=visible,
    )  # fmt: skip
