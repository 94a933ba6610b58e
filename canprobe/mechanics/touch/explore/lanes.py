"""Lanes along the sides of a rectangle, from its border inwards, until the lanes of opposite sides meet.

Contour-parallel coverage, as pockets are milled. Side k = 0 … 3 is walked in the direction of k quarter turns, so that
what is not known lies to the left; a quarter turn leads from a lane to the next. What lies between two opposite sides
is divided evenly, with each lane anew, by the spacing that holds then. An edge moves the border. Why not lanes to and
fro: between two lanes, on the side where no turn joins them, the border is left untouched.

How far apart lanes may lie follows from the deviation of the height between parallel lanes, and beside the outermost
one (`LaneForecast`). A place has a quadric h = [1, x, y, x²/2, xy, y²/2]·a. A millimetre of path at (x, y) from it
shows a height and two slopes, with the noise of the map (`MapNoise`, path per independent sample included):

    height   [1, x, y, x²/2 + c, xy, y²/2 + c]·a      σ² = σ_h² λ_h/ds + (g r³/6)²
    slopes   [0, 1, 0, x, y, 0]·a, [0, 0, 1, 0, x, y]·a   σ² = σ_n² λ_n/ds + (g r²/2)²

c = (d/4)/(1/R_p) is how the depth of the layer depends on the curvature: one straight lane shows a height only to 0.1
mm, and a second one beside it makes both known. g is the change of the curvature, which a quadric leaves out. Nothing
else there depends on what was found. Why not the quartics of the map: their evidence depends on what will be found.
What is known is stated by the map.

Source: Held, "On the computational geometry of pocket machining", 1991.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from canprobe.mechanics.touch.explore.stretches import Heading
from canprobe.mechanics.touch.map.noise import MapNoise
from canprobe.mechanics.touch.map.quartic import CURVATURE_SIGMA, HEIGHT_SIGMA_M, SLOPE_SIGMA, USUAL_CHANGE, terms
from canprobe.mechanics.touch.map.surface_map import REACH_M
from canprobe.mechanics.types import Floats

LATERAL_SHARE = 0.62
"""Share of the lateral error of a contact that turns its normal."""
DISTANCES_M: tuple[float, ...] = tuple(1e-3 * mm for mm in np.arange(2.0, 1e3 * REACH_M, 0.25).tolist())
"""Distances from a lane that are compared, m: less than the reach of the map, behind which it has no surface."""
MAX_MARGIN_M = 3e-3
"""Largest distance from a lane to a border, m: the corner too, which the turn rounds off, is within the map's reach."""
_ALONG = 1e-3 * np.arange(-12.0, 13.0)
_PRIOR = np.diag(np.array([HEIGHT_SIGMA_M, SLOPE_SIGMA, SLOPE_SIGMA, *(3 * [CURVATURE_SIGMA])]) ** -2.0)


class Spacing(NamedTuple):
    """Largest distances, m: `gap` between two parallel lanes, `margin` from the outermost lane to a border."""

    gap: float
    margin: float


class LaneForecast:
    """The deviation of the height beside lanes that are not walked yet.

    Args:
        radius: radius of the probe, m.
        depth: depth of the layer at the wanted force, m.
        noise: noise of the contacts.
    """

    def __init__(self, radius: float, depth: float, noise: MapNoise) -> None:
        step = float(_ALONG[1] - _ALONG[0])
        self._coupling = 0.25 * depth * radius
        self._height2 = noise.height**2 * noise.height_path / step
        slope2 = (LATERAL_SHARE * noise.lateral / radius) ** 2 + noise.normal**2
        self._slope2 = slope2 * noise.normal_path / step

    def sigma(self, lanes: Floats, change: float) -> float:
        """Deviation of the height, m, at a place beside parallel lanes.

        Args:
            lanes: (n,) distances of the lanes from the place, m.
            change: usual change of the curvature, 1/m².
        """
        x, y = (one.ravel() for one in np.meshgrid(_ALONG, lanes, indexing="ij"))
        rows = np.stack(terms(x, y, (0, 0), (1, 0), (0, 1)))[..., : len(_PRIOR)]
        rows[0][:, [3, 5]] += self._coupling
        r2 = x * x + y * y
        slope2 = self._slope2 + (change / 2.0) ** 2 * r2**2
        rows /= np.sqrt([self._height2 + (change / 6.0) ** 2 * r2**3, slope2, slope2])[..., None]
        information = _PRIOR + np.einsum("kni,knj->ij", rows, rows)
        return float(np.sqrt(np.linalg.inv(information)[0, 0]))

    def spacing(self, sigma: float, change: float) -> Spacing:
        """Spacing of lanes between and beside which the deviation of the height is at most `sigma`, m.

        Ground that looks smoother than usual is taken as usual: then the map states as much as was forecast.
        """
        change = max(change, USUAL_CHANGE)
        lattice = np.array([-3.0, -1.0, 1.0, 3.0])
        half = _longest(lambda distance: self.sigma(distance * lattice, change), sigma)
        outside = 2.0 * half * np.arange(3.0)
        margin = _longest(lambda distance: self.sigma(distance + outside, change), sigma)
        return Spacing(2.0 * half, min(margin, MAX_MARGIN_M))


def _longest(deviation: Callable[[float], float], sigma: float) -> float:
    """The longest of `DISTANCES_M` at which a deviation that grows with it is within `sigma`; at least the shortest."""
    return DISTANCES_M[max(bisect_right(DISTANCES_M, sigma, key=deviation) - 1, 0)]


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
        return max(math.ceil((width - shown) / spacing.gap - 1e-9), 0)  # rounding must not add a lane

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
