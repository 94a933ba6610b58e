"""A whole scan as one description: local patches along the contact's path, and the surface that they make.

Source: Chen, Rink and Zhang, "Local object shape from tactile sensing": an object is described by a set of local
contact frames with their surface matrices.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, fields
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from canprobe.errors import UsageError
from canprobe.mechanics.touch.blend import REACH_M, Feet, Quadrics, feet_on
from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate
from canprobe.mechanics.touch.estimate.quadric import C_PER_Q, TO_Q, parameters_of
from canprobe.mechanics.touch.linear_algebra import checked, positive, read_only
from canprobe.mechanics.touch.meshing import CELL_M, Mesh, mesh_of
from canprobe.mechanics.touch.surface import SurfaceMatrix
from canprobe.mechanics.types import Floats

UNSEEN_CURVATURE_SIGMA = 10.0
"""Standard deviation of a combination of curvature that was not observed, times the path that the estimate rests on:
±500 1/m for 20 mm, a radius of 2 mm. It only widens the covariance of heights and normals beside the contact."""
MIN_LENGTH_M = 1e-3
"""Least path of an estimate for that standard deviation, m; a shorter one counts as this long."""

_SHAPES: dict[str, tuple[int | None, ...]] = {
    "T_base_contact": (4, 4),
    "S": (4, 4),
    "S_covariance": (9, 9),
    "observed": (2,),
    "combinations": (None, 3),
}
_Q_TO_C = C_PER_Q[:, None]


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class LocalPatch:
    """A quadric that describes the surface near one contact.

    Attributes:
        T_base_contact: (4, 4) contact frame to base, m; z is the inward normal.
        S: (4, 4) surface matrix in the contact frame, c14 = c24 = c44 = 0, c34 = −½; unobserved combinations nearest to
            flat.
        K_covariance: (3, 3) covariance of (K11, K12, K22), 1/m²; NaN or infinite where not observed, as in
            `SurfaceEstimate`.
        S_covariance: (9, 9) covariance of (c14, c24, c44, c13, c23, c33, c11, c12, c22), SI units, always finite: a
            combination that the data did not observe has the variance of `UNSEEN_CURVATURE_SIGMA` there, whatever the
            prior. c44 is the height, 2 c14 and 2 c24 are the tilt.
        pose_known: whether the part of `S_covariance` about height and tilt is known; False from methods that do not
            know it and leave zeros there.
        observed: (2,) 1 or 0, for each principal curvature.
        combinations: (rank, 3) rows: the observed combinations, as weights of (K11, √2 K12, K22).
        t_s: instant of the last sample, s.
        travelled_m: path of the contact until then, m.
        distance_m: path that the patch rests on, m; patches that are nearer along the path share data.
        innovation: mean squared whitened residual per degree of freedom; well below 1 where the σ's are too large.
    """

    T_base_contact: Floats
    S: Floats
    K_covariance: Floats
    S_covariance: Floats
    pose_known: bool
    observed: Floats
    combinations: Floats
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
        """Number of observed combinations of curvature, 0–3."""
        return len(self.combinations)

    @property
    def point(self) -> Floats:
        """(3,) contact point, base frame, m."""
        return self.T_base_contact[:3, 3]

    @property
    def normal(self) -> Floats:
        """(3,) outward unit normal there, base frame."""
        return -self.T_base_contact[:3, 2]

    @property
    def surface(self) -> SurfaceMatrix:
        """`S` with its operations, in the contact frame."""
        return SurfaceMatrix(self.S)

    @property
    def c(self) -> Floats:
        """(9,) entries of `S` in the order of `S_covariance`, SI units."""
        return parameters_of(self.S)

    def equals(self, other: LocalPatch) -> bool:
        """Whether every field is the same, bit by bit (NaN equals NaN)."""
        return all(
            np.array_equal(np.asarray(getattr(self, f.name), float), np.asarray(getattr(other, f.name), float), True)
            for f in fields(self)
        )


def _covariance(estimate: SurfaceEstimate) -> Floats:
    """(9, 9) finite covariance of the entries of S, SI units."""
    length = max(estimate.distance, MIN_LENGTH_M)
    weak = UNSEEN_CURVATURE_SIGMA / length
    V = estimate.combinations.T
    if estimate.model_root is None:
        P = np.zeros((9, 9))
        P[6:, 6:] = _Q_TO_C * _curvature_covariance(estimate, V, weak) * _Q_TO_C.T
        return P
    units = np.array([1.0, 1.0, 1.0 / length] + 6 * [length])
    root = estimate.model_root / units  # dimensionless, or the inverse would lose its digits
    if estimate.rank < 3:
        # noise in the regressors looks like information about unobserved combinations: it is replaced by a wide prior
        open_ = np.eye(3) - V @ V.T
        root = np.concatenate([root, np.zeros((3, 9))])
        root[:-3, 6:] = root[:-3, 6:] @ (_Q_TO_C * (V @ V.T) / _Q_TO_C.T)
        root[-3:, 6:] = open_ / C_PER_Q / UNSEEN_CURVATURE_SIGMA
    if len(root) > 9:
        root = np.linalg.qr(root, mode="r")
    inverse = np.linalg.inv(root)
    result: Floats = inverse @ inverse.T / np.outer(units, units)
    return 0.5 * (result + result.T)


def _curvature_covariance(estimate: SurfaceEstimate, V: Floats, weak: float) -> Floats:
    """(3, 3) covariance of q = (K11, √2 K12, K22), what was not observed held wide, 1/m²."""
    if estimate.rank == 3:
        return estimate.covariance * np.outer(TO_Q, TO_Q)
    seen = V @ np.linalg.inv(V.T @ estimate.information @ V) @ V.T
    result: Floats = seen + weak**2 * (np.eye(3) - V @ V.T)
    return result


SPACING_M = 2e-3
"""Path from one patch to the next, m: well below the radius of what a probe can touch, so that neighbours overlap."""
MIN_RANK = 1
"""Least number of observed combinations of curvature of a patch in a map."""


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SurfaceMap:
    """Local patches in the order in which they were measured, and the path of the contact.

    Attributes:
        patches: patches, each with its frame, matrix and covariance, by increasing `travelled_m`.
        path: (n, 3) contact points, base frame, m.
        method: name of the estimator that made the patches.
        points: (m, 3) contact points of the patches, base frame, m.
        normals: (m, 3) outward unit normals there.
        travelled: (m,) path of the contact until each patch, m.
    """

    patches: tuple[LocalPatch, ...]
    path: Floats
    method: str = ""
    points: Floats = field(init=False, repr=False)
    normals: Floats = field(init=False, repr=False)
    travelled: Floats = field(init=False, repr=False)

    def __post_init__(self) -> None:
        def keep(name: str, values: ArrayLike) -> None:
            object.__setattr__(self, name, read_only(values))

        keep("path", checked("path", self.path, (None, 3)))
        if not (isinstance(self.patches, tuple) and all(isinstance(patch, LocalPatch) for patch in self.patches)):
            raise UsageError(f"patches: expected a tuple of LocalPatch, got {self.patches!r}")
        keep("points", np.array([patch.point for patch in self.patches]).reshape(-1, 3))
        keep("normals", np.array([patch.normal for patch in self.patches]).reshape(-1, 3))
        keep("travelled", [patch.travelled_m for patch in self.patches])
        along = [patch.travelled_m for patch in self.patches]
        for i, (before, after) in enumerate(pairwise(along), start=1):
            if after < before:
                raise UsageError(
                    f"patches[{i}].travelled_m: expected at least {before} of the one before, got {after}; patches"
                    " stand in the order in which they were measured"
                )

    def __len__(self) -> int:
        return len(self.patches)

    def __iter__(self) -> Iterator[LocalPatch]:
        return iter(self.patches)

    @property
    def memory(self) -> float:
        """Longest path that a patch rests on, m; 0 without patches."""
        return max((patch.distance_m for patch in self.patches), default=0.0)

    def closest(self, points: ArrayLike, *, reach: float = REACH_M) -> Feet:
        """The points of the map's surface that are closest to given points, with normals and uncertainty.

        The surface is one: the blend of the patches (`touch/blend.py`), continuous where they overlap.

        Args:
            points: (n, 3) base frame, m.
            reach: distance from a contact at which its patch no longer counts, m.

        Returns:
            Feet with one row a point; NaN where no patch is in reach.

        Raises:
            UsageError: the points are not finite (n, 3), or the reach is not positive.
        """
        return feet_on(self._quadrics(), checked("points", points, (None, 3)), positive("reach", reach))

    def distance(self, points: ArrayLike, *, reach: float = REACH_M) -> tuple[Floats, Floats]:
        """Signed distances of points from the map's surface, positive outside, and their standard deviations.

        Args:
            points, reach: as for `closest`.

        Returns:
            Two arrays (n,), m; NaN where no patch is in reach, and σ also where no patch in reach knows its height.

        Raises:
            UsageError: as for `closest`.
        """
        feet = self.closest(points, reach=reach)
        return feet.height, feet.sigma

    def mesh(self, *, cell: float = CELL_M, reach: float = REACH_M) -> Mesh:
        """The map's surface as triangles with its σ at every vertex; it ends up to two cells inside the reach.

        Args:
            cell: side of a cell of the lattice in the base frame, about an edge of a triangle, m. The vertices lie
                on the surface whatever it is; time grows with 1/cell².
            reach: distance from a contact at which its patch no longer counts, m.

        Raises:
            UsageError: `cell` or `reach` is not positive, or `cell` is too small for the size of the coordinates.
        """
        patches, limit = self._quadrics(), positive("reach", reach)
        return mesh_of(lambda points: feet_on(patches, points, limit), self.points, positive("cell", cell))

    def _quadrics(self) -> Quadrics:
        return Quadrics.of(
            np.array([patch.T_base_contact for patch in self.patches]).reshape(-1, 4, 4),
            np.array([patch.S for patch in self.patches]).reshape(-1, 4, 4),
            np.array([patch.S_covariance for patch in self.patches]).reshape(-1, 9, 9),
            np.array([patch.pose_known for patch in self.patches], bool),
        )

    def equals(self, other: SurfaceMap) -> bool:
        """Whether patches, path and method are the same, bit by bit."""
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
    usable = [patch for patch in patches if patch.rank >= MIN_RANK]
    return SurfaceMap(patches=tuple(spaced(usable, spacing)), path=np.asarray(path, np.float64), method=method)
