"""The part of a contact patch outside a window, extrapolated from the part inside.

A window of 8 × 8 taxels cuts the patch of a soft contact, and force and centroid are wrong by the part outside. On a
bed of springs the pressure is a quadratic function of the place, so the rest of the patch follows from the part that is
seen: a quadratic is fitted to the well pressed taxels and evaluated outside the window where it is above zero. On the
emulated array the force is then 2 % low at 4 kN/m instead of 3–11 %, and the centroid 0.09 mm off instead of 0.2–0.4
mm. It stops being true where the curvature of the object changes within the patch.
Source: Johnson, Contact Mechanics (1985), 4.3, the elastic foundation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.linalg.lapack import dposv

from canprobe.mechanics.types import Floats

MAX_EDGE_SHARE = 0.1
"""Largest pressure at the window's edge, over the peak, of a patch that ends within the next taxel."""
MIN_PEAK_RATIO = 3
"""Peak count over the threshold that must be exceeded for an extrapolation. Below it whole counts and noise hide the
shape: the trace that creep leaves of a long press was extrapolated to up to five times its force."""
MIN_FITTED_SHARE = 0.2
"""Least pressure of a taxel in the fit, over the peak: blur and threshold bend the rim."""
MIN_FITTED_TAXELS = 12
"""Least number of taxels in the fit: twice the six unknowns."""
MIN_FALL_SHARE = 0.3
"""Least fall of the pressure over half the pad, over the peak, in every direction; with less there is no patch."""


class Continuation:
    """Extrapolates the pressure beyond the windows of one array.

    Args:
        weights: (n², 6) area of each taxel × (1, u, v, uu, uv, vv), the place in any unit.
        saturated_pa: pressure of a saturated taxel, Pa, which is left out of the fit.
    """

    def __init__(self, weights: Floats, saturated_pa: float) -> None:
        self._saturated_pa = saturated_pa
        self._weights = weights
        self._area = weights[:, 0].copy()
        self._terms = weights / weights[:, :1]
        self._corner = float(self._terms[-1, 3])

    def completed(self, pressure: Floats, window: Sequence[int], peak_pa: float) -> Floats:
        """The pressures of the whole pad, those outside the window extrapolated from those inside.

        Args:
            pressure: (n, n) pressures of the taxels, Pa; 0 outside the window.
            window: first row, first column, rows, columns.
            peak_pa: highest of the pressures, Pa.

        Returns:
            A completed copy (n, n), Pa; the same array where the taxels do not fit a quadratic with a summit.
        """
        row, column, rows, columns = window
        width = pressure.shape[1]
        strip = slice(width * row, width * (row + rows))  # the rows of the window: all else is 0
        seen = pressure.reshape(-1)[strip]
        used = (seen >= MIN_FITTED_SHARE * peak_pa) & (seen < self._saturated_pa)
        if np.count_nonzero(used) < MIN_FITTED_TAXELS:
            return pressure
        weights = self._weights[strip]
        used_weights = (weights * used[:, None]).T
        _, quadratic, singular = dposv(used_weights.dot(weights), used_weights.dot(self._area[strip] * seen))
        _, _, _, uu, uv, vv = quadratic.tolist()
        least_fall = -0.5 * (uu + vv + math.hypot(uu - vv, uv)) * self._corner
        if singular or not least_fall > MIN_FALL_SHARE * peak_pa:
            return pressure
        whole: Floats = np.maximum(self._terms.dot(quadratic), 0.0).reshape(pressure.shape)
        inside = slice(row, row + rows), slice(column, column + columns)
        whole[inside] = pressure[inside]
        return whole
