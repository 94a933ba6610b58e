"""A whole scan as one surface description: local patches along the contact's path, and where their surface is.

Source: Chen, Rink and Zhang, "Local object shape from tactile sensing": an object is described by a set of local
contact frames with their surface matrices.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from canprobe.errors import UsageError
from canprobe.touch.estimate.answer import SurfaceEstimate
from canprobe.touch.estimate.quadric import TO_Q, UNIT, parameters_of, terms
from canprobe.touch.linear_algebra import Array, checked, positive, read_only
from canprobe.touch.surface import SurfaceMatrix

WIDE = 10.0
"""Standard deviation of a combination of curvature that was not observed, over the path that the estimate rests on:
±500 1/m for 20 mm, a radius of 2 mm. It only ever widens what is said of heights and normals beside the contact."""
LEAST_LENGTH_M = 1e-3
"""A shorter path counts as this long."""

_SHAPES: dict[str, tuple[int | None, ...]] = {
    "T_base_contact": (4, 4),
    "S": (4, 4),
    "S_covariance": (9, 9),
    "observed": (2,),
    "combinations": (None, 3),
}
_Q_TO_C = UNIT[:, None]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class LocalPatch:
    """A quadric that describes the surface round one contact.

    Attributes:
        T_base_contact: (4, 4) contact frame to base, m; z is the inward normal.
        S: (4, 4) in the contact frame, c14 = c24 = c44 = 0, c34 = −½; unobserved combinations nearest to flat.
        K_covariance: (3, 3) of (K11, K12, K22), 1/m²; NaN or infinite where not observed, as in `SurfaceEstimate`.
        S_covariance: (9, 9) of (c14, c24, c44, c13, c23, c33, c11, c12, c22), SI units, always finite: a combination
            that the data did not observe stands in it with `WIDE`, whatever a prior said of it. c44 is the height,
            2 c14 and 2 c24 are the tilt.
        pose_known: the part of `S_covariance` about height and tilt is the estimator's; False from methods that do
            not know it, which leave zeros there.
        observed: (2,) 1 or 0, for each principal curvature.
        combinations: (rank, 3) rows: what was observed, as weights of (K11, √2 K12, K22).
        t_s: instant of the last sample, s.
        travelled_m: path of the contact until then, m.
        distance_m: path that the patch rests on, m; patches nearer than some of it along the path share their data.
        innovation: mean squared whitened residual per degree of freedom; well below 1 where the σ's are generous.
    """

    T_base_contact: Array
    S: Array
    K_covariance: Array
    S_covariance: Array
    pose_known: bool
    observed: Array
    combinations: Array
    t_s: float
    travelled_m: float
    distance_m: float
    innovation: float

    def __post_init__(self) -> None:
        for name, shape in _SHAPES.items():
            object.__setattr__(self, name, read_only(checked(name, getattr(self, name), shape)))
        object.__setattr__(self, "K_covariance", read_only(self.K_covariance))
        for name in ("t_s", "travelled_m", "distance_m", "innovation"):
            checked(name, getattr(self, name), ())

    @classmethod
    def of(cls, estimate: SurfaceEstimate, *, t_s: float, travelled_m: float) -> LocalPatch:
        """The patch of one estimate in the base frame; instant (s) of its last sample and path (m) until then."""
        return cls(
            T_base_contact=estimate.T_frame_contact,
            S=estimate.S,
            K_covariance=estimate.covariance,
            S_covariance=_covariance(estimate),
            pose_known=estimate.model_root is not None,
            observed=estimate.observed.astype(np.float64),
            combinations=estimate.combinations,
            t_s=t_s,
            travelled_m=travelled_m,
            distance_m=estimate.distance,
            innovation=estimate.innovation,
        )

    @property
    def rank(self) -> int:
        """How many combinations of curvature were observed, 0–3."""
        return len(self.combinations)

    @property
    def point(self) -> Array:
        """(3,) contact point, base frame, m."""
        return self.T_base_contact[:3, 3]

    @property
    def normal(self) -> Array:
        """(3,) outward unit normal there, base frame."""
        return -self.T_base_contact[:3, 2]

    @property
    def surface(self) -> SurfaceMatrix:
        """`S` with its operations, in the contact frame."""
        return SurfaceMatrix(self.S)

    @property
    def c(self) -> Array:
        """(9,) entries of `S` in the order of `S_covariance`, SI units."""
        return parameters_of(self.S)

    def equals(self, other: LocalPatch) -> bool:
        """Every field is the same, bit by bit (NaN equals NaN)."""
        return all(
            np.array_equal(np.asarray(getattr(self, f.name), float), np.asarray(getattr(other, f.name), float), True)
            for f in fields(self)
        )


def _covariance(estimate: SurfaceEstimate) -> Array:
    """(9, 9) finite covariance of the entries of S, SI units."""
    length = max(estimate.distance, LEAST_LENGTH_M)
    weak = WIDE / length
    V = estimate.combinations.T
    if estimate.model_root is None:
        P = np.zeros((9, 9))
        P[6:, 6:] = _Q_TO_C * _curvature_covariance(estimate, V, weak) * _Q_TO_C.T
        return P
    units = np.array([1.0, 1.0, 1.0 / length] + 6 * [length])
    root = estimate.model_root / units  # dimensionless, or the inverse would lose its digits
    if estimate.rank < 3:
        # noise among the regressors feigns knowledge of what was not observed: taken out, and held wide instead
        open_ = np.eye(3) - V @ V.T
        root = np.concatenate([root, np.zeros((3, 9))])
        root[:-3, 6:] = root[:-3, 6:] @ (_Q_TO_C * (V @ V.T) / _Q_TO_C.T)
        root[-3:, 6:] = open_ / UNIT / WIDE
    if len(root) > 9:
        root = np.linalg.qr(root, mode="r")
    inverse = np.linalg.inv(root)
    result: Array = inverse @ inverse.T / np.outer(units, units)
    return 0.5 * (result + result.T)


def _curvature_covariance(estimate: SurfaceEstimate, V: Array, weak: float) -> Array:
    """(3, 3) covariance of q = (K11, √2 K12, K22), what was not observed held wide, 1/m²."""
    if estimate.rank == 3:
        return estimate.covariance * np.outer(TO_Q, TO_Q)
    seen = V @ np.linalg.inv(V.T @ estimate.information @ V) @ V.T
    result: Array = seen + weak**2 * (np.eye(3) - V @ V.T)
    return result


SPACING_M = 2e-3
"""Path from one patch to the next, m: well below the radius of what can be felt, so that neighbours overlap."""
LEAST_RANK = 1


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SurfaceMap:
    """Local patches in the order in which they were felt, and the path of the contact.

    Attributes:
        patches: each with its frame, matrix and covariance, by increasing `travelled_m`.
        path: (n, 3) contact points, base frame, m.
        method: estimator that the patches are from.
        points: (m, 3) contact points of the patches, base frame, m.
        normals: (m, 3) outward unit normals there.
        travelled: (m,) path of the contact until each patch, m.
    """

    patches: tuple[LocalPatch, ...]
    path: Array
    method: str = ""
    points: Array = field(init=False, repr=False)
    normals: Array = field(init=False, repr=False)
    travelled: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        def keep(name: str, values: ArrayLike) -> None:
            object.__setattr__(self, name, read_only(values))

        keep("path", checked("path", self.path, (None, 3)))
        keep("points", np.array([patch.point for patch in self.patches]).reshape(-1, 3))
        keep("normals", np.array([patch.normal for patch in self.patches]).reshape(-1, 3))
        keep("travelled", [patch.travelled_m for patch in self.patches])
        along = [patch.travelled_m for patch in self.patches]
        for i, (before, after) in enumerate(pairwise(along), start=1):
            if after < before:
                raise UsageError(
                    f"patches[{i}].travelled_m: expected at least {before} of the one before, got {after}; patches"
                    " stand in the order in which they were felt"
                )

    def __len__(self) -> int:
        return len(self.patches)

    def __iter__(self) -> Iterator[LocalPatch]:
        return iter(self.patches)

    @property
    def memory(self) -> float:
        """Longest path that a patch rests on, m; 0 without patches."""
        return max((patch.distance_m for patch in self.patches), default=0.0)

    def equals(self, other: SurfaceMap) -> bool:
        """The same patches, path and method, bit by bit."""
        same = len(self) == len(other) and self.method == other.method and np.array_equal(self.path, other.path)
        return same and all(a.equals(b) for a, b in zip(self.patches, other.patches, strict=True))


def spaced(patches: Iterable[LocalPatch], spacing: float) -> list[LocalPatch]:
    """The first patch at or after every multiple of a spacing (m) along the path; a contact at rest adds none."""
    step = positive("spacing", spacing)
    kept: list[LocalPatch] = []
    last = -1
    start = None
    for patch in patches:
        start = patch.travelled_m if start is None else start
        cell = int((patch.travelled_m - start) / step + 1e-9)
        if cell > last:
            kept.append(patch)
            last = cell
    return kept


def merge_patches(
    patches: Sequence[LocalPatch], path: ArrayLike, *, spacing: float = SPACING_M, method: str = ""
) -> SurfaceMap:
    """One map of a scan from its estimates' patches, in the order of the path (n, 3), m, in base.

    A patch every `spacing` (m) is kept, of those that observed some curvature.
    """
    usable = [patch for patch in patches if patch.rank >= LEAST_RANK]
    return SurfaceMap(patches=tuple(spaced(usable, spacing)), path=np.asarray(path, np.float64), method=method)


# Where the surface of a map is: patches near a point, blended by distance and covariance.
#
# Each patch within `reach` gives the height of its quadric along one common normal through the query point, and its
# normal there. Patch i weighs `w_i = (1 − r_i²/reach²)² / v_i`, r_i the distance from its contact to the surface point
# and v_i the variance of its height there (from `S_covariance`: it grows with the fourth power of the distance from the
# contact). The first factor vanishes smoothly at `reach`: a patch enters and leaves without a step. The common normal
# is the blend of the patches' normals, iterated, so that the answer is the closest point.
#
# Valid within `reach` of a contact and for a point nearer to the surface than its radius of curvature; with no patch
# in reach the answer is NaN, never an extrapolation. The blend neither averages noise away in `sigma` nor knows
# of errors that all patches share (calibration, indentation): neighbours on one pass rest on the same samples.

REACH_M = 4e-3
"""Default distance from a contact at which its patch no longer counts, m."""
_ITERATIONS = 40
"""Most rounds; each shrinks the error of the normal by the height over the radius of curvature."""
_SETTLED = 1e-10
FACING = 0.5
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
    """What each patch says along one line: height (m), outward normal (base), its variance (m²), whether it is met.

    Variances are 0 where the pose is not known.
    """

    height: Array
    normal: Array
    variance: Array
    met: NDArray[np.bool_]


def closest(surface_map: SurfaceMap, point: ArrayLike, reach: float = REACH_M) -> MapPoint:
    """Closest point of a map's surface to a point (3,) nearby, base frame, m.

    `reach` (m) is the distance from a contact at which its patch no longer counts.
    """
    p, limit = checked("point", point, (3,)), positive("reach", reach)
    chosen = _candidates(surface_map, p, limit)
    nowhere = MapPoint(np.full(3, math.nan), np.full(3, math.nan), math.nan, math.nan, 0)
    if not len(chosen):
        return nowhere
    patches, contacts = [surface_map.patches[i] for i in chosen], surface_map.points[chosen]
    normal = surface_map.normals[chosen[0]]
    foot = p - normal * float(normal @ (p - contacts[0]))
    for _ in range(_ITERATIONS):
        said = _heights(patches, p, normal)
        weight = _weights(said, np.linalg.norm(contacts - foot, axis=1), limit)
        total = float(weight.sum())
        if not total > 0.0:
            return nowhere
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
    facing = surface_map.normals @ surface_map.normals[first] > FACING
    # by the triangle inequality, with room for a foot that is not below the point as seen from the nearest patch
    chosen = np.flatnonzero(facing & (distance <= 1.5 * reach + lifted))
    return chosen[np.argsort(distance[chosen], kind="stable")]


def _weights(said: _Heights, distance: Array, reach: float) -> Array:
    """(n,) weights, not yet of sum 1; variances count only where every patch in reach has one."""
    fade: Array = np.maximum(0.0, 1.0 - (distance / reach) ** 2) ** 2
    fade[~said.met] = 0.0
    near = fade > 0.0
    if not (said.variance[near] > 0.0).all():
        return fade
    fade[near] /= said.variance[near]
    return fade


def _heights(patches: Sequence[LocalPatch], p: Array, normal: Array) -> _Heights:
    """Where the line p + t·normal meets each patch."""
    T, S = np.array([patch.T_base_contact for patch in patches]), np.array([patch.S for patch in patches])
    R, B, h = T[:, :3, :3], 2.0 * S[:, :3, :3], 2.0 * S[:, :3, 3]
    x, d = ((p - T[:, :3, 3])[:, None] @ R)[:, 0], normal @ R
    gx, gd = (x[:, None] @ B)[:, 0] + h, (d[:, None] @ B)[:, 0]
    # f(x + t d) = ½ a t² + b t + c
    a, b = np.einsum("ij,ij->i", d, gd), np.einsum("ij,ij->i", d, gx)
    c = 0.5 * np.einsum("ij,ij->i", x, gx + h)
    square = b * b - 2.0 * a * c
    root = b + np.sqrt(np.maximum(square, 0.0))
    met = (square >= 0.0) & (root > 0.0)
    t = np.where(met, -2.0 * c / np.where(met, root, 1.0), 0.0)
    g = gx + t[:, None] * gd
    F = terms(x + t[:, None] * d, 9)[:, 0]  # df/dc
    slope = np.where(met, np.einsum("ij,ij->i", g, d), 1.0)
    covariance = np.array([patch.S_covariance * patch.pose_known for patch in patches])
    variance = np.einsum("ij,ijk,ik->i", F, covariance, F) / slope**2
    outward = (R @ g[:, :, None])[:, :, 0] / np.sqrt(np.einsum("ij,ij->i", g, g))[:, None]
    return _Heights(t, outward, variance, met)
