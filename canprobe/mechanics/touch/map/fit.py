"""A map of other people's contacts: points and normals, whatever made them."""

from __future__ import annotations

import math

from numpy.typing import ArrayLike

from canprobe.errors import UsageError
from canprobe.mechanics.touch.checks import positive, real
from canprobe.mechanics.touch.map.local_fits import PadLayer
from canprobe.mechanics.touch.map.noise import USUAL_SIGMA_M, MapNoise
from canprobe.mechanics.touch.map.surface_map import SurfaceMap

USUAL_SIGMA_NORMAL = 2e-3
"""Standard deviation of a normal where none is given, rad."""


def fit_map(
    points: ArrayLike,
    normals: ArrayLike,
    forces: ArrayLike | None = None,
    *,
    sigma_point: float = USUAL_SIGMA_M,
    sigma_normal: float = USUAL_SIGMA_NORMAL,
    sigma_height: float | None = None,
    probe_radius: float | None = None,
    stiffness: float | None = None,
) -> SurfaceMap:
    """The surface that contacts show, with its uncertainty.

    The surface must be smooth over about 3 mm; contacts a few mm apart make one surface, and it ends 4 mm from them.
    Where it is rougher, or two sheets mix, its curvature is not observed; points without normals do not tell a step
    between two passes from a bend. Errors of contacts count as independent.

        found = fit_map(points, normals, sigma_point=30e-6, sigma_normal=1e-3)
        height, sigma = found.distance(places)
        found.mesh(cell=1e-3).save_ply("surface.ply")

    Args:
        points: (n, 3) contact points in one frame, m, in the order of time.
        normals: (n, 3) outward normals there, of any length. Where no normals were measured give the reversed direction
            of approach, and `sigma_normal=math.inf`: it only says on which side the body is.
        forces: (n,) contact forces, N, of a spherical probe with an elastic layer. Then `points` are those of the
            sphere without load, and the squeeze of the layer is taken off by the curvature that the map finds.
        sigma_point: standard deviation of a point along each axis, m.
        sigma_normal: standard deviation of a normal about each tangent axis, rad; infinite: normals are not used.
        sigma_height: standard deviation of a point along the normal, m; None: `sigma_point`; infinite: not used.
        probe_radius: radius of that probe, m.
        stiffness: stiffness K/h of its layer, N/m³.

    Returns:
        The map; `SurfaceMap.add` takes more contacts.

    Raises:
        UsageError: an argument has a wrong shape or value; the message names it.
    """
    heights = sigma_point if sigma_height is None else sigma_height
    noise = MapNoise(
        positive("sigma_point", sigma_point),
        _positive_or_infinite("sigma_height", heights),
        _positive_or_infinite("sigma_normal", sigma_normal),
    )
    pad = None
    if forces is not None:
        if probe_radius is None or stiffness is None:
            raise UsageError(
                "forces: expected with probe_radius (m) and stiffness (N/m³) of the layer, got them without"
            )
        pad = PadLayer(positive("probe_radius", probe_radius), positive("stiffness", stiffness))
    elif probe_radius is not None or stiffness is not None:
        raise UsageError("probe_radius, stiffness: expected with forces, got them without")
    found = SurfaceMap(pad, noise)
    found.add(points, normals, forces)
    return found


def _positive_or_infinite(name: str, value: float) -> float:
    number = float(real(name, value))
    return number if number == math.inf else positive(name, number)
