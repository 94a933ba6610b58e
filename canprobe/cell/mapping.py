"""The surface map of a scan, and what the summary says of it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from canprobe.cell.tasks.shape import ShapeTracker
from canprobe.touch.consistency import PARTS, Consistency
from canprobe.touch.local_patch import LocalPatch
from canprobe.touch.surface_map import SurfaceMap, merge_patches

SAME_DIRECTION_RAD = math.radians(30.0)
"""Passes that differ by less than this felt the place alike, hysteresis included."""


def map_of_scan(tracker: ShapeTracker, method: str, start_s: float = 0.0) -> SurfaceMap:
    """Merge what the estimator in the loop said along a scan.

    Args:
        tracker: with the answers and the contacts of the scan.
        method: name of the estimator.
        start_s: when the first SYNC was due, on the run's clock.
    """
    patches = [LocalPatch.of(r.estimate, t_s=start_s + r.t_s, travelled_m=r.travelled_m) for r in tracker.records]
    path = np.array([sample.p_base for sample in tracker.samples]).reshape(-1, 3)
    return merge_patches(patches, path[np.isfinite(path).all(axis=1)], method=method)


def summarise_map(surface_map: SurfaceMap, consistency: Consistency) -> dict[str, Any]:
    """Patches, crossings and their tests for ``summary.json``; None where there was nothing to test."""
    return {
        "patches": len(surface_map),
        "crossings": len(consistency.crossings),
        "independent_crossings": len(consistency.independent),
        "consistent": consistency.consistent,
        **{part: _verdict(consistency, part) for part in PARTS},
    }


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
