"""The surface of patches: those near a point, blended by distance and covariance, for many points at once.

Each patch within `reach` gives the height of its quadric along one common normal through the query point, and its
normal there. Patch i weighs `w_i = (1 − r_i²/reach²)² g_i / v_i`: r_i is the distance from its contact to the surface
point, v_i the variance of its height there (from the covariance of S: it grows with the fourth power of the distance
from the contact), and g_i is 1 except towards the limb of a quadric and where the patch faces elsewhere. Every factor
ends with a slope of zero: a patch enters and leaves without a step or a kink. The common normal is the blend of the
patches' normals, iterated, so that the answer is the closest point.

Valid within `reach` of a contact and for a point nearer to the surface than its radius of curvature; with no patch in
reach the answer is NaN, never an extrapolation. `sigma` is a mean of the patches' own. Why not that of their weighted
mean: neighbours on one pass rest on the same samples, so blending averages no noise away. Errors that all patches share
(calibration, indentation) are not in it. Across an edge that is sharper than `MIN_FACING_COSINE` only the patches of
one side count.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from canprobe.mechanics.touch.meshing import Feet
from canprobe.mechanics.types import Floats

MIN_FACING_COSINE = 0.5
"""Least cosine between a patch's normal and the surface's; other patches belong to another side of a thin body."""
_FULL_FACING_COSINE, _LIMB_SHARE = 0.75, 0.25
"""Least cosine at which a patch counts in full, and share of the discriminant below which a line grazes its quadric."""
UNKNOWN_HEIGHT_SIGMA_M = 1e-4
"""Standard deviation, m, that weighs a patch whose height has no known one: the largest that contacts have."""
_MAX_ROUNDS = 40
"""Most rounds; each shrinks the error of the normal by the height over the radius of curvature."""
_SETTLED_NORMAL_CHANGE = 1e-8


class Quadrics(NamedTuple):
    """Patches as arrays, in base.

    Attributes:
        R: (m, 3, 3) axes of the contact frames, as columns.
        contact: (m, 3) contact points, m.
        normal: (m, 3) outward unit normals there.
        B, h: (m, 3, 3) Hessians and (m, 3) gradients of the quadrics at the contacts, along the axes of base.
        covariance: (m, 9, 9) covariances of the entries of S.
        known: (m,) whether the height of the patch is known.
    """

    R: Floats
    contact: Floats
    normal: Floats
    B: Floats
    h: Floats
    covariance: Floats
    known: NDArray[np.bool_]

    @classmethod
    def of(cls, T: Floats, S: Floats, covariance: Floats, known: NDArray[np.bool_]) -> Quadrics:
        """Patches with contact frames T and matrices S (m, 4, 4) and covariances (m, 9, 9); known (m,) heights."""
        R, covariance = T[:, :3, :3], covariance.copy()
        covariance[~known, 2, 2] = UNKNOWN_HEIGHT_SIGMA_M**2
        B = 2.0 * R @ S[:, :3, :3] @ R.transpose(0, 2, 1)
        return cls(R, T[:, :3, 3], -R[:, :, 2], B, 2.0 * _times(R, S[:, :3, 3]), covariance, known)

    def heights(self, i: NDArray[np.intp], p: Floats, d: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Where lines p + t d meet the patches i: t (m), outward unit normals, variances of t (m²), and weights `g`."""
        x, B, h = p - self.contact[i], self.B[i], self.h[i]
        Bx, Bd = _times(B, x), _times(B, d)
        # f(x + t d) = ½ a t² + b t + c
        a, b, c = _dot(d, Bd), _dot(d, Bx + h), _dot(x, 0.5 * Bx + h)
        square = b * b - 2.0 * a * c
        root = b + np.sqrt(np.maximum(square, 0.0))
        met = (square > 0.0) & (root > 0.0)
        t = np.where(met, -2.0 * c / np.where(met, root, 1.0), 0.0)
        g = Bx + h + t[:, None] * Bd
        slope = np.where(met, _dot(g, d), 1.0)
        u, v, w = np.einsum("ijk,ij->ki", self.R[i], x + t[:, None] * d)
        F = np.stack([2 * u, 2 * v, np.ones_like(u), 2 * u * w, 2 * v * w, w * w, u * u, 2 * u * v, v * v], 1)  # df/dc
        variance = _dot(_times(self.covariance[i], F), F) / slope**2
        limb = np.where(met, square / np.where(met, b * b * _LIMB_SHARE, 1.0), 0.0)
        facing = (_dot(self.normal[i], d) - MIN_FACING_COSINE) / (_FULL_FACING_COSINE - MIN_FACING_COSINE)
        return t, g / np.sqrt(_dot(g, g))[:, None], variance, _eased(limb) * _eased(facing)


