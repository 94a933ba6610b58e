"""The figure of a surface map: its surface over the true object, the crossings of passes, and their p-values."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.figure import SubFigure

from canprobe.cell.results.map_score import SAME_DIRECTION_RAD
from canprobe.cell.results.picture import BLUE, FAINT, GREEN, INK, ORANGE, drawn_rows, legend, parts, picture
from canprobe.cell.results.run_data import RunData
from canprobe.cell.results.surface_panels import (
    MapPlane,
    MapView,
    rejected,
)
from canprobe.cell.results.surface_sheet import draw_map_surface
from canprobe.mechanics.touch.consistency import Consistency, check_consistency
from canprobe.mechanics.touch.shapes import PlacedShape
from canprobe.mechanics.touch.surface_map import SurfaceMap

PARTS = (("curvature", ORANGE), ("normal", BLUE), ("height", GREEN))


def draw_surface(result: RunData, path: Path) -> None:
    """Draw a run's surface map and write a PNG; a run without a map has none."""
    if result.surface_map is None or result.consistency is None or not len(result.surface_map):
        return
    draw_map(
        result.surface_map,
        path,
        consistency=result.consistency,
        shape=result.plan.setup.truth.object,
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
    """Draw a map: its surface over the true object, crossings in the plane of the scan, their p-values.

    Args:
        surface_map: a map with at least one patch.
        path: path of the PNG.
        consistency: tests at its crossings; None: `check_consistency` makes them, which takes a second.
        shape: true object, drawn below the surface and compared with it; None: the colour shows σ.
        title: first line of the title.
    """
    walked = surface_map.path if len(surface_map.path) else surface_map.points
    plane = MapPlane.of(walked, surface_map.normals)
    view = MapView(surface_map, consistency or check_consistency(surface_map), shape, plane)
    crossings = len(view.consistency.crossings)
    told = (
        f"{title}\n{len(surface_map)} patches over {1e3 * surface_map.travelled[-1]:.0f} mm of path by"
        f" {surface_map.method or 'an estimator'}, {crossings} crossings"
    )
    with picture(path, told, 7.8) as figure:
        upper, lower = parts(figure, 2, 1, height_ratios=(4, 3))
        draw_map_surface(upper, view)
        left, *right = parts(lower, 1, 2 if crossings else 1)
        _draw_crossings(left, view)
        for part in right:
            _draw_p_values(part, view.consistency)


def _draw_crossings(part: SubFigure, view: MapView) -> None:
    axes = part.subplots()
    path = view.plane.mm(view.map.path[drawn_rows(len(view.map.path))])
    axes.plot(path[:, 0], path[:, 1], color=FAINT, linewidth=0.9, zorder=1)
    crossings = view.consistency.crossings
    if crossings:
        places = view.plane.mm(np.array([c.T_base_common[:3, 3] for c in crossings]))
        differ = rejected(view.consistency)
        same = np.array([not c.angle >= SAME_DIRECTION_RAD for c in crossings])
        for is_same, marker, where in ((True, "o", "same direction"), (False, "X", "other direction")):
            for is_bad, colour, what in ((False, BLUE, "agree"), (True, ORANGE, "differ")):
                chosen = (same == is_same) & (differ == is_bad)
                if chosen.any():
                    axes.scatter(
                        places[chosen, 0], places[chosen, 1], s=26, marker=marker, color=colour, linewidths=0.4,
                        edgecolors="white", zorder=3 if is_bad else 2, label=f"{where}: {chosen.sum()} {what}",
                    )  # fmt: skip
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(
        title="path and crossings; differ: p < 0.05 in the joint test",
        xlabel="along the scan (mm)",
        ylabel="across (mm)",
    )
    legend(part)


def _draw_p_values(part: SubFigure, consistency: Consistency) -> None:
    axes = part.subplots()
    axes.plot([0, 1], [0, 1], color=INK, linewidth=0.9, linestyle=":", label="one surface, exact covariances")
    for name, colour in PARTS:
        for style, way, low, high in (
            ("-", "same direction", 0.0, SAME_DIRECTION_RAD),
            ("--", "other", SAME_DIRECTION_RAD, math.inf),
        ):
            tests = [getattr(c, name) for c in consistency.crossings if low <= c.angle < high]
            p = np.sort([test.p for test in tests if test.dof])
            if len(p):
                share = np.arange(1, len(p) + 1) / len(p)
                axes.step(
                    [0.0, *p, 1.0], [0.0, *share, 1.0], where="post", color=colour, linestyle=style,
                    label=f"{name}, {way}",
                )  # fmt: skip
    axes.set(xlim=(0, 1), ylim=(0, 1.02), xlabel="p", ylabel="share of crossings below")
    axes.set_title("p-values of the tests at the crossings\nbelow the dotted line: errors are smaller than stated")
    legend(part)
