"""Surfaces of local quadrics along the contact's path, for the methods that answer at one place at a time."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from canprobe.cell.tasks.shape import ShapeRecord
from canprobe.lab.studies.shapes.blend import Quadrics, feet_on
from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate
from canprobe.mechanics.touch.estimate.quadric import C_PER_Q, TO_Q
from canprobe.mechanics.touch.map.surface_map import REACH_M
from canprobe.mechanics.touch.meshing import Feet
from canprobe.mechanics.types import Floats

SPACING_M = 2e-3
"""Path from one patch to the next, m: well below the radius of what a probe can touch, so that neighbours overlap."""
UNSEEN_CURVATURE_SIGMA = 10.0
"""Standard deviation of a combination of curvature that was not observed, times the path that the estimate rests on:
±500 1/m for 20 mm, a radius of 2 mm. It only widens the covariance of heights and normals beside the contact."""
MIN_LENGTH_M = 1e-3
"""Least path of an estimate for that standard deviation, m; a shorter one counts as this long."""
_Q_TO_C = C_PER_Q[:, None]


class LocalPatch(NamedTuple):
    """A quadric that describes the surface near one contact.

    Attributes:
        T_base_contact: (4, 4) contact frame to base, m; z is the inward normal.
        S: (4, 4) surface matrix in the contact frame, c14 = c24 = c44 = 0, c34 = −½; unobserved combinations nearest to
            flat.
        covariance: (9, 9) covariance of (c14, c24, c44, c13, c23, c33, c11, c12, c22), SI units, always finite: a
            combination that the data did not observe has the variance of `UNSEEN_CURVATURE_SIGMA` there, whatever the
            prior. c44 is the height, 2 c14 and 2 c24 are the tilt.
        height_known: whether height and tilt have a known covariance; the others leave zeros there.
    """

    T_base_contact: Floats
    S: Floats
    covariance: Floats
    height_known: bool = True


def patch_of(estimate: SurfaceEstimate) -> LocalPatch:
    """The patch of one estimate in the base frame."""
    return LocalPatch(estimate.T_frame_contact, estimate.S, _covariance(estimate), estimate.model_root is not None)


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


def spaced(records: Iterable[ShapeRecord], spacing: float = SPACING_M) -> list[ShapeRecord]:
    """The first answer at or after every multiple of a spacing (m) along the path, of those that observed a curvature.

    A contact at rest adds none.
    """
    kept: list[ShapeRecord] = []
    last, start = -1, None
    for record in records:
        if not record.estimate.rank:
            continue
        start = record.travelled_m if start is None else start
        cell = int((record.travelled_m - start) / spacing + 1e-9)
        if cell > last:
            kept.append(record)
            last = cell
    return kept


class PatchSurface:
    """The one surface of patches, the blend of those near a place; its curvature is that of the nearest patch.

    Attributes:
        points: (n, 3) contact points of the patches, m.
    """

    def __init__(self, patches: Sequence[LocalPatch]) -> None:
        T, S = (np.array([one[k] for one in patches]).reshape(-1, 4, 4) for k in (0, 1))
        covariance = np.array([one.covariance for one in patches]).reshape(-1, 9, 9)
        self._quadrics = Quadrics.of(T, S, covariance, np.array([one.height_known for one in patches], bool))
        self._tensors = 2.0 * T[:, :3, :2] @ S[:, :2, :2] @ T[:, :3, :2].transpose(0, 2, 1)
        self.points = T[:, :3, 3]

    def closest(self, points: Floats) -> Feet:
        """Closest points of the surface to points (n, 3), m; NaN where no patch is within `REACH_M`."""
        return feet_on(self._quadrics, np.asarray(points, np.float64), REACH_M)

    def sigma(self, points: Floats) -> Floats:
        """Standard deviations of the height at points (n, 3), m; NaN where no patch within reach knows its own."""
        return self.closest(points).sigma

    def curvature(self, points: Floats) -> Floats:
        """Curvature tensors at points (n, 3, 3), base frame, 1/m."""
        if not len(self.points):
            return np.full((len(points), 3, 3), math.nan)
        apart, nearest = cKDTree(self.points).query(points)
        return np.where(np.less(apart, REACH_M)[:, None, None], self._tensors[nearest], math.nan)
