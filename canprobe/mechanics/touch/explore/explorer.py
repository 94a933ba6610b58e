"""The explorer: it leads the contact along a stretch, and meanwhile looks for the next one.

The next stretch begins where the present one ends, with its direction, so that the heading never jumps. Of the paths
that `fan` offers, and the room allows, it is the beginning that gains most for its length: the gain of a path is the
sum over all cells of ½ ln of the variance before over that after, down to the goal of the cell, so that a cell which is
done counts nothing. Where no path gains anything, the contact goes to the cell that is farthest from its goal.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator

import numpy as np

from canprobe.mechanics.touch.explore.forecast import Forecast
from canprobe.mechanics.touch.explore.ground import GroundCells
from canprobe.mechanics.touch.explore.stretches import STEP_M, Heading, Room, Stretch, WalkedBack, fan
from canprobe.mechanics.touch.strategies import PathFollower
from canprobe.mechanics.types import Floats

SIGHT_M = 10e-3
"""Distance from a path at which it tells nothing any more, m."""
BEGINNINGS_M = (6e-3, 10e-3, 15e-3, 20e-3, 27e-3, 36e-3)
"""Lengths of a path that are compared, m; shorter ones are not worth a decision."""
BACK_M = 5e-3
"""Path that is walked back from an edge, m."""
CLOSED_M, CLEARANCE_M = 4e-3, 2e-3
"""Radius of the ground that an edge closes, and the distance that paths keep from the middle of a closed cell, m."""
EDGE_M, EDGE_RAD, EDGE_SHARE = 4e-3, 0.1, 0.85
"""An edge, round which the probe turns: within this path, m, the normal turns by more than this angle, and the contact
has moved, or the force is, less than this share of what it should. On a sharp ridge contact and force keep up."""
LEAST_GAIN = 0.05
"""Gain of a path, in units of ln σ, that is none."""


class Explorer(PathFollower):
    """Leads the servo over a rectangle.

    Args:
        ground: cells of the rectangle, with what is known.
        forecast: forecast for the same cells.
        size: length and width of the rectangle, m.
        radius: smallest radius of a turn, m.
        ahead: path before the end of a stretch at which the next one is looked for, m.
        lag: path by which a measured contact lies behind the place that it is led to, m.

    Attributes:
        ground: as given.
        path: path that was walked, m.
        stretch, upcoming: present stretch, and the next one where it is known.
    """

    def __init__(
        self,
        ground: GroundCells,
        forecast: Forecast,
        size: tuple[float, float],
        *,
        radius: float,
        ahead: float,
        lag: float,
    ) -> None:
        self.ground, self.path = ground, 0.0
        self._forecast, self._radius, self._ahead, self._lag = forecast, radius, ahead, lag
        self._room = Room(size, radius)
        self.upcoming: Stretch | None = None
        self._search: Iterator[Stretch] | None = None
        self._best: Stretch | None = None
        self._rate = 0.0
        self._walked: deque[tuple[float, float]] = deque(maxlen=round(3.0 * BACK_M / STEP_M))
        self._lately: deque[tuple[float, tuple[float, float], tuple[float, float], Floats]] = deque()
        self._force_share = 1.0
        self._led: deque[tuple[float, tuple[float, float]]] = deque([(0.0, (0.0, 0.0))])
        first = Stretch(Heading(0.0, 0.0, 0.0), 0.0, radius, 8e-3)
        self._follow(first.cut(max(self._room.reach(first), STEP_M)))

    def _follow(self, stretch: Stretch | WalkedBack) -> None:
        super().__init__(stretch)
        self.stretch, self._left = stretch, stretch.length
        self.upcoming, self._search = None, None

    @property
    def going_back(self) -> bool:
        """Whether it walks back from an edge."""
        return isinstance(self.stretch, WalkedBack)

    def step(self, x: float, y: float, distance_m: float) -> tuple[float, float]:
        """Unit heading (along, across) for the next step; arguments as for `PathFollower`."""
        if self._left <= 0.0:
            self._follow(self.upcoming or self._best or self._room.circle(self.stretch.at(self.stretch.length)))
        self._left -= distance_m
        self.path += distance_m
        self._led.append((self.path, (x, y)))
        return super().step(x, y, distance_m)

    def ahead(self, count: int) -> Floats:
        """(count, 2) places that it will lead to, evenly over the rest of its stretch and the next, m."""
        rest, upcoming = max(self._left, 0.0), self.upcoming
        total = rest + (upcoming.length if upcoming is not None else 0.0)
        places = []
        for way in np.linspace(0.0, total, count).tolist():
            if way <= rest or upcoming is None:
                places.append(self.stretch.point(self.stretch.length - rest + way))
            else:
                places.append(upcoming.point(way - rest))
        return np.array(places)

    def walk(self, point: Floats, normal: Floats, force_share: float) -> None:
        """Take a contact of the path.

        Args:
            point: its point (3,), m.
            normal: outward unit normal there (3,).
            force_share: its force over the wanted one.
        """
        here = x, y = self.ground.in_plane(point)
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
            self._forecast.walk(x, y)

    @property
    def at_edge(self) -> bool:
        """Whether the probe turns round an edge."""
        if not self._lately:
            return False
        (_, led, touched, normal), (_, leads, touches, now) = self._lately[0], self._lately[-1]
        turned = math.acos(min(1.0, float(normal @ now)))
        moved = math.dist(touched, touches) / max(math.dist(led, leads), STEP_M)
        return turned > EDGE_RAD and min(moved, self._force_share) < EDGE_SHARE

    def turn_back(self, *, without: float = 0.0) -> None:
        """Go back on the path that was walked: the ground ahead cannot be touched.

        Args:
            without: length of its end that has been gone back already, m.
        """
        along, across = self.heading
        x, y = self._walked[-1] if self._walked else self._led[-1][1]
        self.ground.close(x + CLOSED_M * along, y + CLOSED_M * across, CLOSED_M)
        self._room.close(self.ground.places[self.ground.closed], CLEARANCE_M)
        walked = list(self._walked)
        skipped = round(without / STEP_M)
        back = walked[:-skipped] if skipped else [*walked, self._led[-1][1]]
        self._lately.clear()
        self._follow(WalkedBack(back[-round(BACK_M / STEP_M) - 1 :] or [self._led[-1][1]]))

    def work(self) -> None:
        """One share of the work: judge one path where a stretch is due, else fit one cell."""
        if self.upcoming is None and self._left < self._ahead:
            if self._search is None:
                self._search, self._best, self._rate = self._paths(), None, 0.0
            if (stretch := next(self._search, None)) is not None:
                self._judge(stretch)
            else:
                self.upcoming = self._best
        else:
            self.ground.fit_one()

    def _paths(self) -> Iterator[Stretch]:
        start, ground = self.stretch.at(self.stretch.length), self.ground
        beyond = np.where(ground.closed, 0.0, ground.sigma / ground.goal)
        worst = beyond >= 0.999 * beyond.max()
        apart = np.hypot(ground.places[:, 0] - start.x, ground.places[:, 1] - start.y)
        target = ground.places[int(np.where(worst, apart, math.inf).argmin())]
        return fan(start, self._radius, (float(target[0]), float(target[1])))

    def _judge(self, stretch: Stretch) -> None:
        """Compare the beginnings of a path with the best so far; the first that there is goes without gain."""
        reach = self._room.reach(stretch)
        if reach < STEP_M:
            return
        stretch = stretch.cut(reach)
        if self._best is None:
            self._best = stretch
        ways = stretch.ways()
        points = np.array([stretch.point(way) for way in ways.tolist()])
        left = np.arange(0.0, max(self._left, 0.0), STEP_M)
        before = np.array([self.stretch.point(self.stretch.length - way) for way in left.tolist()]).reshape(-1, 2)
        ground = self.ground
        apart = np.linalg.norm(ground.places[:, None] - points, axis=2).min(axis=1)
        which = np.flatnonzero((apart < SIGHT_M) & ground.wanting)
        if not len(which):
            return
        lengths = [way for way in BEGINNINGS_M if way < reach] + [reach]
        counts = [max(1, round(way / STEP_M)) for way in lengths]
        variance = self._forecast.after(points, before, counts, which)
        shrunk = variance / self._forecast.variance[which]
        floor2, sigma2, goal2 = ground.floor[which] ** 2, ground.sigma[which] ** 2, ground.goal[which] ** 2
        after2 = np.maximum(floor2 + (sigma2 - floor2) * shrunk, goal2)
        gains = 0.5 * np.log(np.maximum(sigma2, goal2) / after2).sum(axis=1)
        for length, gain in zip(lengths, gains.tolist(), strict=True):
            beginning, rate = stretch.cut(length), gain / max(length, BEGINNINGS_M[0])
            if gain > LEAST_GAIN and rate > self._rate and self._room.reach(beginning) > length - 0.5 * STEP_M:
                self._best, self._rate = beginning, rate
