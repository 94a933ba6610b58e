"""Forecast of what a path will show: the deviation of the height in every cell, before and after it is walked.

Each cell has a quadric over the scan plane, h = [1, x, y, x²/2, xy, y²/2]·a, and its information Λ. A millimetre of
path at (x, y) from the cell's middle adds a height and two slopes, with the noise of the map (`MapNoise`, path per
independent sample included):

    height   [1, x, y, x²/2 + c, xy, y²/2 + c]·a      σ² = σ_h² λ_h/ds + (g r³/6)²
    slopes   [0, 1, 0, x, y, 0]·a, [0, 0, 1, 0, x, y]·a   σ² = σ_n² λ_n/ds + (g r²/2)²

c = (d/4)/(1/R_p) is how the depth of the layer depends on the curvature: one straight line shows a height only to 0.1
mm, and a second one beside it makes both known. g is what a quadric leaves out. The variance of the height is
(Λ⁻¹)₀₀. It depends on where the path goes and not on what is found there, so it is known in advance.

Why not the quartics of the map: their evidence depends on what will be found, and one path would cost as much as the
whole map. The forecast only ranks paths; what is known is stated by the map.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from canprobe.mechanics.touch.explore.stretches import STEP_M
from canprobe.mechanics.touch.map.noise import MapNoise
from canprobe.mechanics.touch.map.quartic import CURVATURE_SIGMA, HEIGHT_SIGMA_M, SLOPE_SIGMA, USUAL_CHANGE
from canprobe.mechanics.types import Floats

LATERAL_SHARE = 0.62
"""Share of the lateral error of a contact that turns its normal."""
UNKNOWN_M = 1e-3
"""Deviation of the height where nothing was touched, m: more says nothing about where to go."""
_PRIOR = np.diag(np.array([HEIGHT_SIGMA_M, SLOPE_SIGMA, SLOPE_SIGMA, *(3 * [CURVATURE_SIGMA])]) ** -2.0)


class Forecast:
    """Information about every cell of a rectangle.

    Args:
        places: (m, 2) middles of the cells in the scan plane, m.
        radius: radius of the probe, m.
        depth: depth of the layer at the wanted force, m.
        noise: noise of the contacts.
    """

    def __init__(self, places: Floats, radius: float, depth: float, noise: MapNoise) -> None:
        self._places = places
        self._coupling = 0.25 * depth * radius
        slope2 = (LATERAL_SHARE * noise.lateral / radius) ** 2 + noise.normal**2
        self._height2 = noise.height**2 * noise.height_path / STEP_M
        self._slope2 = slope2 * noise.normal_path / STEP_M
        self._information = np.tile(_PRIOR, (len(places), 1, 1))
        self.variance = _variance(self._information)

    def walk(self, x: float, y: float) -> None:
        """Take a millimetre of path that was walked at a place of the scan plane, m."""
        self._information += self._shown(np.array([[x, y]]), slice(None))[0]
        self.variance = _variance(self._information)

    def after(self, points: Floats, before: Floats, counts: list[int], which: NDArray[np.intp]) -> Floats:
        """(k, m') variances of the height, m², of some cells after each of k beginnings of a path.

        Args:
            points: (n, 2) places of the path, a step apart, m.
            before: (l, 2) places that will be walked before, m.
            counts: number of points of each beginning, growing.
            which: (m',) indices of the cells.
        """
        begun = (
            self._information[which] + self._shown(before, which).sum(axis=0)
            if len(before)
            else (self._information[which])
        )
        shown = np.cumsum(self._shown(points, which), axis=0)[np.array(counts) - 1]
        return _variance(begun + shown)

    def _shown(self, points: Floats, which: NDArray[np.intp] | slice) -> Floats:
        """(n, m', 6, 6) information of a millimetre of path at each point (n, 2) about some cells."""
        places = self._places[which]
        d = points[:, None] - places
        x, y = d[..., 0], d[..., 1]
        r2 = x * x + y * y
        c, zero, one = self._coupling, np.zeros_like(x), np.ones_like(x)
        height = np.stack([one, x, y, 0.5 * x * x + c, x * y, 0.5 * y * y + c], axis=-1)
        slopes = np.stack([zero, one, zero, x, y, zero], axis=-1), np.stack([zero, zero, one, zero, x, y], axis=-1)
        weight = 1.0 / (self._height2 + (USUAL_CHANGE / 6.0) ** 2 * r2**3)
        found: Floats = weight[..., None, None] * height[..., :, None] * height[..., None, :]
        weight = 1.0 / (self._slope2 + (USUAL_CHANGE / 2.0) ** 2 * r2**2)
        for row in slopes:
            found += weight[..., None, None] * row[..., :, None] * row[..., None, :]
        return found


def _variance(information: Floats) -> Floats:
    """(…) variance of the height of quadrics with information (…, 6, 6), m², no larger than where nothing is known."""
    scale = np.array([1.0, 1e3, 1e3, 1e6, 1e6, 1e6])  # metres to units in which all are of one size
    scaled = information * np.outer(scale, scale)
    first = np.zeros((*information.shape[:-1], 1))
    first[..., 0, 0] = 1.0
    result: Floats = np.minimum(np.linalg.solve(scaled, first)[..., 0, 0], UNKNOWN_M**2)
    return result
