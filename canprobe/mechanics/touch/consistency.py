"""Do two passes over one place show the same surface? Every crossing of a map is tested, with one verdict on all."""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from canprobe.errors import UsageError
from canprobe.mechanics.touch.blend import MIN_FACING_COSINE
from canprobe.mechanics.touch.crossings import NO_TEST, ChiSquared, Crossing, chi_squared_test, compare
from canprobe.mechanics.touch.linear_algebra import positive
from canprobe.mechanics.touch.surface_map import SurfaceMap
from canprobe.mechanics.types import Floats

CROSSING_RADIUS_M = 2e-3
"""Default largest distance between the contacts of a crossing, m."""
MEMORY_SCALE = 3.0
"""Default path between the two passes of a crossing over the longest path that a patch rests on.

With forgetting by exp(−s/memory) two answers s apart share exp(−s/memory) of their data: 5 % at three."""
SIGNIFICANCE_LEVEL = 0.05
"""Probability below which a test counts as failed."""
PARTS = ("curvature", "normal", "height", "joint")


class ConsistencyVerdict(NamedTuple):
    """One part of the tests over all crossings.

    Attributes:
        tested: number of crossings where it could be tested.
        share_below: share of the p-values below 0.05; 0.05 is expected of one surface and right covariances. Crossings
            share patches' data, so they are not independent trials. NaN where nothing was tested.
        chi2_per_dof: Σ χ² / Σ dof; 1 where the covariances are right, less where they are too large. NaN where nothing
            was tested.
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

    def verdict(self, part: str = "joint", angles: tuple[float, float] = (0.0, math.inf)) -> ConsistencyVerdict:
        """The tests of one part, over the crossings whose passes differ in direction by an angle in a range.

        Args:
            part: "curvature", "normal", "height" or "joint".
            angles: least angle, and the angle (rad) below which all must be; crossings whose angle is not known count
                only in the whole range.

        Raises:
            UsageError: the part is unknown.
        """
        if part not in PARTS:
            raise UsageError(f"part: expected one of {', '.join(PARTS)}, got {part!r}")
        whole = angles == (0.0, math.inf)
        chosen = [i for i, c in enumerate(self.crossings) if whole or angles[0] <= c.angle < angles[1]]
        tests = {i: getattr(self.crossings[i], part) for i in chosen}
        tests = {i: test for i, test in tests.items() if test.dof}
        dof = sum(test.dof for test in tests.values())
        if not dof:
            return ConsistencyVerdict(0, math.nan, math.nan, fisher([]))
        return ConsistencyVerdict(
            len(tests),
            sum(test.p < SIGNIFICANCE_LEVEL for test in tests.values()) / len(tests),
            sum(test.chi2 for test in tests.values()) / dof,
            fisher([tests[i].p for i in self.independent if i in tests]),
        )

    @property
    def consistent(self) -> bool | None:
        """The pooled joint test does not reject one surface at 5 %; None where there was nothing to test."""
        pooled = self.verdict().pooled
        return None if pooled.dof == 0 else pooled.p >= SIGNIFICANCE_LEVEL


def find_crossings(
    surface_map: SurfaceMap, *, radius: float = CROSSING_RADIUS_M, gap: float | None = None
) -> list[Crossing]:
    """Places where two passes come close, one pair of patches for each; radius and gap as for `check_consistency`.

    The closest of the pairs within the radius is taken; others whose contacts both lie within two radii of its contacts
    along the path are the same crossing. A path that follows itself gives one crossing every two radii.
    """
    limit = positive("radius", radius)
    least = positive("gap", gap) if gap is not None else MEMORY_SCALE * surface_map.memory
    if not len(surface_map):
        return []
    along = surface_map.travelled
    pairs = _close_pairs(surface_map, limit)
    pairs = pairs[along[pairs[:, 1]] - along[pairs[:, 0]] >= least]
    # two pairs are one crossing where they are near each other in the plane (path to the first, path to the second)
    places, left = along[pairs], np.ones(len(pairs), bool)
    tree, chosen = cKDTree(places), []
    for k, (i, j) in enumerate(pairs.tolist()):
        if left[k]:
            chosen.append((i, j))
            left[tree.query_ball_point(places[k], 2.0 * limit, p=math.inf)] = False
    heading = _headings(surface_map)
    found = []
    for i, j in sorted(chosen):
        sine, cosine = float(np.linalg.norm(np.cross(heading[i], heading[j]))), float(heading[i] @ heading[j])
        found.append(compare(surface_map.patches[i], surface_map.patches[j], i, j, math.atan2(sine, cosine)))
    return found


def _close_pairs(surface_map: SurfaceMap, radius: float) -> NDArray[np.intp]:
    """(m, 2) pairs i < j of patches within a radius that face one way, the closest first."""
    points, normals = surface_map.points, surface_map.normals
    pairs = cKDTree(points).query_pairs(radius, output_type="ndarray")
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    first, second = pairs.T
    facing = np.einsum("ij,ij->i", normals[first], normals[second]) > MIN_FACING_COSINE
    apart = np.linalg.norm(points[first] - points[second], axis=1)
    closest_first: NDArray[np.intp] = pairs[facing][np.argsort(apart[facing], kind="stable")]
    return closest_first


def _headings(surface_map: SurfaceMap) -> Floats:
    """(n, 3) unit direction of travel at each patch, from the patch before; the first has the second's; NaN at rest."""
    steps = np.diff(surface_map.points, axis=0)
    sizes = np.linalg.norm(steps, axis=1, keepdims=True)
    headings: Floats = steps / np.where(sizes > 0.0, sizes, math.nan)
    return np.concatenate([headings[:1], headings])