def _dot(a: Floats, b: Floats) -> Floats:
    result: Floats = np.einsum("ij,ij->i", a, b)
    return result


def _times(A: Floats, x: Floats) -> Floats:
    result: Floats = np.einsum("nij,nj->ni", A, x)
    return result


def _eased(x: Floats) -> Floats:
    """0 below 0, 1 above 1, between them with slopes that end at 0."""
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def feet_on(patches: Quadrics, points: Floats, reach: float) -> Feet:
    """Closest points of the blended patches to points (n, 3), m, base frame; patches count within `reach`, m."""
    n = len(points)
    places, numbers = np.full((2, n, 3), math.nan), np.full((2, n), math.nan)
    found = Feet(places[0], places[1], numbers[0], numbers[1], np.zeros(n, np.intp))
    if not len(patches.contact) or not n:
        return found
    tree = cKDTree(patches.contact)
    nearest = tree.query(points)[1]
    normal = patches.normal[nearest]
    lifted = _dot(normal, points - patches.contact[nearest])
    foot = points - lifted[:, None] * normal
    # with room for a foot that is not quite below the point as seen from the nearest patch
    near = tree.query_ball_point(foot, reach + np.minimum(np.abs(lifted), 0.5 * reach))
    counts = np.array([len(one) for one in near], np.intp)
    left = np.flatnonzero(counts)  # points whose normal has not settled; a pair is a row of these and a patch
    normal, foot = normal[left], foot[left]
    row: NDArray[np.intp] = np.repeat(np.arange(len(left)), counts[left])
    patch = np.fromiter((i for one in near for i in one), np.intp, len(row))
    for _ in range(_MAX_ROUNDS):
        height, outward, variance, valid = patches.heights(patch, points[left[row]], normal[row])
        apart = patches.contact[patch] - foot[row]
        fade = np.maximum(0.0, 1.0 - _dot(apart, apart) / reach**2) ** 2 * valid
        weight = np.where(fade > 0.0, fade / np.maximum(variance, 1e-300), 0.0)
        with np.errstate(invalid="ignore"):  # 0/0 where no patch counts: the answer is NaN there, and has settled
            share = weight / np.bincount(row, weight, len(left))[row]
        known = patches.known[patch]
        columns = (height, known * np.sqrt(variance), known, *outward.T)
        blend: Floats = np.array([np.bincount(row, share * column, len(left)) for column in columns])
        height, sigma, knowing = blend[:3]
        foot = points[left] + height[:, None] * normal
        before, normal = normal, blend[3:].T
        normal = normal / np.sqrt(_dot(normal, normal))[:, None]
        found.point[left], found.normal[left], found.height[left] = foot, normal, -height
        found.sigma[left] = np.where(knowing > 0.0, sigma / np.maximum(knowing, 1e-300), math.nan)
        found.pieces[left] = np.bincount(row, weight > 0.0, len(left))
        more = np.abs(normal - before).max(axis=1) > _SETTLED_NORMAL_CHANGE
        left, normal, foot = left[more], normal[more], foot[more]
        row, patch = (np.cumsum(more) - 1)[row[more[row]]], patch[more[row]]
        if not len(left):
            break
    return found
