"""Contact of the probe's elastic layer with a surface of known curvature.

Model: a thin elastic layer (Winkler) on a rigid sphere against a rigid body, no friction:
``p = k (d - A x^2 - B y^2)`` where positive, with ``A = (1/R_p + kappa1) / 2``, ``B = (1/R_p + kappa2) / 2``.
It stops being true where the patch is no longer small against both radii.
"""

from __future__ import annotations

from math import pi, sqrt
from typing import NamedTuple


class Indentation(NamedTuple):
    """The contact of an indentation.

    Attributes:
        force: N, never negative (never adhesive).
        a: half-axis of the patch along the direction of kappa1, m.
        b: half-axis along the direction of kappa2, m; a <= b.
        area: m^2.
        peak_pressure: pressure at the middle of the patch, Pa, damping included.
        stiffness: elastic dF/dd, N/m.
        damping_factor: factor of force and pressure due to the rate of indentation, >= 0.
    """

    force: float
    a: float
    b: float
    area: float
    peak_pressure: float
    stiffness: float
    damping_factor: float


NO_CONTACT = Indentation(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


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
    """Force and patch of an indentation.

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
    a, b = sqrt(depth / A), sqrt(depth / B)
    return Indentation(
        force=factor * elastic,
        a=a,
        b=b,
        area=pi * a * b,
        peak_pressure=factor * stiffness_n_m3 * depth,
        stiffness=2.0 * elastic / depth,
        damping_factor=factor,
    )


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
