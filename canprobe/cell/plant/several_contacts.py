"""A ball that touches in several places at once: the force of each, and their sum.

A point of a smooth surface presses as in ``contact``. A piece of an edge of radius r presses as a long cylinder:
``(4/3) k depth^1.5 / sqrt(A)`` a metre, A = (1/R + 1/r) / 2; summed along an edge that is shorter than the ball is
wide it gives the law of the point again.
"""

from __future__ import annotations

import numpy as np

from canprobe.mechanics.touch.shapes import TouchedPlaces
from canprobe.mechanics.types import Floats

MIN_CURVATURE_SHARE = 1e-2
"""Least curvature of the gap, as a share of the ball's: a tighter hollow counts as a hollow that leaves this much."""
NEAR_M = 2e-3
"""Gaps wider than this cannot close within a cycle of the cell."""


def widened(kappa: Floats, radius: float) -> Floats:
    """Curvatures of a surface, hollows as tight as the ball replaced by the least that the laws can take.

    Args:
        kappa: (..., 2) 1/m.
        radius: radius of the ball, m.
    """
    return np.maximum(kappa, (MIN_CURVATURE_SHARE - 1.0) / radius)


def force_laws(touches: TouchedPlaces, radius: float, stiffness_n_m3: float) -> tuple[Floats, Floats]:
    """Coefficient and exponent of ``force = coefficient depth^exponent`` of every place.

    Args:
        touches: n places.
        radius: radius of the ball, m.
        stiffness_n_m3: stiffness of its layer.

    Returns:
        (n,) in N and m, and (n,).
    """
    A, B = (0.5 * (1.0 / radius + widened(touches.kappa, radius))).T
    edge = touches.edge_m > 0.0
    point = 0.5 * np.pi * stiffness_n_m3 / np.sqrt(A * B)
    line = 4.0 / 3.0 * stiffness_n_m3 * touches.edge_m / np.sqrt(A)
    return np.where(edge, line, point), np.where(edge, 1.5, 2.0)


def total_force(touches: TouchedPlaces, radius: float, stiffness_n_m3: float, rates: Floats, damping: float) -> Floats:
    """(3,) sum of the forces on the ball, N.

    Args:
        touches: n places.
        radius: radius of the ball, m.
        stiffness_n_m3: stiffness of its layer.
        rates: (n,) of indentation, m/s.
        damping: Hunt-Crossley alpha, s/m.
    """
    coefficient, exponent = force_laws(touches, radius, stiffness_n_m3)
    depth = np.maximum(radius - touches.distances, 0.0)
    force = coefficient * depth**exponent * np.maximum(0.0, 1.0 + 1.5 * damping * rates)
    total: Floats = force @ touches.normals
    return total
