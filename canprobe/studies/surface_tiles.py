"""Local patches as little curved tiles over the true object."""

from __future__ import annotations

import math

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from canprobe.studies.figure import GREY, INK, ORANGE, Part, box, parts
from canprobe.studies.surface_view import Array, MapView, rejected, true_surface
from canprobe.touch.local_patch import LocalPatch
from canprobe.touch.objects import PlacedShape
from canprobe.touch.surface_map import SurfaceMap

TILE_M, RINGS, SECTORS = 1.8e-3, 3, 20
"""Radius of a tile; it is drawn as rings of sectors."""
APART_M = 2.9e-3
"""Least distance of two tiles: where passes overlap, the best known patch stands for all."""


def draw_tiles(part: Part, view: MapView) -> None:
    """Draw tiles, coloured by the error of K or by mean curvature, path and true surface in three dimensions."""
    part, scale = parts(part, 1, 2, width_ratios=(8, 1))
    axes = part.add_subplot(projection="3d", computed_zorder=False)
    path = view.plane(view.map.path)
    if view.shape is not None:
        near = true_surface(view.shape, view.map.path, view.axes, view.origin)
        axes.plot_surface(*near, color=GREY, alpha=0.25, linewidth=0, shade=True, zorder=1)
    patches = tiles_of(view.map)
    values = np.array([_value(patch, view.shape) for patch in patches])
    known = values[np.isfinite(values)]
    norm, colours = _scale(known, from_zero=view.shape is not None), colormaps["viridis"]
    for patch, value in zip(patches, values, strict=True):
        face = colours(norm(value)) if math.isfinite(value) else GREY
        grid = tile(patch)
        x, y, z = view.plane(grid.reshape(-1, 3)).T.reshape(3, *grid.shape[:2])
        axes.plot_surface(x, y, z, color=face, linewidth=0, shade=False, antialiased=False, zorder=2)
    axes.plot(*path.T, color=INK, linewidth=0.5, alpha=0.55, zorder=3)
    differ = rejected(view.consistency)
    if differ.any():
        places = np.array([c.T_base_common[:3, 3] for c in view.consistency.crossings])[differ]
        axes.plot(*view.plane(places).T, "o", color=ORANGE, markersize=3.5, zorder=4)
    labels = ("along the scan (mm)", "across (mm)", "outward (mm)")
    box(part, axes, _title(view, len(patches) - len(known), bool(differ.any())), labels, elev=42, azim=-68)
    if len(known):
        what = "mean curvature (1/m)" if view.shape is None else "‖K − K true‖ (1/m)"
        scale.colorbar(ScalarMappable(norm, colours), cax=scale.subplots(), label=what)


def _scale(values: Array, *, from_zero: bool) -> Normalize:
    if not len(values):
        return Normalize(0.0, 1.0)
    low = 0.0 if from_zero else float(values.min())
    return Normalize(low, max(float(np.percentile(values, 98)), low + 1e-3))


def _title(view: MapView, hidden: int, differ: bool) -> str:
    shown = ["where passes overlap, the best known patch"]
    if view.shape is not None:
        shown.append("true surface in light grey")
    if hidden:
        shown.append(f"{hidden} in dark grey: not all curvature observed")
    if differ:
        shown.append("orange: passes differ, p < 0.05")
    return "\n".join(" · ".join(shown[i : i + 3]) for i in range(0, len(shown), 3))


def tiles_of(surface_map: SurfaceMap) -> list[LocalPatch]:
    """Patches that are drawn: the best known ones first, none nearer than `APART_M` to one before it."""
    order = sorted(surface_map.patches, key=_badness)
    drawn: list[LocalPatch] = []
    for patch in order:
        if all(np.linalg.norm(patch.point - other.point) > APART_M for other in drawn):
            drawn.append(patch)
    return drawn


def _badness(patch: LocalPatch) -> float:
    trace = float(patch.K_covariance[0, 0] + 2.0 * patch.K_covariance[1, 1] + patch.K_covariance[2, 2])
    return trace if math.isfinite(trace) else math.inf


def tile(patch: LocalPatch) -> Array:
    """Points (rings + 1, sectors + 1, 3) of a disc on the patch's quadric, base frame, m."""
    radii = np.linspace(0.0, TILE_M, RINGS + 1)[:, None]
    angles = np.linspace(0.0, 2.0 * math.pi, SECTORS + 1)[None]
    x, y = radii * np.cos(angles), radii * np.sin(angles)
    local = np.stack([x, y, patch.surface.height(x, y)], axis=-1)
    result: Array = local @ patch.T_base_contact[:3, :3].T + patch.point
    return result


def _value(patch: LocalPatch, shape: PlacedShape | None) -> float:
    """Error of K against the truth, or its mean curvature; NaN where not all of it was observed."""
    if patch.rank < 3:
        return math.nan
    K = 2.0 * patch.S[:2, :2]
    if shape is None:
        return 0.5 * float(np.trace(K))
    true = shape.closest(patch.point)
    P = patch.T_base_contact[:3, :2]
    tensor = (true.directions.T * true.kappa) @ true.directions
    return float(np.linalg.norm(K - P.T @ tensor @ P))
