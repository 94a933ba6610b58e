"""The figure of a surface map: its surface over the true object, where contacts disagree, and their common errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import SubFigure

from canprobe.cell.results.picture import BLUE, FAINT, GREY, INK, ORANGE, drawn_rows, legend, parts, picture
from canprobe.cell.results.run_data import RunData
from canprobe.cell.results.surface_panels import MapPlane, MapView
from canprobe.cell.results.surface_sheet import draw_map_surface
from canprobe.cell.tasks.probing import Phase
from canprobe.mechanics.touch.map.surface_map import SurfaceMap
from canprobe.mechanics.touch.shapes import PlacedShape
from canprobe.mechanics.types import Floats

TWO_SIGMA = 1.96
COMMON = (("lag", 1e6, "µm"), ("pad scale", 1e2, "%"), ("pad x", 1e6, "µm"), ("pad y", 1e6, "µm"))
"""Errors that a scan has in common, with their units."""


def draw_surface(result: RunData, path: Path) -> None:
    """Draw a run's surface map and write a PNG; a run without a map has none."""
    if result.surface_map is None or not len(result.surface_map):
        return
    draw_map(
        result.surface_map,
        path,
        walked=_walked(result),
        shape=result.plan.setup.truth.object,
        title=result.plan.scene.title or result.plan.scene.name,
    )


def _walked(result: RunData) -> Floats | None:
    """(n, 3) path of the contact over the surface, m; None where the log has none."""
    if "contact_mm" not in result.log:
        return None
    points: Floats = 1e-3 * result.log["contact_mm"]
    points = points[(result.log["phase"] == Phase.SCAN) & np.isfinite(points).all(axis=1)]
    return points[drawn_rows(len(points))] if len(points) else None


def draw_map(
    surface_map: SurfaceMap,
    path: Path,
    *,
    walked: Floats | None = None,
    shape: PlacedShape | None = None,
    title: str = "",
) -> None:
    """Draw a map: its surface over the true object, where passes disagree, and the errors that they have in common.

    Args:
        surface_map: a map with at least one contact.
        path: path of the PNG.
        walked: (n, 3) path of the contact, m; None: not drawn.
        shape: true object, drawn below the surface and compared with it; None: the colour shows σ.
        title: first line of the title.
    """
    points = surface_map.points
    plane = MapPlane.of(points if walked is None else walked, surface_map.normals)
    view = MapView(surface_map, walked, shape, plane)
    common = any(surface_map.noise.common)
    with picture(
        path,
        f"{title}\none surface of {len(surface_map)} nodes: a node is the mean of the contacts along 1 mm of the path",
        7.8,
    ) as figure:
        upper, lower = parts(figure, 2, 1, height_ratios=(4, 3))
        draw_map_surface(upper, view)
        left, *right = parts(lower, 1, 2 if common else 1)
        _draw_disagreement(left, view)
        for part in right:
            _draw_common(part, surface_map)


def _draw_disagreement(part: SubFigure, view: MapView) -> None:
    axes = part.subplots()
    if view.path is not None:
        path = view.plane.mm(view.path)
        axes.plot(path[:, 0], path[:, 1], color=FAINT, linewidth=0.9, zorder=1)
    points = view.map.points[drawn_rows(len(view.map))]
    places, beyond = view.plane.mm(points), view.map.disagreement(points)
    groups = ((beyond == 0.0, BLUE, "agree within their noise"), (beyond > 0.0, ORANGE, "disagree"))
    for chosen, colour, what in (group for group in groups if group[0].any()):
        size = np.clip(8.0 + 8.0 * beyond[chosen], 8.0, 60.0)
        axes.scatter(
            places[chosen, 0], places[chosen, 1], s=size, color=colour, linewidths=0.3, edgecolors="white",
            zorder=2, label=f"{chosen.sum()} nodes {what}",
        )  # fmt: skip
    axes.set_aspect("equal", adjustable="datalim")
    apart = "where contacts disagree; size: χ² per degree of freedom above 1"
    axes.set(
        title=apart if (beyond > 0.0).any() else "contacts agree everywhere",
        xlabel="along the scan (mm)",
        ylabel="across (mm)",
    )
    legend(part)


def _draw_common(part: SubFigure, surface_map: SurfaceMap) -> None:
    axes = part.subplots()
    prior = np.array(surface_map.noise.common)
    mean, sigma = surface_map.common.mean, np.sqrt(np.diag(surface_map.common.covariance))
    rows = np.arange(len(COMMON))
    axes.barh(rows, 2.0 * TWO_SIGMA, left=-TWO_SIGMA, color=GREY, alpha=0.3, label="before the scan, 95 %")
    axes.errorbar(
        mean / prior,
        rows,
        xerr=TWO_SIGMA * sigma / prior,
        fmt="o",
        color=ORANGE,
        capsize=4,
        label="after the scan, 95 %",
    )
    axes.axvline(0.0, color=INK, linewidth=0.9, linestyle=":")
    texts = (
        f"{name}\n{unit * value:.0f} ± {unit * spread:.0f} {of}"
        for (name, unit, of), value, spread in zip(COMMON, mean, sigma, strict=True)
    )
    axes.set_yticks(rows, list(texts))
    axes.set(
        title="errors that the whole scan has in common", xlabel="error over its standard deviation before the scan"
    )
    legend(part)
