"""Do two passes over one place show the same surface? Every crossing of a map is tested, with one verdict on all."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from canprobe.errors import UsageError
from canprobe.mechanics.touch.blend import FACING
from canprobe.mechanics.touch.estimate.quadric import TO_Q, curvature_jacobian, transport, turned
from canprobe.mechanics.touch.linear_algebra import Array, homogeneous, inverse_transform, positive, tangent_rotation
from canprobe.mechanics.touch.surface import SurfaceMatrix
from canprobe.mechanics.touch.surface_map import LocalPatch, SurfaceMap

# A χ² test where the contact's path crosses itself.
#
# Two patches that are close in space but far apart along the path were felt from different samples. Both are expressed
# in one frame between their contacts (`S' = Tᵀ S T`, the covariance of all nine entries of S carried along), so that
# extrapolation, the turn of the tangent axes and what the weak prior leaves open are in the covariance. There the
# difference d of (height, slope x, slope y, K11, K12, K22) has the covariance C = C_a + C_b, and under "same surface"
# `χ² = dᵀ C⁻¹ d` with as many degrees of freedom as were compared:
#
# - of K only the combinations that *both* passes observed;
# - slope and height where the estimator knows their covariance. An unobserved curvature widens them, beside the
#   contact, by `surface_map.WIDE`;
# - `joint` is all of it together, with the correlations between the parts.
#
# The covariances rest on the σ's that the estimator was given, as if every sample's error were independent, and on its
# prior; they are not rescaled by the innovation. On independent noise of the stated size `ml` gives uniform p-values
# where c13, c23, c33 are what the prior expects; where they vanish (plane, saddle at its middle) χ² per degree of
# freedom is 0.85, and with forgetting 0.83. Generous σ's make p-values crowd towards 1. Errors that are correlated
# along a pass do the opposite (hysteresis differs by direction; creep shifts whole passes). A small p is no proof of
# two surfaces, but of a difference that the stated noise does not explain; `Crossing.angle` says how they ran.

_UNSEEN = 0.05
"""Largest part of a unit combination that either pass may have left unobserved."""
_HEIGHT, _SLOPE, _K = slice(0, 1), slice(1, 3), slice(3, 6)


class ChiSquared(NamedTuple):
    """One test.

    Attributes:
        chi2: statistic.
        dof: degrees of freedom; 0 where nothing could be compared.
        p: probability of a larger χ² if both passes felt one surface; NaN where nothing could be compared.
    """

    chi2: float
    dof: int
    p: float


NOTHING = ChiSquared(0.0, 0, math.nan)


@dataclass(frozen=True, slots=True, eq=False)
class Crossing:
    """Two passes over one place.

    Attributes:
        first, second: indices of the patches in the map, the earlier one first.
        gap_m: path between them, m.
        distance_m: between their contacts, m.
        angle: between the directions of travel, rad, 0…π; NaN where the path does not tell.
        T_base_common: (4, 4) the frame of the comparison; its z is the inward normal.
        difference: (6,) second − first: height along z (m), slopes of z in x and y, K11, K12, K22 (1/m).
        covariance: (6, 6) of it by the stated noise; what was not observed stands with `surface_map.WIDE`.
        curvature, normal, height, joint: the tests.
    """

    first: int
    second: int
    gap_m: float
    distance_m: float
    angle: float
    T_base_common: Array
    difference: Array
    covariance: Array
    curvature: ChiSquared
    normal: ChiSquared
    height: ChiSquared
    joint: ChiSquared


class _Jet(NamedTuple):
    """Height, slopes and K (6,) over the origin of a frame, their covariance, and what was not observed of q (m, 3)."""

    values: Array
    covariance: Array
    hidden: Array


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


def _jet(patch: LocalPatch, T_base_common: Array) -> _Jet:
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


def _seen_by_both(hidden_a: Array, hidden_b: Array) -> Array:
    """(k, 6) rows that pick the combinations of K of which neither pass left more than `_UNSEEN` open."""
    _, size, Vt = np.linalg.svd(np.concatenate([hidden_a, hidden_b]))
    seen = Vt[size < _UNSEEN]
    rows = np.zeros((len(seen), 6))
    rows[:, _K] = seen * TO_Q
    return rows


def _chi_squared(rows: Array, d: Array, C: Array) -> ChiSquared:
    if not len(rows):
        return NOTHING
    e, V = rows @ d, rows @ C @ rows.T
    scale = 1.0 / np.sqrt(np.diag(V))  # metres beside 1/m
    e, V = e * scale, V * np.outer(scale, scale)
    return _tested(float(e @ np.linalg.solve(V, e)), len(rows))


def _tested(chi2: float, dof: int) -> ChiSquared:
    from scipy.special import chdtrc

    return ChiSquared(chi2, dof, float(chdtrc(dof, chi2)))


# All crossings of a map.

RADIUS_M = 2e-3
"""Default largest distance between the contacts of a crossing, m."""
MEMORIES = 3.0
"""Default path between the two passes of a crossing over the longest path that a patch rests on.

