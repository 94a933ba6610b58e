"""The surface map of a scan, and its section of the summary."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from canprobe.cell.tasks.shape import ShapeRecord, ShapeTracker
from canprobe.mechanics.touch.consistency import CROSSING_RADIUS_M, PARTS, Consistency, check_consistency
from canprobe.mechanics.touch.surface_map import LocalPatch, SurfaceMap, merge_patches
from canprobe.mechanics.types import Floats

SAME_DIRECTION_RAD = math.radians(30.0)
"""Passes whose directions differ by less have the same hysteresis of the array."""
PAIRS_TESTED = 5000
"""Pairs of patches near each other that are tested as crossings: their number grows with the square of the time that a
scan goes over one place, and a test takes a third of a millisecond."""


def map_of_scan(
    tracker: ShapeTracker, method: str, start_s: float = 0.0
) -> tuple[SurfaceMap, Consistency, dict[str, Any]]:
    """Merge the answers of the estimator in the loop along a scan.

    Args:
        tracker: tracker with the answers and the contacts of the scan.
        method: name of the estimator.
        start_s: deadline of the first SYNC on the run's clock.

    Returns:
        The map, the tests at its crossings, and its section of ``summary.json``: None without a test.
    """
    patches = [LocalPatch.of(r.estimate, t_s=start_s + r.t_s, travelled_m=r.travelled_m) for r in tracker.records]
    surface_map = merge_patches(patches, np.frombuffer(tracker.path).reshape(-1, 3), method=method)
    consistency = _tested(surface_map)
    return (
        surface_map,
        consistency,
        {
            "patches": len(surface_map),
            "crossings": len(consistency.crossings),
            "independent_crossings": len(consistency.independent),
            "consistent": consistency.consistent,
            **{part: _verdict(consistency, part) for part in PARTS},
        },
    )


def _tested(surface_map: SurfaceMap) -> Consistency:
    """The tests at the crossings; where more pairs are near each other than `PAIRS_TESTED`, of every k-th patch."""
    every = 1
    while len(points := surface_map.points[::every]):
        tree = cKDTree(points)
        if tree.count_neighbors(tree, CROSSING_RADIUS_M) - len(points) <= 2 * PAIRS_TESTED:
            break
        every *= 2
    if every == 1:
        return check_consistency(surface_map)
    found = check_consistency(replace(surface_map, patches=surface_map.patches[::every]))
    crossings = tuple(replace(c, first=every * c.first, second=every * c.second) for c in found.crossings)
    return Consistency(crossings, found.independent)


def _verdict(consistency: Consistency, part: str) -> dict[str, float | None]:
    whole = consistency.verdict(part)
    same = consistency.verdict(part, (0.0, SAME_DIRECTION_RAD))
    other = consistency.verdict(part, (SAME_DIRECTION_RAD, math.inf))
    figures = {
        "chi2_per_dof": whole.chi2_per_dof,
        "share_p_below_0.05": whole.share_below,
        "share_p_below_0.05_same_direction": same.share_below,
        "share_p_below_0.05_other_direction": other.share_below,
        "pooled_p": whole.pooled.p,
    }
    return {name: value if math.isfinite(value) else None for name, value in figures.items()}


def estimate_columns(records: Sequence[ShapeRecord]) -> dict[str, Floats]:
    """Estimates as columns, one row for each estimate; the suffix of a name is its unit."""
    answers = [r.estimate for r in records]
    return {
        "t_s": np.array([r.t_s for r in records]),
        "travelled_m": np.array([r.travelled_m for r in records]),
        "K_per_m": np.array([a.K for a in answers]).reshape(-1, 2, 2),
        "K_covariance_per_m2": np.array([a.covariance for a in answers]).reshape(-1, 3, 3),
        "kappa_per_m": np.array([a.kappa for a in answers]).reshape(-1, 2),
        "observed": np.array([a.observed for a in answers], bool).reshape(-1, 2),
        "T_base_contact_m": np.array([a.T_frame_contact for a in answers]).reshape(-1, 4, 4),
    }
