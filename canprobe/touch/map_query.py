"""Where the surface of a map is: patches near a point, blended by distance and covariance.

Each patch within `reach` gives the height of its quadric along one common normal through the query point, and its
normal there. Patch i weighs `w_i = (1 − r_i²/reach²)² / v_i`, r_i the distance from its contact to the surface point
and v_i the variance of its height there (from `S_covariance`: it grows with the fourth power of the distance from the
contact). The first factor vanishes smoothly at `reach`: a patch enters and leaves without a step. The common normal is
the blend of the patches' normals, iterated, so that the answer is the closest point.

Valid within `reach` of a contact and for a point nearer to the surface than its radius of curvature; with no patch
in reach the answer is NaN, never an extrapolation. The blend neither averages noise away in `sigma` nor knows
of errors that all patches share (calibration, indentation): neighbours on one pass rest on the same samples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from canprobe.touch._arrays import Array, checked, positive
from canprobe.touch.local_patch import LocalPatch
from canprobe.touch.quadric import value_rows
from canprobe.touch.surface_map import SurfaceMap

REACH_M = 4e-3
"""Default distance from a contact at which its patch no longer counts, m."""
_ITERATIONS = 40
"""Most rounds; each shrinks the error of the normal by the height over the radius of curvature."""
_SETTLED = 1e-10
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


class _Stack(NamedTuple):
    """Patches as arrays: frames, gradient `B x + h` of f, covariance of S (zeros where the pose is not known)."""

    R: Array
    origin: Array
    B: Array
    h: Array
    covariance: Array

    @classmethod
    def of(cls, patches: Sequence[LocalPatch]) -> _Stack:
        T, S = np.array([p.T_base_contact for p in patches]), np.array([p.S for p in patches])
        covariance = np.array([p.S_covariance * p.pose_known for p in patches])
        return cls(T[:, :3, :3], T[:, :3, 3], 2.0 * S[:, :3, :3], 2.0 * S[:, :3, 3], covariance)


class _Heights(NamedTuple):
    """What each patch says along one line: height (m), outward normal (base), its variance (m²), whether it is met."""

    height: Array
    normal: Array
    variance: Array
    met: NDArray[np.bool_]


def closest(surface_map: SurfaceMap, point: ArrayLike, reach: float = REACH_M) -> MapPoint:
    """Closest point of a map's surface to a point nearby.

    Args:
        surface_map: the map.
        point: (3,) base frame, m.
        reach: distance from a contact at which its patch no longer counts, m.

    Raises:
        UsageError: naming the field, what was expected and what was got.
    """
    p, limit = checked("point", point, (3,)), positive("reach", reach)
    chosen = _candidates(surface_map, p, limit)
    if not len(chosen):
        return _nowhere()
    stack = _Stack.of([surface_map.patches[i] for i in chosen])
    normal = surface_map.normals[chosen[0]]
    foot = p - normal * float(normal @ (p - surface_map.points[chosen[0]]))
    for _ in range(_ITERATIONS):
        said = _heights(stack, p, normal)
        weight = _weights(said, np.linalg.norm(stack.origin - foot, axis=1), limit)
        total = float(weight.sum())
        if not total > 0.0:
            return _nowhere()
        weight = weight / total
        height = float(weight @ said.height)
        foot = p + height * normal
        before, n = normal, weight @ said.normal
        normal = n / math.sqrt(float(n @ n))
        if np.abs(normal - before).max() < _SETTLED:
            break
    used = weight > 0.0
    known = bool((said.variance[used] > 0.0).all())
    sigma = float(np.sqrt(said.variance[used]) @ weight[used]) if known else math.nan
    return MapPoint(foot, normal, -height, sigma, int(used.sum()))


def _candidates(surface_map: SurfaceMap, p: Array, reach: float) -> NDArray[np.intp]:
    """Indices of the patches whose contact may be in reach of the foot of p, the nearest first."""
    if not len(surface_map):
        return np.zeros(0, np.intp)
    offset = surface_map.points - p
    distance = np.sqrt(np.einsum("ij,ij->i", offset, offset))
    first = int(np.argmin(distance))
    lifted = abs(float(surface_map.normals[first] @ offset[first]))
    facing = surface_map.normals @ surface_map.normals[first] > _FACING
    # by the triangle inequality, with room for a foot that is not below the point as seen from the nearest patch
    chosen = np.flatnonzero(facing & (distance <= 1.5 * reach + lifted))
    return chosen[np.argsort(distance[chosen], kind="stable")]


def _nowhere() -> MapPoint:
    return MapPoint(np.full(3, math.nan), np.full(3, math.nan), math.nan, math.nan, 0)


def _weights(said: _Heights, distance: Array, reach: float) -> Array:
    """(n,) weights, not yet of sum 1; variances count only where every patch in reach has one."""
    fade: Array = np.maximum(0.0, 1.0 - (distance / reach) ** 2) ** 2
    fade[~said.met] = 0.0
    near = fade > 0.0
    if not (said.variance[near] > 0.0).all():
        return fade
    fade[near] /= said.variance[near]
    return fade


def _heights(stack: _Stack, p: Array, normal: Array) -> _Heights:
    """Where the line p + t·normal meets each patch."""
    x, d = (p - stack.origin)[:, None] @ stack.R, normal @ stack.R
    x = x[:, 0]
    gx, gd = (x[:, None] @ stack.B)[:, 0] + stack.h, (d[:, None] @ stack.B)[:, 0]
    # f(x + t d) = ½ a t² + b t + c
    a, b = np.einsum("ij,ij->i", d, gd), np.einsum("ij,ij->i", d, gx)
    c = 0.5 * np.einsum("ij,ij->i", x, gx + stack.h)
    square = b * b - 2.0 * a * c
    root = b + np.sqrt(np.maximum(square, 0.0))
    met = (square >= 0.0) & (root > 0.0)
    t = np.where(met, -2.0 * c / np.where(met, root, 1.0), 0.0)
    g = gx + t[:, None] * gd
    F = value_rows(x + t[:, None] * d)
    slope = np.where(met, np.einsum("ij,ij->i", g, d), 1.0)
    variance = np.einsum("ij,ijk,ik->i", F, stack.covariance, F) / slope**2
    outward = (stack.R @ g[:, :, None])[:, :, 0] / np.sqrt(np.einsum("ij,ij->i", g, g))[:, None]
    return _Heights(t, outward, variance, met)