With forgetting by exp(−s/memory) two answers s apart share exp(−s/memory) of their data: 5 % at three."""
LEVEL = 0.05
PARTS = ("curvature", "normal", "height", "joint")


class Verdict(NamedTuple):
    """One part of the tests over all crossings.

    Attributes:
        tested: crossings where it could be tested.
        share_below: share of the p-values below 0.05; 0.05 is expected of one surface and right covariances. Crossings
            share patches' data, so they are no independent trials. NaN where nothing was tested.
        chi2_per_dof: Σ χ² / Σ dof; 1 where the covariances are right, less where they are generous. NaN likewise.
        pooled: Fisher's χ² over the p-values of independent crossings, −2 Σ ln p with 2 n degrees of freedom.
    """

    tested: int
    share_below: float
    chi2_per_dof: float
    pooled: ChiSquared


@dataclass(frozen=True, slots=True, eq=False)
class Consistency:
    """Whether the passes of a map agree where they cross.

    Attributes:
        crossings: every crossing, by its place along the path.
        independent: indices of crossings no two of which share data.
    """

    crossings: tuple[Crossing, ...]
    independent: tuple[int, ...]

    def verdict(self, part: str = "joint", angles: tuple[float, float] = (0.0, math.inf)) -> Verdict:
        """The tests of one part, over the crossings whose passes differ in direction by an angle in a range.

        Args:
            part: "curvature", "normal", "height" or "joint".
            angles: from, up to (rad); crossings whose angle is not known count only in the whole range.

        Raises:
            UsageError: on an unknown part.
        """
        if part not in PARTS:
            raise UsageError(f"part: expected one of {', '.join(PARTS)}, got {part!r}")
        whole = angles == (0.0, math.inf)
        chosen = [i for i, c in enumerate(self.crossings) if whole or angles[0] <= c.angle < angles[1]]
        tests = {i: getattr(self.crossings[i], part) for i in chosen}
        tests = {i: test for i, test in tests.items() if test.dof}
        dof = sum(test.dof for test in tests.values())
        if not dof:
            return Verdict(0, math.nan, math.nan, fisher([]))
        return Verdict(
            len(tests),
            sum(test.p < LEVEL for test in tests.values()) / len(tests),
            sum(test.chi2 for test in tests.values()) / dof,
            fisher([tests[i].p for i in self.independent if i in tests]),
        )

    @property
    def consistent(self) -> bool | None:
        """The pooled joint test does not reject one surface at 5 %; None where there was nothing to test."""
        pooled = self.verdict().pooled
        return None if pooled.dof == 0 else pooled.p >= LEVEL


def find_crossings(surface_map: SurfaceMap, *, radius: float = RADIUS_M, gap: float | None = None) -> list[Crossing]:
    """Places where two passes come close, one pair of patches for each; radius, gap: as of `check_consistency`.

    Of the pairs within the radius the closest is taken; others whose contacts both lie within two radii of its
    contacts along the path are the same crossing. A path that follows itself gives one every two radii.
    """
    limit = positive("radius", radius)
    least = positive("gap", gap) if gap is not None else MEMORIES * surface_map.memory
    if not len(surface_map):
        return []
    along = surface_map.travelled
    apart = np.linalg.norm(surface_map.points[:, None] - surface_map.points[None], axis=2)
    facing = surface_map.normals @ surface_map.normals.T > FACING
    fits = np.triu((apart <= limit) & (along[None] - along[:, None] >= least) & facing, 1)
    pairs = np.argwhere(fits)[np.argsort(apart[fits], kind="stable")]
    chosen: list[tuple[int, int]] = []
    while len(pairs):
        chosen.append((int(pairs[0, 0]), int(pairs[0, 1])))
        pairs = pairs[np.abs(along[pairs] - along[pairs[0]]).max(axis=1) > 2.0 * limit]
    heading = _headings(surface_map)
    return [
        compare(surface_map.patches[i], surface_map.patches[j], i, j, _angle(heading[i], heading[j]))
        for i, j in sorted(chosen)
    ]


def _headings(surface_map: SurfaceMap) -> Array:
    """(n, 3) unit direction of travel at each patch, from the patch before; the first as the second; NaN at rest."""
    steps = np.diff(surface_map.points, axis=0)
    sizes = np.linalg.norm(steps, axis=1, keepdims=True)
    headings: Array = steps / np.where(sizes > 0.0, sizes, math.nan)
    return np.concatenate([headings[:1], headings])


def _angle(a: Array, b: Array) -> float:
    return math.atan2(float(np.linalg.norm(np.cross(a, b))), float(a @ b))


def check_consistency(surface_map: SurfaceMap, *, radius: float = RADIUS_M, gap: float | None = None) -> Consistency:
    """Test every crossing of a map and pool the independent ones; see `compare` for what the test rests on.

    Args:
        surface_map: the map.
        radius: largest distance between the contacts of a crossing, m.
        gap: least path between them, and between the patches of independent crossings, m; None for `MEMORIES` times
            the longest memory of a patch.
    """
    least = positive("gap", gap) if gap is not None else MEMORIES * surface_map.memory
    found = find_crossings(surface_map, radius=radius, gap=gap)
    return Consistency(tuple(found), _independent(surface_map, found, least))


def _independent(surface_map: SurfaceMap, found: list[Crossing], gap: float) -> tuple[int, ...]:
    """Crossings, taken in the order of their later pass, whose patches are all at least a gap from those before."""
    along = surface_map.travelled
    used: list[float] = []
    chosen: list[int] = []
    for i in sorted(range(len(found)), key=lambda i: (found[i].second, -found[i].first)):
        places = along[[found[i].first, found[i].second]]
        if all(abs(place - other) >= gap for place in places for other in used):
            used += places.tolist()
            chosen.append(i)
    return tuple(sorted(chosen))


def fisher(p_values: list[float]) -> ChiSquared:
    """Fisher's pooled χ² of independent p-values, −2 Σ ln p with 2 n degrees of freedom.

    Source: R. A. Fisher, Statistical Methods for Research Workers, 4th ed., 1932, §21.1.
    """
    if not p_values:
        return NOTHING
    return _tested(-2.0 * float(np.sum(np.log(np.maximum(p_values, 1e-300)))), 2 * len(p_values))
