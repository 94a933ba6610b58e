"""All crossings of a map, and one verdict on whether its passes agree."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from canprobe.touch._arrays import Array, positive
from canprobe.touch.crossings import ChiSquared, Crossing, compare
from canprobe.touch.surface_map import SurfaceMap

RADIUS_M = 2e-3
"""Default largest distance between the contacts of a crossing, m."""
MEMORIES = 3.0
"""Default path between the two passes of a crossing over the longest path that a patch rests on.

With forgetting by exp(−s/memory) two answers s apart share exp(−s/memory) of their data: 5 % at three."""
LEVEL = 0.05
_FACING = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Consistency:
    """Whether the passes of a map agree where they cross.

    Attributes:
        crossings: every crossing, by its place along the path.
        share_below: share of the joint p-values below 0.05; 0.05 is expected of one surface and right covariances.
            Crossings share patches' data, so they are no independent trials. NaN without crossings.
        independent: indices of crossings no two of which share data.
        pooled: Fisher's χ² over the joint p-values of the independent ones, −2 Σ ln p with 2 n degrees of freedom.
        chi2_per_dof: over all crossings, Σ χ² / Σ dof of the joint tests; 1 where the covariances are right, less where
            they are generous. NaN without crossings.
    """

    crossings: tuple[Crossing, ...]
    share_below: float
    independent: tuple[int, ...]
    pooled: ChiSquared
    chi2_per_dof: float

    @property
    def p_values(self) -> Array:
        """(n,) of the joint tests."""
        return np.array([crossing.joint.p for crossing in self.crossings])

    @property
    def consistent(self) -> bool | None:
        """The pooled test does not reject one surface at 5 %; None where there was nothing to test."""
        return None if self.pooled.dof == 0 else self.pooled.p >= LEVEL


def find_crossings(surface_map: SurfaceMap, *, radius: float = RADIUS_M, gap: float | None = None) -> list[Crossing]:
    """Places where two passes come close, one pair of patches for each.

    Of the pairs within the radius the closest is taken; others whose contacts both lie within two radii of its
    contacts along the path are the same crossing. A path that follows itself gives one every two radii.

    Args:
        surface_map: the map.
        radius: largest distance between the contacts, m.
        gap: least path between them, m; None for `MEMORIES` times the longest memory of a patch.

    Raises:
        UsageError: naming the field, what was expected and what was got.
    """
    limit = positive("radius", radius)
    least = positive("gap", gap) if gap is not None else MEMORIES * surface_map.memory
    if not len(surface_map):
        return []
    along = surface_map.travelled
    apart = np.linalg.norm(surface_map.points[:, None] - surface_map.points[None], axis=2)
    facing = surface_map.normals @ surface_map.normals.T > _FACING
    fits = (apart <= limit) & (along[None] - along[:, None] >= least) & facing
    pairs = np.argwhere(fits)
    order = np.argsort(apart[fits], kind="stable")
    taken: list[Array] = []
    for pair in pairs[order]:
        here = along[pair]
        if all(np.abs(here - other).max() > 2.0 * limit for other in taken):
            taken.append(here)
    chosen = sorted((int(np.searchsorted(along, s)), int(np.searchsorted(along, t))) for s, t in taken)
    return [compare(surface_map.patches[i], surface_map.patches[j], i, j) for i, j in chosen]


def check_consistency(
    surface_map: SurfaceMap, *, radius: float = RADIUS_M, gap: float | None = None
) -> Consistency:
    """Test every crossing of a map and pool the independent ones; see `crossings` for what the test rests on.

    Args:
        surface_map, radius, gap: as in `find_crossings`; two crossings are independent where all four patches are at
            least the gap apart along the path.
    """
    found = find_crossings(surface_map, radius=radius, gap=gap)
    least = positive("gap", gap) if gap is not None else MEMORIES * surface_map.memory
    tested = [i for i, crossing in enumerate(found) if crossing.joint.dof]
    p = np.array([found[i].joint.p for i in tested])
    dof = sum(found[i].joint.dof for i in tested)
    chosen = _independent(surface_map, found, tested, least)
    return Consistency(
        tuple(found),
        float(np.mean(p < LEVEL)) if len(p) else math.nan,
        chosen,
        fisher([found[i].joint.p for i in chosen]),
        sum(found[i].joint.chi2 for i in tested) / dof if dof else math.nan,
    )


def _independent(surface_map: SurfaceMap, found: list[Crossing], tested: list[int], gap: float) -> tuple[int, ...]:
    """Crossings, taken in the order of their later pass, whose patches are all at least a gap from those before."""
    along = surface_map.travelled
    used: list[float] = []
    chosen = []
    for i in sorted(tested, key=lambda i: (found[i].second, -found[i].first)):
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
        return ChiSquared(0.0, 0, math.nan)
    from scipy.special import chdtrc

    chi2 = -2.0 * float(np.sum(np.log(np.maximum(p_values, 1e-300))))
    return ChiSquared(chi2, 2 * len(p_values), float(chdtrc(2 * len(p_values), chi2)))
