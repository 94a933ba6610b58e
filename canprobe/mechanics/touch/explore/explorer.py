"""The explorer: it leads the contact along a stretch, and meanwhile looks for the next one.

First it lays lanes (`InwardLanes`), each as far from what is known as the forecast allows for the change of the
curvature that the map has seen so far. Then it goes to the cells that are still above their goal, the nearest first.
The next stretch begins where the present one ends, with its direction, so that the heading never jumps.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator

import numpy as np

from canprobe.mechanics.touch.explore.ground import NEAR_FLOOR, GroundCells
from canprobe.mechanics.touch.explore.lanes import InwardLanes, LaneForecast, Spacing
from canprobe.mechanics.touch.explore.stretches import (
    STEP_M,
    Heading,
    Room,
    Stretch,
    WalkedBack,
    leading_to,
    stretches_to,
)
from canprobe.mechanics.touch.strategies import PathFollower
from canprobe.mechanics.types import Floats

SHOWN_M = 3e-3
"""Distance from the path ahead within which a cell counts as touched, m."""
NEAREST = 6
"""Number of cells above their goal among which the shortest way is taken."""
FIRST_M = 5e-3
"""Path towards the first lane, m, on which the contact gathers speed before that lane is laid."""
BACK_M = 5e-3
"""Path that is walked back from an edge, m."""
CLOSED_M = 4e-3
"""Radius of the ground that an edge closes, m."""
EDGE_M, EDGE_RAD, EDGE_SHARE = 4e-3, 0.1, 0.57
"""An edge, round which the probe turns: within this path, m, the normal turns by more than this angle, and the share of
the path that the contact has moved, times that of the wanted force that is left, is below this. Over a fillet of 22 mm
either falls to 0.75, and both recover; at the rim of a plate both fall on."""
ASTRAY_M = 1.75e-3
"""Distance of a contact from where it is led, m, that it has in a hollow only, where it jumps from wall to wall; on a
fillet of 22 mm it is 1.3 mm."""


class Explorer(PathFollower):
    """Leads the servo over a rectangle.

    Args:
        ground: cells of the rectangle, with what is known.
        forecast: forecast of the deviation beside lanes.
        size: length and width of the rectangle, m.
        start: place of the first contact in it, from its middle, m.
        radius: smallest radius of a turn, m.
        ahead: path before the end of a stretch at which the next one is looked for, m.
        lag: path by which a measured contact lies behind the place that it is led to, m.

    Attributes:
        ground: as given.
        path: path that was walked, m.
        stretch, upcoming: present stretch, and those behind it that are known.
    """

    def __init__(
        self,
        ground: GroundCells,
        forecast: LaneForecast,
        size: tuple[float, float],
        *,
        start: tuple[float, float],
        radius: float,
        ahead: float,
        lag: float,
    ) -> None:
        self.ground, self.path = ground, 0.0
        self._forecast, self._radius, self._ahead, self._lag = forecast, radius, ahead, lag
        self._room, self._lanes = Room(size, radius), InwardLanes(size, radius)
        self.upcoming: list[Stretch] = []
        self._search: Iterator[None] | None = None
        self._inner = 0.5 * np.array(size) - radius
        # more than is walked back at once: of its end a part may have been gone back already (`turn_back`)
        self._walked: deque[tuple[float, float]] = deque(maxlen=round(3.0 * BACK_M / STEP_M))
        self._lately: deque[tuple[float, tuple[float, float], tuple[float, float], Floats]] = deque()
        self._force_share = 1.0
        self._led: deque[tuple[float, tuple[float, float]]] = deque([(0.0, start)])
        to_corner = math.atan2(-0.5 * size[1] - start[1], -0.5 * size[0] - start[0])
        self._follow(Stretch(Heading(*start, to_corner), 0.0, radius, FIRST_M))

    def _follow(self, stretch: Stretch | WalkedBack) -> None:
        super().__init__(stretch)
        self.stretch, self._left = stretch, stretch.length
        self._search = None

    @property
    def going_back(self) -> bool:
        """Whether it walks back from an edge."""
        return isinstance(self.stretch, WalkedBack)

    def step(self, x: float, y: float, distance_m: float) -> tuple[float, float]:
        """Unit heading (along, across) for the next step; arguments as for `PathFollower`."""
        if self._left <= 0.0:
            self._follow(self.upcoming.pop(0) if self.upcoming else self._room.circle(self._end))
        self._left -= distance_m
        self.path += distance_m
        self._led.append((self.path, (x, y)))
        return super().step(x, y, distance_m)

    def ahead(self, count: int) -> Floats:
        """(count, 2) places that it will lead to, evenly over the rest of its stretch and the next, m."""
        rest = max(self._left, 0.0)
        parts = [(self.stretch, self.stretch.length - rest), *((one, 0.0) for one in self.upcoming)]
        ways = np.cumsum([0.0, *(one.length - begun for one, begun in parts)])
        places = []
        for way in np.linspace(0.0, ways[-1], count).tolist():
            k = min(int(np.searchsorted(ways, way, side="right")) - 1, len(parts) - 1)
            one, begun = parts[k]
            places.append(one.point(begun + way - float(ways[k])))
        return np.array(places)

    def walk(self, point: Floats, normal: Floats, force_share: float) -> None:
        """Take a contact of the path.

        Args:
            point: its point (3,), m.
            normal: outward unit normal there (3,).
            force_share: its force over the wanted one.
        """
        here = self.ground.in_plane(point)
        self._force_share = force_share
        while len(self._led) > 1 and self._led[0][0] < self.path - self._lag:
            self._led.popleft()
        self._lately.append((self.path, self._led[0][1], here, normal))
        while self.path - self._lately[0][0] > EDGE_M:
            self._lately.popleft()
        way = math.dist(here, self._walked[-1]) if self._walked else STEP_M
        if way >= STEP_M:
            self._walked.append(here)
            self.ground.walk(point, way)

    @property
    def at_edge(self) -> bool:
        """Whether the probe turns round an edge."""
        if not self._lately:
            return False
        (_, led, touched, normal), (_, leads, touches, now) = self._lately[0], self._lately[-1]
        turned = math.acos(min(1.0, float(normal @ now)))
        moved = math.dist(touched, touches) / max(math.dist(led, leads), STEP_M)
        return turned > EDGE_RAD and moved * self._force_share < EDGE_SHARE

    @property
    def astray(self) -> bool:
        """Whether the contact is not where it is led, as in a hollow as tight as the probe."""
        if not self._lately or self.going_back:
            return False
        _, leads, touches, _ = self._lately[-1]
        return math.dist(leads, touches) > ASTRAY_M

    def turn_back(self, *, without: float = 0.0) -> None:
        """Go back on the path that was walked: the ground ahead cannot be touched.

        Args:
            without: length of its end that has been gone back already, m.
        """
        along, across = self.heading
        x, y = self._walked[-1] if self._walked else self._led[-1][1]
        self._close(x + CLOSED_M * along, y + CLOSED_M * across, CLOSED_M)
        self._lanes.close(x, y, math.atan2(across, along))
        self.upcoming = []
        walked = list(self._walked)
        skipped = round(without / STEP_M)
        back = walked[:-skipped] if skipped else [*walked, self._led[-1][1]]
        self._lately.clear()
        self._follow(WalkedBack(back[-round(BACK_M / STEP_M) - 1 :] or [self._led[-1][1]]))

    def work(self) -> None:
        """One share of the work: look for the next stretch where one is due, else fit one cell."""
        if not self.upcoming and self._left < self._ahead:
            if self._search is None:
                self._search = self._look()
            next(self._search, None)
        else:
            self.ground.fit_one()

    @property
    def _end(self) -> Heading:
        return self.stretch.at(self.stretch.length)

    def _look(self) -> Iterator[None]:
        """Look for the stretches that follow, in shares: those of the next lane, else that to a cell near by."""
        while (lane := self._lanes.next(self._spacing())) is not None:
            yield
            for turn, line in stretches_to(self._end, lane.start, self._radius, lane.length):
                if self._room.holds(turn) and (reach := self._room.reach(line)) > 0.0:
                    self.upcoming = [turn, line.cut(reach)]
                    return
                yield
        for i in np.flatnonzero(self.ground.wanting & np.isfinite(self.ground.change)).tolist():
            self.ground.fit(i)  # a lane beside it, too far to make its fit stale, may have shown it
            yield
        best: tuple[bool, float, Stretch] | None = None
        nearest = self._nearest()
        for x, y in np.clip(nearest, -self._inner, self._inner).tolist():
            for side in (1.0, -1.0):
                if (way := leading_to(self._end, side, self._radius, (x, y))) is not None:
                    reach = self._room.reach(way)
                    arrives = reach > way.length - SHOWN_M
                    rated = arrives, -way.length if arrives else reach, way.cut(reach)
                    if reach > 0.0 and (best is None or rated[:2] > best[:2]):
                        best = rated
                yield
        if best is None or not best[0]:
            self._close_beside(nearest)
        if best is not None:
            self.upcoming = [best[2]]

    def _close_beside(self, places: Floats) -> None:
        """Close those places (k, 2), m, to which no way leads where they lie beside closed ground."""
        closed = self.ground.places[self.ground.closed]
        for x, y in places.tolist():
            if len(closed) and np.hypot(*(closed - (x, y)).T).min() < CLOSED_M:
                self._close(x, y, STEP_M)

    def _close(self, x: float, y: float, radius: float) -> None:
        self.ground.close(x, y, radius)
        self._room.closed = self.ground.places[self.ground.closed]

    def _spacing(self) -> Spacing:
        """The spacing of lanes for the change of curvature that the map has seen so far."""
        ground = self.ground
        seen = ground.change[np.isfinite(ground.change)]
        change = math.sqrt(float(np.mean(seen**2))) if len(seen) else 0.0
        # no lane shrinks what all heights of the scan have in common: lanes have the rest of the variance
        wanted2 = max(ground.target, NEAR_FLOOR * ground.common) ** 2 - ground.common**2
        return self._forecast.spacing(math.sqrt(wanted2), change)

    def _nearest(self) -> Floats:
        """(k, 2) places of the cells above their goal that are nearest to the end of the stretch, but not on it."""
        ground, end = self.ground, self._end
        left = np.arange(0.0, max(self._left, 0.0) + STEP_M, STEP_M)
        ahead = np.array([self.stretch.point(self.stretch.length - way) for way in left.tolist()])
        # what the rest of the stretch will show needs no way to it
        shown = np.linalg.norm(ground.places[:, None] - ahead, axis=2).min(axis=1) < SHOWN_M
        which = np.flatnonzero(ground.wanting & ~shown)
        apart = np.hypot(ground.places[which, 0] - end.x, ground.places[which, 1] - end.y)
        nearest: Floats = ground.places[which[apart.argsort()[:NEAREST]]]
        return nearest
