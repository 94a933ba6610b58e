"""The figure of a surface map: local patches as curved tiles over the true object, and where passes cross."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from canprobe.cell.mapping import SAME_DIRECTION_RAD
from canprobe.results import RunResult
from canprobe.scene_geometry import true_object
from canprobe.touch.consistency import LEVEL, Consistency, check_consistency
from canprobe.touch.frames import tangent_rotation
from canprobe.touch.local_patch import LocalPatch
from canprobe.touch.objects import PlacedShape
from canprobe.touch.surface_map import SurfaceMap

Array = NDArray[np.float64]
INK, FAINT, GHOST, ACCENT, SECOND, THIRD = "#1f2933", "#d9dee4", "#8a94a0", "#c2410c", "#0f6e84", "#6b4fa0"
TILE_M, RINGS, SECTORS = 1.8e-3, 3, 20
"""Radius of a tile; it is drawn as rings of sectors."""
APART_M = 2.9e-3
"""Least distance of two tiles: where passes overlap the best known patch stands for all."""
MARGIN_M, GRID = 5e-3, 34
LEAST_DEPTH_MM = 6.0
"""Least height of the box, for a plane."""
PARTS = (("curvature", ACCENT), ("normal", SECOND), ("height", THIRD))


class _View(NamedTuple):
    """What all panels share: the map, its tests, the true object or None, axes (3, 3) along, across, outward."""

    map: SurfaceMap
    consistency: Consistency
    shape: PlacedShape | None
    axes: Array
    origin: Array

    def plane(self, points: Array) -> Array:
        """(n, 3) mm along, across, outward from the middle of the map."""
        result: Array = (points - self.origin) @ self.axes.T * 1e3
        return result


def draw_surface(result: RunResult, path: Path) -> None:
    """Draw a run's surface map and write a PNG; nothing where there is none."""
    if result.surface_map is None or not len(result.surface_map):
        return
    settings = result.plan.scene.object
    draw_map(
        result.surface_map,
        path,
        shape=None if settings is None else true_object(settings),
        title=result.plan.scene.title or result.plan.scene.name,
    )


def draw_map(surface_map: SurfaceMap, path: Path, *, shape: PlacedShape | None = None, title: str = "") -> None:
    """Draw a map: tiles over the true object, crossings in the plane of the scan, their p-values.

    Args:
        surface_map: with at least one patch.
        path: of the PNG.
        shape: the true object, for the ghost below the tiles and for errors; None colours by mean curvature.
        title: first line.
    """
    view = _view(surface_map, shape)
    figure = Figure(figsize=(13.0, 7.6), dpi=110, layout="constrained")
    crossings = len(view.consistency.crossings)
    figure.suptitle(
        f"{title}\n{len(surface_map)} patches over {1e3 * surface_map.travelled[-1]:.0f} mm of path by"
        f" {surface_map.method or 'an estimator'}, {crossings} crossings",
        x=0.01, ha="left", fontsize=11, color=INK,
    )  # fmt: skip
    grid = figure.add_gridspec(2, 5, height_ratios=(1.0, 1.15))
    _draw_tiles(figure.add_subplot(grid[:, 0:3], projection="3d", computed_zorder=False), view)
    _draw_crossings(figure.add_subplot(grid[0, 3:5] if crossings else grid[:, 3:5]), view)
    if crossings:
        _draw_p_values(figure.add_subplot(grid[1, 3:5]), view.consistency)
    figure.savefig(path)


def _view(surface_map: SurfaceMap, shape: PlacedShape | None) -> _View:
    path = surface_map.path if len(surface_map.path) else surface_map.points
    middle = 0.5 * (path.min(axis=0) + path.max(axis=0))
    outward = surface_map.normals.mean(axis=0)
    R = tangent_rotation(outward / np.linalg.norm(outward))
    flat = (path - middle) @ R[:, :2]
    _, _, main = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
    along = R[:, :2] @ main[0]
    axes = np.array([along, np.cross(R[:, 2], along), R[:, 2]])
    return _View(surface_map, check_consistency(surface_map), shape, axes, middle)


# the tiles


