"""A χ² test where the contact's path crosses itself.

Two patches that are close in space but far apart along the path rest on different samples. Both are expressed in one
frame between their contacts (`S' = Tᵀ S T`, with the covariance of all nine entries of S), so that the covariance
includes extrapolation, the turn of the tangent axes and what the weak prior leaves open. In that frame the difference d
of (height, slope x, slope y, K11, K12, K22) has the covariance C = C_a + C_b. If both patches are one surface,
`χ² = dᵀ C⁻¹ d` has as many degrees of freedom as were compared:

- `curvature` compares the combinations of K that *both* passes observed;
- `normal` and `height` are compared where the estimator knows their covariance. An unobserved curvature widens them,
  beside the contact, by `surface_map.UNSEEN_CURVATURE_SIGMA`;
- `joint` compares all of it together, with the correlations between the parts.

The covariances rest on the σ's that the estimator was given, as if every sample's error were independent, and on its
prior; they are not rescaled by the innovation. On independent noise of the stated size `ml` gives uniform p-values
where c13, c23, c33 are what the prior expects; where they vanish (plane, saddle at its middle) χ² per degree of
freedom is 0.85, and with forgetting 0.83. σ's that are too large make p-values crowd towards 1. Errors that are
correlated along a pass do the opposite (hysteresis differs by direction; creep shifts whole passes). A small p does not
prove two surfaces; it proves a difference that the stated noise does not explain. `Crossing.angle` gives the angle
between the two passes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from canprobe.mechanics.touch.estimate.observed import turned
from canprobe.mechanics.touch.estimate.quadric import TO_Q
from canprobe.mechanics.touch.estimate.residuals import curvature_jacobian, transport
from canprobe.mechanics.touch.surface import SurfaceMatrix
from canprobe.mechanics.touch.surface_map import LocalPatch
from canprobe.mechanics.touch.tangent_frames import homogeneous, inverse_transform, tangent_rotation
from canprobe.mechanics.types import Floats

_MAX_UNSEEN_SHARE = 0.05
"""Largest part of a unit combination that either pass may have left unobserved."""
_HEIGHT, _SLOPE, _K = slice(0, 1), slice(1, 3), slice(3, 6)


class ChiSquared(NamedTuple):
    """One test.

    Attributes:
        chi2: test statistic.
        dof: degrees of freedom; 0 where nothing could be compared.
        p: probability of a larger χ² if both passes measured one surface; NaN where nothing could be compared.
    """

    chi2: float
    dof: int
    p: float


NO_TEST = ChiSquared(0.0, 0, math.nan)


@dataclass(frozen=True, slots=True, eq=False)
class Crossing:
    """Two passes over one place.

    Attributes:
        first, second: indices of the patches in the map, the earlier one first.
        gap_m: path between them, m.
        distance_m: distance between their contacts, m.
        angle: angle between the directions of travel, rad, 0…π; NaN where the path does not show it.
        T_base_common: (4, 4) frame of the comparison to base, m; its z is the inward normal.
        difference: (6,) second − first: height along z (m), slopes of z in x and y, K11, K12, K22 (1/m).
        covariance: (6, 6) covariance of the difference by the stated noise; what was not observed has the variance of
            `surface_map.UNSEEN_CURVATURE_SIGMA`.
        curvature, normal, height, joint: the tests.
    """

    first: int
    second: int
    gap_m: float
    distance_m: float
    angle: float
    T_base_common: Floats
    difference: Floats
    covariance: Floats
    curvature: ChiSquared
    normal: ChiSquared
    height: ChiSquared
    joint: ChiSquared


class _Jet(NamedTuple):
    """Height, slopes and K (6,) over the origin of a frame, their covariance, and what was not observed of q (m, 3)."""

    values: Floats
    covariance: Floats
    hidden: Floats


def compare(a: LocalPatch, b: LocalPatch, first: int = 0, second: int = 1, angle: float = math.nan) -> Crossing:
    """Test whether two patches from different samples, their normals within 90°, describe one surface.

    The local models must hold between the two contacts: keep them within a few mm. Indices and the angle between the
    directions of travel (rad) are only noted.
    """
    z = -(a.normal + b.normal)
    T = homogeneous(tangent_rotation(z / math.sqrt(float(z @ z))), 0.5 * (a.point + b.point))
    ja, jb = _jet(a, T), _jet(b, T)
    d, C = jb.values - ja.values, ja.covariance + jb.covariance
    k_rows = _seen_by_both(ja.hidden, jb.hidden)
    eye = np.eye(6)
    pose = a.pose_known and b.pose_known
    height, slope = (eye[_HEIGHT], eye[_SLOPE]) if pose else (eye[:0], eye[:0])
    return Crossing(
        first,
        second,
        abs(b.travelled_m - a.travelled_m),
        float(np.linalg.norm(b.point - a.point)),
        angle,
        T,
        d,
        C,
        curvature=_chi_squared(k_rows, d, C),
        normal=_chi_squared(slope, d, C),
        height=_chi_squared(height, d, C),
        joint=_chi_squared(np.concatenate([height, slope, k_rows]), d, C),
    )


def _jet(patch: LocalPatch, T_base_common: Floats) -> _Jet:
    T = inverse_transform(patch.T_base_contact) @ T_base_common
    c, M = transport(patch.c, T)
    surface = SurfaceMatrix(T.T @ patch.S @ T)
    z = float(surface.height(0.0, 0.0))
    g = surface.gradient([0.0, 0.0, z])
    K, basis = surface.curvature_at([0.0, 0.0, z])
    flat = basis[:2] @ K @ basis[:2].T
    # the frame is nearly the patch's own: its slope is small, and the gauge's Jacobian holds
    J = np.zeros((6, 9))
    J[0, 2], J[1, 0], J[2, 1] = 1.0, 2.0, 2.0
    J[_K] = curvature_jacobian(c)
    J = J @ M
    angle = math.atan2(T[1, 0] - T[0, 1], T[0, 0] + T[1, 1])
    Q = patch.combinations @ turned(angle).T
    return _Jet(
        np.array([z, -g[0] / g[2], -g[1] / g[2], flat[0, 0], flat[0, 1], flat[1, 1]]),
        J @ patch.S_covariance @ J.T,
        np.eye(3) - Q.T @ Q,
    )


def _seen_by_both(hidden_a: Floats, hidden_b: Floats) -> Floats:
    """(k, 6) rows that pick the combinations of K of which neither pass left more than `_MAX_UNSEEN_SHARE` open."""
    _, size, Vt = np.linalg.svd(np.concatenate([hidden_a, hidden_b]))
    seen = Vt[size < _MAX_UNSEEN_SHARE]
    rows = np.zeros((len(seen), 6))
    rows[:, _K] = seen * TO_Q
    return rows


def _chi_squared(rows: Floats, d: Floats, C: Floats) -> ChiSquared:
    if not len(rows):
        return NO_TEST
    e, V = rows @ d, rows @ C @ rows.T
    scale = 1.0 / np.sqrt(np.diag(V))  # metres beside 1/m
    e, V = e * scale, V * np.outer(scale, scale)
    return chi_squared_test(float(e @ np.linalg.solve(V, e)), len(rows))


def chi_squared_test(chi2: float, dof: int) -> ChiSquared:
    """A statistic with its p-value."""
    from scipy.special import chdtrc  # here, as it takes long to load and only a test of crossings needs it

    return ChiSquared(chi2, dof, float(chdtrc(dof, chi2)))
