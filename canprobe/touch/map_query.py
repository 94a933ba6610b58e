"""Where the surface of a map is: patches near a point, blended by distance and covariance.

Each patch within `reach` gives the height of its quadric along one common normal through the query point, and its
normal there. Patch i weighs `w_i = (1 − r_i²/reach²)² / v_i`, r_i the distance from its contact to the surface point
and v_i the variance of its height there (from `S_covariance`, so it grows with the fourth power of the distance from the
contact). The first factor vanishes smoothly at `reach`: a patch enters and leaves without a step. The common normal is
the blend of the patches' normals, iterated, so that the answer is the closest point.

Valid within `reach` of a contact and for a point nearer to the surface than its radius of curvature; with no patch
in reach the answer is NaN, never an extrapolation. The blend neither averages noise away in `sigma` nor knows
of errors that all patches share (calibration, indentation): neighbours on one pass rest on the same samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from canprobe.touch._arrays import Array, checked, positive
from canprobe.touch.local_patch import LocalPatch
from canprobe.touch.quadric import value_rows
from canprobe.touch.surface_map import SurfaceMap

REACH_M = 4e-3
"""Default distance from a contact at which its patch no longer counts, m."""
_ITERATIONS = 4
_FACING = 0.5
"""Least cosine between a patch's normal and that of the nearest one: others are another side of a thin body."""


@dataclass(frozen=True, slots=True, eq=False)
class MapPoint:
    """The surface of a map near a query point, base frame.

    Attributes:
        point: (3,) closest point of the blended surface, m; NaN where no patch is in reach.
        normal: (3,) outward unit normal there; NaN where no patch is in reach.
        height: signed distance of the query point from the surface, m, positive outside.
        sigma: standard deviation of the surface's height, the weighted mean of the patches' own, m; NaN where none of
            them knows it.
        patches: how many were blended.
    """

    point: Array
    normal: Array
    height: float
    sigma: float
    patches: int


class _Heights(NamedTuple):
    """What each patch says along one line: height (m), outward normal (base), its variance (m²), distance (m)."""

    height: Array
    normal: Array
    variance: Array
    distance: Array


def closest(surface_map: SurfaceMap, point: ArrayLike, reach: float = REACH_M) -> MapPoint:
    """Closest point of a map's surface to a point nearby.

    Args:
        surface_map: the map.
        point: (3,) base frame, m.
        reach: distance from a contact at which its patch no longer counts, m.

    Raises:
        UsageError: naming the field, what was expected and what was got.
    """
    p = checked("point", point, (3,))
    limit = positive("reach", reach)
    # a foot in reach can belong to a point farther off, but not farther than its own distance from the surface
    first = surface_map.near(p, math.inf)[:1]
    if not first:
        return _nowhere()
    lifted = abs(float(first[0].normal @ (p - first[0].point)))
    patches = [
        patch
        for patch in surface_map.near(p, math.hypot(limit, lifted) + 0.5 * limit)
        if float(patch.normal @ first[0].normal) > _FACING
    ]
    if not patches:
        return _nowhere()
    normal, foot = first[0].normal, p - first[0].normal * float(first[0].normal @ (p - first[0].point))
    for _ in range(_ITERATIONS):
        said = _heights(patches, p, normal, foot)
        weight = _weights(said, limit)
        total = float(weight.sum())
        if not total > 0.0:
            return _nowhere()
        weight = weight / total
        height = float(weight @ np.where(weight > 0.0, said.height, 0.0))
        foot = p + height * normal
        n = weight @ said.normal
        normal = n / math.sqrt(float(n @ n))
    used = weight > 0.0
    sigma = float(np.sqrt(said.variance[used]) @ weight[used]) if (said.variance[used] > 0.0).all() else math.nan
    return MapPoint(foot, normal, -height, sigma, int(used.sum()))


def _nowhere() -> MapPoint:
    return MapPoint(np.full(3, math.nan), np.full(3, math.nan), math.nan, math.nan, 0)


def _weights(said: _Heights, reach: float) -> Array:
    """(n,) weights, not yet of sum 1; variances count only where every patch in reach has one."""
    fade = np.maximum(0.0, 1.0 - (said.distance / reach) ** 2) ** 2
    fade = np.where(np.isfinite(said.height), fade, 0.0)
    near = fade > 0.0
    known = bool((said.variance[near] > 0.0).all())
    return np.where(near, fade / np.where(near, said.variance, 1.0), 0.0) if known else fade


def _heights(patches: list[LocalPatch], p: Array, normal: Array, foot: Array) -> _Heights:
    rows = [_height(patch, p, normal) for patch in patches]
    distance = np.array([np.linalg.norm(patch.point - foot) for patch in patches])
    return _Heights(
        np.array([r[0] for r in rows]), np.array([r[1] for r in rows]), np.array([r[2] for r in rows]), distance
    )


def _height(patch: LocalPatch, p: Array, normal: Array) -> tuple[float, Array, float]:
    """Where the line p + t·normal meets a patch: t, the outward normal there, the variance of t."""
    R = patch.T_base_contact[:3, :3]
    x, d = R.T @ (p - patch.point), R.T @ normal
    B, h = 2.0 * patch.S[:3, :3], 2.0 * patch.S[:3, 3]
    # f(x + t d) = ½ a t² + b t + c
    a, b = float(d @ B @ d), float(d @ (B @ x + h))
    c = 0.5 * float(x @ B @ x) + float(h @ x)
    square = b * b - 2.0 * a * c
    if square < 0.0 or not b + math.sqrt(square) > 0.0:
        return math.nan, normal, math.nan
    t = -2.0 * c / (b + math.sqrt(square))
    at = x + t * d
    g = B @ at + h
    slope = float(g @ d)
    F = value_rows(at[None])[0] / slope
    variance = float(F @ patch.S_covariance @ F) if patch.pose_known else 0.0
    return t, R @ (g / math.sqrt(float(g @ g))), variance
