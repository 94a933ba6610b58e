"""How far apart lanes may lie: the deviation of the height between parallel lanes, and beside the outermost one.

A place has a quadric h = [1, x, y, x²/2, xy, y²/2]·a. A millimetre of path at (x, y) from it shows a height and two
slopes, with the noise of the map (`MapNoise`, path per independent sample included):

    height   [1, x, y, x²/2 + c, xy, y²/2 + c]·a      σ² = σ_h² λ_h/ds + (g r³/6)²
    slopes   [0, 1, 0, x, y, 0]·a, [0, 0, 1, 0, x, y]·a   σ² = σ_n² λ_n/ds + (g r²/2)²

c = (d/4)/(1/R_p) is how the depth of the layer depends on the curvature: one straight lane shows a height only to 0.1
mm, and a second one beside it makes both known. g is the change of the curvature, which a quadric leaves out. Nothing
else here depends on what was found.

Why not the quartics of the map: their evidence depends on what will be found. What is known is stated by the map.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from canprobe.mechanics.touch.map.noise import MapNoise
from canprobe.mechanics.touch.map.quartic import CURVATURE_SIGMA, HEIGHT_SIGMA_M, SLOPE_SIGMA, USUAL_CHANGE
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
        r2, c, zero, one = x * x + y * y, self._coupling, np.zeros_like(x), np.ones_like(x)
        height = np.stack([one, x, y, 0.5 * x * x + c, x * y, 0.5 * y * y + c], axis=1)
        slope_x, slope_y = (
            np.stack([zero, one, zero, x, y, zero], axis=1),
            np.stack([zero, zero, one, zero, x, y], axis=1),
        )
        height /= np.sqrt(self._height2 + (change / 6.0) ** 2 * r2**3)[:, None]
        rows = (
            np.concatenate([slope_x, slope_y])
            / np.sqrt(self._slope2 + (change / 2.0) ** 2 * np.tile(r2, 2) ** 2)[:, None]
        )
        information = _PRIOR + height.T @ height + rows.T @ rows
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