def check_consistency(
    surface_map: SurfaceMap, *, radius: float = CROSSING_RADIUS_M, gap: float | None = None
) -> Consistency:
    """Test every crossing of a map and pool the independent ones; see `compare` for what the test rests on.

    Args:
        surface_map: the map.
        radius: largest distance between the contacts of a crossing, m.
        gap: least path between them, and between the patches of independent crossings, m; None for `MEMORY_SCALE` times
            the longest memory of a patch.
    """
    least = positive("gap", gap) if gap is not None else MEMORY_SCALE * surface_map.memory
    found = find_crossings(surface_map, radius=radius, gap=gap)
    return Consistency(tuple(found), _independent(surface_map, found, least))


def _independent(surface_map: SurfaceMap, found: list[Crossing], gap: float) -> tuple[int, ...]:
    """Crossings, taken in the order of their later pass, whose patches are all at least a gap from those before."""
    along = surface_map.travelled
    used: list[float] = []  # sorted: only the neighbours of a place can be nearer to it than the gap
    chosen: list[int] = []
    for i in sorted(range(len(found)), key=lambda i: (found[i].second, -found[i].first)):
        places = along[[found[i].first, found[i].second]].tolist()
        near = [other for place in places for other in _neighbours(used, place) if abs(place - other) < gap]
        if not near:
            for place in places:
                insort(used, place)
            chosen.append(i)
    return tuple(sorted(chosen))


def _neighbours(values: list[float], value: float) -> list[float]:
    """The nearest of sorted values below and above a value."""
    above = bisect_left(values, value)
    return values[max(above - 1, 0) : above + 1]


def fisher(p_values: list[float]) -> ChiSquared:
    """Fisher's pooled χ² of independent p-values, −2 Σ ln p with 2 n degrees of freedom.

    Source: R. A. Fisher, Statistical Methods for Research Workers, 4th ed., 1932, §21.1.
    """
    if not p_values:
        return NO_TEST
    return chi_squared_test(-2.0 * float(np.sum(np.log(np.maximum(p_values, 1e-300)))), 2 * len(p_values))
