"""How much less certain curvature is beyond the forces of a calibration and the speeds of the settings."""

from __future__ import annotations

import math

BEYOND_FACTOR = 0.6
"""Growth of the standard deviations with the logarithm of a force or a speed over the greatest one that is known: from
scans of spheres and planes with 5 to 15 N, and from 37 scans of a development draw with 40 to 100 mm/s."""
FASTEST_M_S = 0.04
"""Greatest speed of the scans from which settings were taken, m/s."""


def beyond_factor(beyond: float, speed: float) -> float:
    """Factor of the standard deviations of curvature for a `ForceErrors.beyond`, and a speed of the contact, m/s."""
    return (1.0 + BEYOND_FACTOR * beyond) * (1.0 + BEYOND_FACTOR * math.log(max(speed / FASTEST_M_S, 1.0)))
