"""Local patches as little curved tiles over the true object."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from canprobe.studies.surface_view import ACCENT, FAINT, GHOST, INK, Array, MapView, rejected
from canprobe.touch.local_patch import LocalPatch
from canprobe.touch.objects import PlacedShape
from canprobe.touch.surface_map import SurfaceMap

TILE_M, RINGS, SECTORS = 1.8e-3, 3, 20
"""Radius of a tile; it is drawn as rings of sectors."""
APART_M = 2.9e-3
"""Least distance of two tiles: where passes overlap, the best known patch stands for all."""
MARGIN_M, GRID = 5e-3, 34
LEAST_DEPTH_MM = 6.0
"""Least height of the box, for a plane."""


def draw_tiles(axes: Any, view: MapView) -> None:
    """Draw tiles, path and true surface on 3-D axes; tiles are coloured by the error of K, or by mean curvature."""
    path = view.plane(view.map.path)
    if view.shape is not None:
        axes.plot_surface(*_ghost(view, view.shape), color=GHOST, alpha=0.25, linewidth=0, shade=True, zorder=1)
    patches = tiles_of(view.map)
    values = np.array([_value(patch, view.shape) for patch in patches])
    known = values[np.isfinite(values)]
    norm, colours = _scale(known, from_zero=view.shape is not None), colormaps["viridis"]
    for patch, value in zip(patches, values, strict=True):
        face = colours(norm(value)) if math.isfinite(value) else GHOST
        grid = tile(patch)
        x, y, z = view.plane(grid.reshape(-1, 3)).T.reshape(3, *grid.shape[:2])
        axes.plot_surface(x, y, z, color=face, linewidth=0, shade=False, antialiased=False, zorder=2)
    axes.plot(*path.T, color=INK, linewidth=0.5, alpha=0.55, zorder=3)
    differ = rejected(view.consistency)
    if differ.any():
        places = np.array([c.T_base_common[:3, 3] for c in view.consistency.crossings])[differ]
        axes.plot(*view.plane(places).T, "o", color=ACCENT, markersize=3.5, zorder=4)
    _style_3d(axes)
    if len(known):
        place = axes.inset_axes((0.2, 0.05, 0.6, 0.022))
        bar = axes.figure.colorbar(ScalarMappable(norm, colours), cax=place, orientation="horizontal")
        bar.ax.tick_params(labelsize=8)
        what = "mean curvature" if view.shape is None else "‖K − K true‖"
        bar.set_label(f"{what} (1/m)", fontsize=9, color=INK)
    axes.set_title(_title(view, len(patches) - len(known), bool(differ.any())), loc="left", fontsize=10, color=INK)


def _scale(values: Array, *, from_zero: bool) -> Normalize:
    if not len(values):
        return Normalize(0.0, 1.0)
    low = 0.0 if from_zero else float(values.min())
    return Normalize(low, max(float(np.percentile(values, 98)), low + 1e-3))


def _title(view: MapView, hidden: int, differ: bool) -> str:
    first = ["where passes overlap, the best known patch"]
    if view.shape is not None:
        first.append("true surface in light grey")
    second = []
    if hidden:
        second.append(f"{hidden} patches in dark grey: not all curvature observed")
    if differ:
        second.append("orange: passes differ, p < 0.05")
    return " · ".join(first) + "\n" + " · ".join(second)


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


def _ghost(view: MapView, shape: PlacedShape) -> tuple[Array, Array, Array]:
    """True surface below the path, mm along, across, outward."""
    flat = view.plane(view.map.path) * 1e-3
    low, high = flat.min(axis=0) - MARGIN_M, flat.max(axis=0) + MARGIN_M
    us, vs = np.meshgrid(np.linspace(low[0], high[0], GRID), np.linspace(low[1], high[1], GRID))
    above = np.stack((us, vs, np.full_like(us, high[2])), axis=-1) @ view.axes + view.origin
    feet = view.plane(np.array([shape.closest(p).point for p in above.reshape(-1, 3)])).reshape(GRID, GRID, 3)
    return feet[..., 0], feet[..., 1], feet[..., 2]


def _style_3d(axes: Any) -> None:
    axes.set_xlabel("along the scan (mm)")
    axes.set_ylabel("across (mm)")
    axes.set_zlabel("outward (mm)", labelpad=-2)
    low, high = axes.get_zlim()
    spare = max(0.0, LEAST_DEPTH_MM - (high - low)) / 2
    axes.set_zlim(low - spare, high + spare)
    axes.set_aspect("equal")
    axes.set_box_aspect(axes.get_box_aspect(), zoom=1.08)
    axes.view_init(elev=42, azim=-68)
    axes.locator_params(nbins=5)
    axes.locator_params(axis="z", nbins=3)
    axes.tick_params(labelsize=8, pad=1)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.pane.set_facecolor("white")
        axis.pane.set_edgecolor(FAINT)
        axis._axinfo["grid"].update(color=FAINT, linewidth=0.6)