def _draw_tiles(axes: Any, view: _View) -> None:
    path = view.plane(view.map.path)
    if view.shape is not None:
        axes.plot_surface(*_ghost(view, view.shape), color=GHOST, alpha=0.25, linewidth=0, shade=True, zorder=1)
    patches = tiles_of(view.map)
    values = np.array([_value(patch, view.shape) for patch in patches])
    known = values[np.isfinite(values)]
    low = 0.0 if view.shape is not None else float(known.min(initial=0.0))
    norm = Normalize(low, max(float(np.percentile(known, 98)) if len(known) else 1.0, low + 1e-3))
    colours = colormaps["viridis"]
    for patch, value in zip(patches, values, strict=True):
        face = colours(norm(value)) if math.isfinite(value) else GHOST
        grid = tile(patch)
        x, y, z = view.plane(grid.reshape(-1, 3)).T.reshape(3, *grid.shape[:2])
        axes.plot_surface(x, y, z, color=face, linewidth=0, shade=False, antialiased=False, zorder=2)
    axes.plot(*path.T, color=INK, linewidth=0.5, alpha=0.55, zorder=3)
    differ = _rejected(view.consistency)
    if differ.any():
        places = np.array([c.T_base_common[:3, 3] for c in view.consistency.crossings])[differ]
        axes.plot(*view.plane(places).T, "o", color=ACCENT, markersize=3.5, zorder=4)
    _style_3d(axes)
    place = axes.inset_axes((0.2, 0.1, 0.6, 0.022))
    bar = axes.figure.colorbar(ScalarMappable(norm, colours), cax=place, orientation="horizontal")
    bar.ax.tick_params(labelsize=8)
    bar.set_label("‖K − K true‖ (1/m)" if view.shape is not None else "mean curvature (1/m)", fontsize=9, color=INK)
    hidden = int(np.count_nonzero(~np.isfinite(values)))
    note = f" · {hidden} grey: not all curvature observed" if hidden else ""
    true = ", true surface in grey" if view.shape is not None else ""
    dots = " · orange: passes differ, p < 0.05" if differ.any() else ""
    axes.set_title(
        f"patches{true};\nwhere passes overlap the best known one{dots}{note}", loc="left", fontsize=10, color=INK
    )


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


def _ghost(view: _View, shape: PlacedShape) -> tuple[Array, Array, Array]:
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


# the crossings


def _draw_crossings(axes: Axes, view: _View) -> None:
    path = view.plane(view.map.path)
    axes.plot(path[:, 0], path[:, 1], color=FAINT, linewidth=0.9, zorder=1)
    crossings = view.consistency.crossings
    if crossings:
        places = view.plane(np.array([crossing.T_base_common[:3, 3] for crossing in crossings]))
        rejected = _rejected(view.consistency)
        same = np.array([not c.angle >= SAME_DIRECTION_RAD for c in crossings])
        for is_same, marker, where in ((True, "o", "same direction"), (False, "X", "other direction")):
            for is_bad, colour, what in ((False, SECOND, "agree"), (True, ACCENT, "differ, p < 0.05")):
                chosen = (same == is_same) & (rejected == is_bad)
                if chosen.any():
                    axes.scatter(
                        places[chosen, 0], places[chosen, 1], s=26, marker=marker, color=colour, linewidths=0.4,
                        edgecolors="white", zorder=3 if is_bad else 2, label=f"{where}: {chosen.sum()} {what}",
                    )  # fmt: skip
        axes.legend(frameon=False, fontsize=7.5, ncols=2, loc="lower center", columnspacing=1.0, handletextpad=0.2)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(y=0.1)
    _style(axes, "path and its crossings (joint test)", "along the scan (mm)", "across (mm)")


def _rejected(consistency: Consistency) -> NDArray[np.bool_]:
    return np.array([c.joint.p < LEVEL for c in consistency.crossings], dtype=bool)


def _draw_p_values(axes: Axes, consistency: Consistency) -> None:
    axes.plot([0, 1], [0, 1], color=INK, linewidth=0.9, linestyle=":", label="one surface, exact covariances")
    for part, colour in PARTS:
        for style, name, low, high in (
            ("-", "same direction", 0.0, SAME_DIRECTION_RAD),
            ("--", "other", SAME_DIRECTION_RAD, math.inf),
        ):
            tests = [getattr(c, part) for c in consistency.crossings if low <= c.angle < high]
            p = np.sort([test.p for test in tests if test.dof])
            if len(p):
                share = np.arange(1, len(p) + 1) / len(p)
                axes.step(
                    [0.0, *p, 1.0], [0.0, *share, 1.0], where="post", color=colour, linestyle=style, linewidth=1.1,
                    label=f"{part}, {name}",
                )  # fmt: skip
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1.02)
    axes.legend(frameon=False, fontsize=8, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.17), columnspacing=1.2)
    _style(axes, "p-values of the tests at the crossings", "p", "share of crossings below")


def _style(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set_title(title, loc="left", fontsize=10, color=INK)
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.grid(color=FAINT, linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
