"""Contact of a spherical probe with an object: its place and normal, and the stiffness of the layer from a touch.

`n_f`, `n_o` are OUTWARD unit normals of probe ("finger") and object, `n_f = −n_o` (14). Source: Chen, Rink and Zhang,
(13), (14), (20).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from canprobe.errors import UsageError
from canprobe.mechanics.touch.checks import positive
from canprobe.mechanics.types import Floats

HOLLOW_LIMIT_SHARE = 0.9
"""Limit of a hollow: curvature over −1/radius of the probe up to which there is one patch of contact."""


class Doubt(Enum):
    """Why the place of a contact is known less well than usual."""

    SATURATED = "a saturated patch"
    CUT = "a patch cut by the pad's edge"
    SMALL = "hardly a patch"
    DEAD = "a dead taxel in the patch"


class Slope(NamedTuple):
    """How √F grows with the indentation in a touch, √N/m, and its standard deviation (`PushFit`)."""

    value: float
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class ContactSample:
    """One contact, as the estimators take it.

    Attributes:
        t_s: time, s.
        p_base: (3,) contact point on the object, m, in base.
        n_base: (3,) outward unit normal of the object there, in base.
        T_base_probe: (4, 4) probe frame (origin at the sphere's centre, z through the pole of the pad) to base.
        r_probe: (3,) contact point in the probe frame, m.
        force_n: contact force, N.
        sigma_point: effective standard deviation of the point per axis, m; None takes the estimator's setting. With a
            `sigma_height` it is that along the surface only, the error of the centroid.
        sigma_normal: standard deviation of the normal per tangent axis, rad; None takes the estimator's setting.
        moments: second moments uu, uv, vv of the patch along the pad's axes, m² (`patch.moments`); or None.
        doubts: doubts about the image; an estimator gives the contact less weight and notes them.
        sigma_motion: standard deviation of the point that an inexact time stamp causes while the probe moves, m; its
            variance is added to that of the point.
        slope: slope of √F over the indentation in this touch; None where it was not measured.
        sigma_height: standard deviation of the point along the normal, m; None: `sigma_point`. It is the smaller one: a
            sphere that is tangent to the surface keeps its height where the centroid errs.
        sigma_slow: standard deviation of the part of the error along the surface that changes only as the contact moves
            over the pad, m; it is included in `sigma_point`. 0: the errors of all contacts are independent.
    """

    t_s: float
    p_base: Floats
    n_base: Floats
    T_base_probe: Floats
    r_probe: Floats
    force_n: float
    sigma_point: float | None = None
    sigma_normal: float | None = None
    moments: tuple[float, float, float] | None = None
    doubts: tuple[Doubt, ...] = ()
    sigma_motion: float = 0.0
    slope: Slope | None = None
    sigma_height: float | None = None
    sigma_slow: float = 0.0


def pad_to_direction(u: float, v: float, radius: float) -> Floats:
    """Direction (3,) of a pad point (u, v), m, as seen from the sphere's centre, in the probe frame.

    The flat array is wrapped azimuthal-equidistantly: the exponential map of (u, v)/R_p at the pole, R_p the radius.
    """
    return np.array(_direction(u, v, radius))


def _direction(u: float, v: float, radius: float) -> tuple[float, float, float]:
    angle = math.hypot(u, v) / radius
    scale = 1.0 / radius if angle < 1e-9 else math.sin(angle) / (angle * radius)
    return u * scale, v * scale, math.cos(angle)


def direction_to_pad(direction: Sequence[float] | Floats, radius: float) -> tuple[float, float]:
    """Pad coordinates (u, v) in m of a direction (3,) in the probe frame: the logarithmic map at the pole."""
    x, y, z = float(direction[0]), float(direction[1]), float(direction[2])
    sine = math.hypot(x, y)
    scale = radius if sine < 1e-12 and z > 0.0 else radius * math.atan2(sine, z) / max(sine, 1e-300)
    return x * scale, y * scale


def contact_on_object(
    T_base_probe: Floats, direction: Sequence[float], radius: float, depth: float
) -> tuple[Floats, Floats]:
    """The object's contact point and outward normal in base, through the squeezed layer (13), (14), (20).

    `p = centre + (R_p − δ) n_f` and `n_o = −n_f`. Without δ the point would lie a whole indentation, some tenths of a
    millimetre, inside the object.

    Args:
        T_base_probe: (4, 4) probe frame to base, m.
        direction: (3,) unit vector n_f in the probe frame.
        radius: R_p, m.
        depth: indentation δ of the layer, m.

    Returns:
        Point (3,), m, and outward unit normal (3,).
    """
    u, v, w = direction
    (a, b, c, x), (d, e, f, y), (g, h, i, z), _ = T_base_probe.tolist()
    nx, ny, nz = a * u + b * v + c * w, d * u + e * v + f * w, g * u + h * v + i * w
    reach = radius - depth
    return np.array([x + reach * nx, y + reach * ny, z + reach * nz]), np.array([-nx, -ny, -nz])


def contact_sample(
    *,
    t_s: float,
    T_base_probe: Floats,
    uv: Sequence[float] | Floats,
    depth: float,
    radius: float,
    force_n: float,
    sigma_point: float | None = None,
    moments: tuple[float, float, float] | None = None,
    doubts: tuple[Doubt, ...] = (),
    slope: Slope | None = None,
    sigma_height: float | None = None,
    sigma_slow: float = 0.0,
) -> ContactSample:
    """A sample from the centroid uv (2,) on the pad (m), the indentation (m) and the probe's radius (m).

    The other arguments are those of `ContactSample`. Image and pose must belong to one instant: at 25 mm/s a slip of
    5 ms is 0.125 mm, several times the noise of a centroid.
    """
    u, v = uv
    x, y, z = direction = _direction(u, v, radius)
    point, normal = contact_on_object(T_base_probe, direction, radius, depth)
    reach = radius - depth
    arm = np.array((reach * x, reach * y, reach * z))
    return ContactSample(
        t_s,
        point,
        normal,
        T_base_probe,
        arm,
        force_n,
        sigma_point,
        moments=moments,
        doubts=doubts,
        slope=slope,
        sigma_height=sigma_height,
        sigma_slow=sigma_slow,
    )


def at_depth(contact: ContactSample, depth: float, radius: float) -> ContactSample:
    """A contact of a probe of a radius (m), placed anew with another indentation of the layer (m)."""
    reach = float(np.linalg.norm(contact.r_probe))
    return replace(
        contact,
        p_base=contact.p_base + (reach - (radius - depth)) * contact.n_base,
        r_probe=contact.r_probe * ((radius - depth) / reach),
    )


def indentation_from_force(force: float, stiffness_n_m3: float, radius: float, kappa: ArrayLike) -> float:
    """Indentation δ (m) of the elastic layer under a force.

    Winkler layer, `p = k (δ − A x² − B y²)₊`, hence `F = π k δ² / (2 √(AB))` with `A, B = ½ (1/R_p + κ1,2)`.

    Args:
        force: F, N; 0 or less gives 0.
        stiffness_n_m3: k = K/h, N/m³.
        radius: R_p, m.
        kappa: (2,) principal curvatures of the object, 1/m; a NaN (not observed) counts as flat.

    Raises:
        UsageError: the object is concave and as tight as the probe or tighter, so that there is no patch.
    """
    k1, k2 = (0.0 if math.isnan(k) else float(k) for k in np.asarray(kappa, dtype=np.float64))
    positive("stiffness_n_m3", stiffness_n_m3)
    ab = (0.5 / radius + 0.5 * k1) * (0.5 / radius + 0.5 * k2)
    if min(1.0 / radius + k1, 1.0 / radius + k2) <= 0.0:
        raise UsageError(f"kappa: expected above {-1.0 / radius:.4g} per m (the probe's own curvature), got {k1}, {k2}")
    return math.sqrt(max(force, 0.0) * 2.0 * math.sqrt(ab) / (math.pi * stiffness_n_m3))
