"""The figure of a surface map: its surface over the true object, where contacts disagree, and their common errors."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import SubFigure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from canprobe.cell.results.picture import BLUE, FAINT, GREY, INK, ORANGE, Part, box, drawn_rows, legend, parts, picture
from canprobe.cell.results.run_data import RunData
from canprobe.cell.results.scores import TWO_SIGMA
from canprobe.cell.tasks.task import Phase
from canprobe.mechanics.touch.tangent_frames import tangent_rotation
from canprobe.mechanics.types import Floats

if TYPE_CHECKING:
    from canprobe.mechanics.touch.map.surface_map import SurfaceMap
    from canprobe.mechanics.touch.shapes import PlacedShape

MARGIN_M, TRUE_POINTS = 5e-3, 34
"""Margin of a true surface beyond the path, m, and its points on each side."""
MAP_POINTS = 64
"""Number of points of a map's surface along its longer side."""


class MapPlane(NamedTuple):
    """The plane of a scan: `axes` (3, 3), rows along, across, outward, and `origin` (3,), the middle of the path, m."""

    axes: Floats
    origin: Floats

    @classmethod
    def of(cls, path: Floats, normals: Floats) -> MapPlane:
        """Find the plane of a path (n, 3), m, with outward normals (m, 3) along it."""
        middle = 0.5 * (path.min(axis=0) + path.max(axis=0))
        outward = normals.mean(axis=0)
        R = tangent_rotation(outward / np.linalg.norm(outward))
        flat = (path - middle) @ R[:, :2]
        _, _, main = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
        along = R[:, :2] @ main[0]
        return cls(np.array([along, np.cross(R[:, 2], along), R[:, 2]]), middle)

    def mm(self, points: Floats) -> Floats:
        """Points (..., 3) of base, m, as mm along, across, outward."""
        return (points - self.origin) @ self.axes.T * 1e3

    def base(self, mm: Floats) -> Floats:
        """Points (..., 3) in mm along, across, outward, as points of base, m."""
        return 1e-3 * mm @ self.axes + self.origin


def true_surface(shape: PlacedShape, path: Floats, plane: MapPlane) -> Floats:
    """An object's surface below a path (n, 3): (TRUE_POINTS, TRUE_POINTS, 3) points of base, m."""
    flat = plane.mm(path)
    low, high = flat.min(axis=0) - 1e3 * MARGIN_M, flat.max(axis=0) + 1e3 * MARGIN_M
    us, vs = np.meshgrid(np.linspace(low[0], high[0], TRUE_POINTS), np.linspace(low[1], high[1], TRUE_POINTS))
    above = plane.base(np.stack((us, vs, np.full_like(us, high[2])), axis=-1))
    return np.array([shape.closest(point).point for point in above.reshape(-1, 3)]).reshape(TRUE_POINTS, TRUE_POINTS, 3)


def map_surface(surface_map: SurfaceMap, plane: MapPlane) -> tuple[Floats, Floats]:
    """The surface of a map: points (rows, columns, 3) of base, m, and its relative σ, m; NaN beyond its contacts.

    A grid over the plane of the scan, in a tenth of the time of the triangles that `SurfaceMap.mesh` finds.
    """
    from scipy.spatial import cKDTree

    from canprobe.mechanics.touch.map.surface_map import REACH_M

    contacts = plane.mm(surface_map.points)
    low, high = contacts.min(axis=0)[:2] - 1e3 * REACH_M, contacts.max(axis=0)[:2] + 1e3 * REACH_M
    counts = np.ceil(MAP_POINTS * (high - low) / (high - low).max()).astype(int)
    us, vs = np.meshgrid(*(np.linspace(*ends) for ends in zip(low, high, counts, strict=True)))
    nearest = cKDTree(contacts[:, :2]).query(np.stack((us, vs), axis=-1))[1]
    feet = surface_map.closest(plane.base(np.stack((us, vs, contacts[nearest, 2]), axis=-1)).reshape(-1, 3))
    return feet.point.reshape(*us.shape, 3), feet.sigma_relative.reshape(us.shape)


