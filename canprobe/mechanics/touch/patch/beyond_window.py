"""What a window cuts off the contact patch: carried on from what is in it.

A window of 8 × 8 taxels cuts the patch of a soft contact, and force and centroid read wrong by what is outside. On a
bed of springs the pressure falls off from its summit as a quadratic does, so that the rest of the patch follows from
the part that is seen: a quadratic is fitted to the well pressed taxels and read off outside the window where it is
above zero. Of the emulated array the force is then 2 % low at 4 kN/m instead of 3–11 %, and the centroid 0.09 mm off
instead of 0.2–0.4 mm. Stops being true where the curvature of the object changes within the patch.
Source: Johnson, Contact Mechanics (1985), 4.3, the elastic foundation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.linalg.lapack import dposv

from canprobe.mechanics.types import Floats

MAX_EDGE_SHARE = 0.1
"""Share of the peak at the window's edge up to which a patch ends within the next taxel."""
MIN_PEAK_RATIO = 3
"""Highest count over the threshold up to which whole counts and noise hide the shape: what creep leaves of a long press
was carried on to up to five times its force."""
MIN_FITTED_SHARE = 0.2
"""Share of the peak below which a taxel is left out of the fit: blur and threshold bend the rim."""
MIN_FITTED_TAXELS = 12
"""Twice the six unknowns."""
MIN_FALL_SHARE = 0.3
"""Share of the peak by which the pressure must fall over half the pad in every direction: else it is no patch."""


class Continuation:
    """Carries on what a window of one array cuts off.

    Args:
        weights: (n², 6) area of each taxel × (1, u, v, uu, uv, vv), the place in any unit.
        saturated_pa: pressure from which on a taxel says no more than that, and is left out of the fit.
    """

    def __init__(self, weights: Floats, saturated_pa: float) -> None:
        self._saturated_pa = saturated_pa
        self._weights = weights
        self._area = weights[:, 0].copy()
        self._terms = weights / weights[:, :1]
        self._corner = float(self._terms[-1, 3])

    def completed(self, pressure: Floats, window: Sequence[int], peak_pa: float) -> Floats:
        """The pressures of the whole pad, those outside the window carried on from those inside.

        Args:
            pressure: (n, n) of the taxels, Pa; 0 outside the window.
            window: first row, first column, rows, columns.
            peak_pa: the highest of them.

        Returns:
            A filled copy; the same array where the taxels show no quadratic with a summit.
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
