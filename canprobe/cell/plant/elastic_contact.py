"""Laws of the probe's elastic layer on a surface of known curvature, in one place and in several at once.

Model: a thin elastic layer (Winkler) on a rigid sphere against a rigid body, no friction:
``p = k (d - A x^2 - B y^2)`` where positive, with ``A = (1/R_p + kappa1) / 2``, ``B = (1/R_p + kappa2) / 2``.
It stops being true where the patch is no longer small against both radii. A piece of an edge of radius r presses as a
long cylinder: ``(4/3) k d^1.5 / sqrt(A)`` a metre, A = (1/R_p + 1/r) / 2; summed along an edge that is shorter than the
ball is wide it gives the law of the point again.
"""

from __future__ import annotations

from math import pi, sqrt
from typing import NamedTuple

import numpy as np

from canprobe.mechanics.touch.shapes import TouchedPlaces
from canprobe.mechanics.types import Floats

MIN_CURVATURE_SHARE = 1e-2
"""Least curvature of the gap, as a share of the ball's: a tighter hollow counts as a hollow that leaves this much."""
NEAR_M = 2e-3
"""Gaps wider than this cannot close within a cycle of the cell."""


class Indentation(NamedTuple):
    """The contact of an indentation.

    Attributes:
        force: N, never negative (never adhesive).
        damping_factor: factor of force and pressure due to the rate of indentation, >= 0.
    """

    force: float
    damping_factor: float = 1.0


NO_CONTACT = Indentation(0.0)


def relative_curvatures(kappa: tuple[float, float], radius: float) -> tuple[float, float]:
    """A and B of the gap ``A x^2 + B y^2`` between probe and body.

    Args:
        kappa: principal curvatures of the body, 1/m, larger first, positive for convex.
        radius: probe radius, m.

    Returns:
        A >= B > 0, 1/m.

    Raises:
        ValueError: the hollow is as tight as the probe: the contact is then not one small patch.
    """
    A, B = 0.5 * (1.0 / radius + kappa[0]), 0.5 * (1.0 / radius + kappa[1])
    if B <= 0.0:
        raise ValueError(
            f"hollow of radius {-1e3 / kappa[1]:.2f} mm is not wider than the probe ({1e3 * radius:.2f} mm)"
        )
    return A, B


def elastic_contact(
    depth: float,
    kappa: tuple[float, float],
    radius: float,
    stiffness_n_m3: float,
    *,
    depth_rate: float = 0.0,
    damping: float = 0.0,
) -> Indentation:
    """Force of an indentation.

    Args:
        depth: indentation, m; <= 0 is no contact.
        kappa: principal curvatures of the body, 1/m, larger first, positive for convex.
        radius: probe radius, m.
        stiffness_n_m3: layer modulus over thickness, N/m^3.
        depth_rate: rate of indentation, m/s.
        damping: Hunt-Crossley alpha, s/m: the elastic force is multiplied by ``1 + 1.5 alpha rate``.

    Returns:
        The contact; ``NO_CONTACT`` where there is none.

    Raises:
        ValueError: the hollow is as tight as the probe.

    Source: F = pi k d^2 / (2 sqrt(A B)), integral of the pressure; Hunt & Crossley 1975 for the damping.
    """
    if depth <= 0.0:
        return NO_CONTACT
    A, B = relative_curvatures(kappa, radius)
    factor = max(0.0, 1.0 + 1.5 * damping * depth_rate)
    elastic = pi * stiffness_n_m3 * depth * depth / (2.0 * sqrt(A * B))
    return Indentation(factor * elastic, factor)


def depth_for_force(force: float, kappa: tuple[float, float], radius: float, stiffness_n_m3: float) -> float:
    """Indentation at rest that carries a force, the inverse of ``elastic_contact``.

    Args:
        force: N, >= 0.
        kappa: principal curvatures of the body, 1/m, larger first.
        radius: probe radius, m.
        stiffness_n_m3: N/m^3.

    Returns:
        Indentation, m.

    Raises:
        ValueError: the hollow is as tight as the probe.
    """
    A, B = relative_curvatures(kappa, radius)
    return sqrt(2.0 * force * sqrt(A * B) / (pi * stiffness_n_m3))


def force_laws(touches: TouchedPlaces, radius: float, stiffness_n_m3: float) -> tuple[Floats, Floats]:
    """Coefficient and exponent of ``force = coefficient depth^exponent`` of every place.

    Args:
        touches: n places.
        radius: radius of the ball, m.
        stiffness_n_m3: stiffness of its layer.

    Returns:
        (n,) in N and m, and (n,).
    """
    kappa = np.maximum(touches.kappa, (MIN_CURVATURE_SHARE - 1.0) / radius)  # hollows as tight as the ball, widened
    A, B = (0.5 * (1.0 / radius + kappa)).T
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
    return force @ touches.normals