def add_sheet(axes: Any, corners: Floats, colours: Floats | str, **style: Any) -> None:
    """Draw the cells of a grid (rows, columns, 3) that are known at all corners; a colour, or (rows, columns, 4)."""
    cells = np.stack([corners[:-1, :-1], corners[:-1, 1:], corners[1:, 1:], corners[1:, :-1]], axis=2).reshape(-1, 4, 3)
    known = np.isfinite(cells).all(axis=(1, 2))
    faces = colours if isinstance(colours, str) else colours[:-1, :-1].reshape(-1, 4)[known]
    axes.add_collection3d(
        Poly3DCollection(cells[known], facecolors=faces, linewidths=0, antialiased=False, **style), autolim=False
    )
    axes.auto_scale_xyz(*cells[known].reshape(-1, 3).T)


def draw_map_surface(
    part: Part, surface_map: SurfaceMap, plane: MapPlane, walked: Floats | None, shape: PlacedShape | None
) -> None:
    """Draw the map's one surface, coloured by its distance from the truth or by its own σ, in three dimensions."""
    part, scale = parts(part, 1, 2, width_ratios=(8, 1))
    axes = part.add_subplot(projection="3d", computed_zorder=False)
    points, sigma = map_surface(surface_map, plane)
    shown = ["surface: recovered, as far as 4 mm from a contact"]
    if walked is not None:
        shown.append("line: path of the contact")
        axes.plot(*plane.mm(walked).T, color=INK, linewidth=0.5, alpha=0.55, zorder=3)
    values, what, colours = 1e6 * sigma, "σ of the height, without tool and arm (µm)", colormaps["viridis"]
    if shape is not None:
        shown.append("light grey: true surface")
        near = plane.mm(true_surface(shape, surface_map.points, plane))
        axes.plot_surface(*np.moveaxis(near, 2, 0), color=GREY, alpha=0.25, linewidth=0, shade=True, zorder=1)
        values, what, colours = np.full(sigma.shape, np.nan), "above the true surface (µm)", colormaps["RdBu_r"]
        for place in zip(*np.nonzero(np.isfinite(points[:, :, 0])), strict=True):
            values[place] = 1e6 * shape.nearest(tuple(points[place].tolist())).distance
    known = np.abs(values[np.isfinite(values)])
    most = max(float(np.percentile(known, 98)), 1.0) if len(known) else 1.0
    norm = Normalize(0.0 if shape is None else -most, most)
    add_sheet(axes, plane.mm(points), colours.with_extremes(bad=GREY)(norm(np.ma.masked_invalid(values))), zorder=2)
    labels = ("along the scan (mm)", "across (mm)", "outward (mm)")
    box(part, axes, " · ".join(shown), labels, elev=42, azim=-68, beside_in=2.0)
    scale.colorbar(ScalarMappable(norm, colours), cax=scale.subplots(), label=what)


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
    common = any(surface_map.noise.common)
    with picture(
        path,
        f"{title}\none surface of {len(surface_map)} nodes: a node is the mean of the contacts along 1 mm of the path",
        7.8,
    ) as figure:
        upper, lower = parts(figure, 2, 1, height_ratios=(4, 3))
        draw_map_surface(upper, surface_map, plane, walked, shape)
        left, *right = parts(lower, 1, 2 if common else 1)
        _draw_disagreement(left, surface_map, plane, walked)
        for part in right:
            _draw_common(part, surface_map)


def _draw_disagreement(part: SubFigure, surface_map: SurfaceMap, plane: MapPlane, walked: Floats | None) -> None:
    axes = part.subplots()
    if walked is not None:
        path = plane.mm(walked)
        axes.plot(path[:, 0], path[:, 1], color=FAINT, linewidth=0.9, zorder=1)
    points = surface_map.points[drawn_rows(len(surface_map))]
    places, beyond = plane.mm(points), surface_map.disagreement(points)
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
