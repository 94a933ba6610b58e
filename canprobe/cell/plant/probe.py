"""The probe's ball in space, carried by the arm or pressed on the object, and the contact of its elastic layer."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, pi, sin, sqrt
from typing import NamedTuple

import numpy as np

from canprobe.cell.plant.config import PlantConfig
from canprobe.cell.plant.taxels import Directions, Vec, pad_basis
from canprobe.mechanics.touch.shapes import Nearest

# Contact of the probe's elastic layer with a surface of known curvature.
#
# Model: a thin elastic layer (Winkler) on a rigid sphere against a rigid body, no friction:
# ``p = k (d - A x^2 - B y^2)`` where positive, with ``A = (1/R_p + kappa1) / 2``, ``B = (1/R_p + kappa2) / 2``.
# It stops being true where the patch is no longer small against both radii.


class Contact(NamedTuple):
    """What one indentation gives.

    Attributes:
        force: N, never negative (never adhesive).
        a: half-axis of the patch along the direction of kappa1, m.
        b: half-axis along the direction of kappa2, m; a <= b.
        area: m^2.
        peak_pressure: at the middle of the patch, Pa, damping included.
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


NO_CONTACT = Contact(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def relative_curvatures(kappa: tuple[float, float], radius: float) -> tuple[float, float]:
    """A and B of the gap ``A x^2 + B y^2`` between probe and body.

    Args:
        kappa: principal curvatures of the body, 1/m, larger first, positive for convex.
        radius: probe radius, m.

    Returns:
        A >= B > 0, 1/m.

    Raises:
        ValueError: for a hollow as tight as the probe: the contact is then not one small patch.
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
) -> Contact:
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
        ValueError: for a hollow as tight as the probe.

    Source: F = pi k d^2 / (2 sqrt(A B)), integral of the pressure; Hunt & Crossley 1975 for the damping.
    """
    if depth <= 0.0:
        return NO_CONTACT
    A, B = relative_curvatures(kappa, radius)
    factor = max(0.0, 1.0 + 1.5 * damping * depth_rate)
    elastic = pi * stiffness_n_m3 * depth * depth / (2.0 * sqrt(A * B))
    a, b = sqrt(depth / A), sqrt(depth / B)
    return Contact(
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
        ValueError: for a hollow as tight as the probe.
    """
    A, B = relative_curvatures(kappa, radius)
    return sqrt(2.0 * force * sqrt(A * B) / (pi * stiffness_n_m3))


# The probe's ball in space: carried by the arm, or pressed on the object without one; and directions on its pad.

Axes = tuple[Vec, Vec, Vec]


@dataclass(slots=True, eq=False)
class Probe:
    """Probe sphere now: centre, axes (columns x, y, z = pole) and velocity of the centre, base frame."""

    centre: Vec
    axes: Axes
    velocity: Vec


OFF = 1e-3
"""How far the probe is off the object before the press begins, m."""


class PressedProbe:
    """Probe without an arm, pole against the object's normal at its origin.

    Args:
        config: with an object.
    """

    def __init__(self, config: PlantConfig) -> None:
        assert config.object is not None
        pose = config.object.T_base_object
        x, n = pose[:3, 0], pose[:3, 2]
        self._origin, self._normal = pose[:3, 3], n
        self._axes = (tuple(x.tolist()), tuple(np.cross(-n, x).tolist()), tuple((-n).tolist()))
        c = config.object.closest(self._origin)
        self._mean = depth_for_force(
            config.press.force_n, (float(c.kappa[0]), float(c.kappa[1])), config.radius_m, config.stiffness_n_m3
        )
        self._radius, self._press = config.radius_m, config.press

    def at(self, t_s: float, first_s: float | None) -> Probe:
        """Where it is.

        Args:
            t_s: s.
            first_s: time of the first image, s; None before it.
        """
        waits = self._press.after_s
        if waits and (first_s is None or t_s < first_s + waits):
            centre = self._origin + (self._radius + OFF) * self._normal
            return Probe(tuple(centre.tolist()), self._axes, (0.0, 0.0, 0.0))
        rate = 2 * pi * self._press.frequency_hz
        depth = self._mean * (1.0 + self._press.swing * sin(rate * t_s))
        speed = -self._mean * self._press.swing * rate * cos(rate * t_s)
        centre, velocity = self._origin + (self._radius - depth) * self._normal, speed * self._normal
        return Probe(tuple(centre.tolist()), self._axes, tuple(velocity.tolist()))


def in_pad(foot: Nearest, probe: Probe, d: Vec) -> Directions:
    """Principal directions in the transported pad basis at the contact direction.

    Args:
        foot: of the contact on the object.
        probe: of which the pad is.
        d: direction of the contact from the probe's centre, pad frame.
    """
    u, v = (_along(probe.axes, e) for e in pad_basis(d))
    first, second = foot.directions
    return (_dot(first, u), _dot(first, v)), (_dot(second, u), _dot(second, v))


def _along(axes: Axes, e: Vec) -> Vec:
    """A vector of the probe's frame in the base frame."""
    (x0, x1, x2), (y0, y1, y2), (z0, z1, z2) = axes
    a, b, c = e
    return a * x0 + b * y0 + c * z0, a * x1 + b * y1 + c * z1, a * x2 + b * y2 + c * z2


def _dot(a: Vec, b: Vec) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
