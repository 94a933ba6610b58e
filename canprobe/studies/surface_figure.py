"""The figure of a surface map: local patches over the true object, where passes cross, and their p-values."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from canprobe.cell.mapping import SAME_DIRECTION_RAD
from canprobe.results import RunResult
from canprobe.scene_geometry import true_object
from canprobe.studies.surface_tiles import draw_tiles
from canprobe.studies.surface_view import ACCENT, FAINT, INK, SECOND, THIRD, MapView, rejected, view_of
from canprobe.touch.consistency import Consistency, check_consistency
from canprobe.touch.objects import PlacedShape
from canprobe.touch.surface_map import SurfaceMap

PARTS = (("curvature", ACCENT), ("normal", SECOND), ("height", THIRD))


def draw_surface(result: RunResult, path: Path) -> None:
    """Draw a run's surface map and write a PNG; nothing where there is none."""
    if result.surface_map is None or result.consistency is None or not len(result.surface_map):
        return
    settings = result.plan.scene.object
    draw_map(
        result.surface_map,
        path,
        consistency=result.consistency,
        shape=None if settings is None else true_object(settings),
        title=result.plan.scene.title or result.plan.scene.name,
    )


def draw_map(
    surface_map: SurfaceMap,
    path: Path,
    *,
    consistency: Consistency | None = None,
    shape: PlacedShape | None = None,
    title: str = "",
) -> None:
    """Draw a map: tiles over the true object, crossings in the plane of the scan, their p-values.

    Args:
        surface_map: with at least one patch.
        path: of the PNG.
        consistency: the tests at its crossings; None for `check_consistency`, which takes a second.
        shape: the true object, for the ghost below the tiles and for errors; None colours by mean curvature.
        title: first line.
    """
    view = view_of(surface_map, consistency or check_consistency(surface_map), shape)
    figure = Figure(figsize=(13.0, 7.6), dpi=110, layout="constrained")
    crossings = len(view.consistency.crossings)
    figure.suptitle(
        f"{title}\n{len(surface_map)} patches over {1e3 * surface_map.travelled[-1]:.0f} mm of path by"
        f" {surface_map.method or 'an estimator'}, {crossings} crossings",
        x=0.01, ha="left", fontsize=11, color=INK,
    )  # fmt: skip
    grid = figure.add_gridspec(2, 5, height_ratios=(1.0, 1.15))
    draw_tiles(figure.add_subplot(grid[:, 0:3], projection="3d", computed_zorder=False), view)
    _draw_crossings(figure.add_subplot(grid[0, 3:5] if crossings else grid[:, 3:5]), view)
    if crossings:
        _draw_p_values(figure.add_subplot(grid[1, 3:5]), view.consistency)
    figure.savefig(path)


def _draw_crossings(axes: Axes, view: MapView) -> None:
    path = view.plane(view.map.path)
    axes.plot(path[:, 0], path[:, 1], color=FAINT, linewidth=0.9, zorder=1)
    crossings = view.consistency.crossings
    if crossings:
        places = view.plane(np.array([crossing.T_base_common[:3, 3] for crossing in crossings]))
        differ = rejected(view.consistency)
        same = np.array([not c.angle >= SAME_DIRECTION_RAD for c in crossings])
        for is_same, marker, where in ((True, "o", "same direction"), (False, "X", "other direction")):
            for is_bad, colour, what in ((False, SECOND, "agree"), (True, ACCENT, "differ, p < 0.05")):
                chosen = (same == is_same) & (differ == is_bad)
                if chosen.any():
                    axes.scatter(
                        places[chosen, 0], places[chosen, 1], s=26, marker=marker, color=colour, linewidths=0.4,
                        edgecolors="white", zorder=3 if is_bad else 2, label=f"{where}: {chosen.sum()} {what}",
                    )  # fmt: skip
        axes.legend(frameon=False, fontsize=7.5, ncols=2, loc="lower center", columnspacing=1.0, handletextpad=0.2)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(y=0.25)
    _style(axes, "path and its crossings (joint test)", "along the scan (mm)", "across (mm)")


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
