"""The surface map of a scan in the summary, and estimates as columns."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from canprobe.cell.tasks.shape import ShapeRecord
from canprobe.mechanics.touch.linear_algebra import rms
from canprobe.mechanics.touch.map import nodes as column
from canprobe.mechanics.touch.map.surface_map import SurfaceMap
from canprobe.mechanics.touch.shapes import PlacedShape
from canprobe.mechanics.types import Floats

MAX_PLACES = 500
"""Most places at which a map is scored, evenly over its nodes."""
TWO_SIGMA = 1.96
_COMMON = ("lag_um", "pad_scale_percent", "pad_x_um", "pad_y_um")
_TO_UNIT = np.array([1e6, 1e2, 1e6, 1e6])


def summarise_map(surface_map: SurfaceMap, shape: PlacedShape | None) -> dict[str, Any]:
    """The section ``shape.map`` of ``summary.json``: None for what does not apply.

    Args:
        surface_map: map of the scan.
        shape: true object; None where nobody knows it.
    """
    names = ("sigma_um", "disagree_fraction", "stiffness_n_m3", "stiffness_sigma_percent", "common")
    found: dict[str, Any] = {"contacts": 0, "nodes": len(surface_map)} | dict.fromkeys(names)
    found |= dict.fromkeys(("rms_error_um", "within_2_sigma_fraction"))
    if not len(surface_map):
        return found
    found["contacts"] = int(surface_map.nodes.rows[:, column.COUNT].sum())
    places = surface_map.points[:: -(-len(surface_map) // MAX_PLACES)]
    feet = surface_map.closest(places)
    known = np.isfinite(feet.sigma)
    if known.any():
        found["sigma_um"] = 1e6 * float(np.median(feet.sigma[known]))
        found["disagree_fraction"] = float(np.mean(surface_map.disagreement(places[known]) > 0.0))
    if (stiffness := surface_map.stiffness) is not None:
        found["stiffness_n_m3"], found["stiffness_sigma_percent"] = stiffness.value, 1e2 * stiffness.sigma
    if any(surface_map.noise.common):
        mean, sigma = surface_map.common.mean, np.sqrt(np.diag(surface_map.common.covariance))
        pairs = zip(_COMMON, (mean * _TO_UNIT).tolist(), (sigma * _TO_UNIT).tolist(), strict=True)
        found["common"] = {name: [value, spread] for name, value, spread in pairs}
    if shape is not None and known.any():
        off = np.array([shape.nearest((x, y, z)).distance for x, y, z in feet.point[known].tolist()])
        found["rms_error_um"] = 1e6 * rms(off)
        found["within_2_sigma_fraction"] = float(np.mean(np.abs(off) < TWO_SIGMA * feet.sigma[known]))
    return {name: None if isinstance(value, float) and math.isnan(value) else value for name, value in found.items()}


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
