"""The surface of a map over the true object, in three dimensions."""

from __future__ import annotations

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize

from canprobe.cell.results.picture import GREY, INK, Part, box, parts
from canprobe.cell.results.surface_panels import MapView, add_sheet, map_surface, true_surface
from canprobe.mechanics.touch.shapes import PlacedShape
from canprobe.mechanics.types import Floats


def draw_map_surface(part: Part, view: MapView) -> None:
    """Draw the map's one surface, coloured by its distance from the truth or by its own σ, in three dimensions."""
    part, scale = parts(part, 1, 2, width_ratios=(8, 1))
    axes = part.add_subplot(projection="3d", computed_zorder=False)
    plane = view.plane
    shown, points = ["surface: recovered, as far as 4 mm from a contact"], view.map.points
    if view.path is not None:
        shown.append("line: path of the contact")
    if view.shape is not None:
        shown.append("light grey: true surface")
        near = plane.mm(true_surface(view.shape, points, plane))
        axes.plot_surface(*np.moveaxis(near, 2, 0), color=GREY, alpha=0.25, linewidth=0, shade=True, zorder=1)
    points, sigma = map_surface(view.map, plane)
    values, what, colours = _values(points, sigma, view.shape)
    norm = _scale(values, signed=view.shape is not None)
    add_sheet(axes, plane.mm(points), colours.with_extremes(bad=GREY)(norm(np.ma.masked_invalid(values))), zorder=2)
    if view.path is not None:
        axes.plot(*plane.mm(view.path).T, color=INK, linewidth=0.5, alpha=0.55, zorder=3)
    labels = ("along the scan (mm)", "across (mm)", "outward (mm)")
    box(part, axes, " · ".join(shown), labels, elev=42, azim=-68, beside_in=2.0)
    scale.colorbar(ScalarMappable(norm, colours), cax=scale.subplots(), label=what)


def _values(points: Floats, sigma: Floats, shape: PlacedShape | None) -> tuple[Floats, str, Colormap]:
    """Values (rows, columns) of a surface, µm, their name, and their colours."""
    if shape is None:
        return 1e6 * sigma, "σ of the surface's height (µm)", colormaps["viridis"]
    above = np.full(sigma.shape, np.nan)
    for place in zip(*np.nonzero(np.isfinite(points[:, :, 0])), strict=True):
        above[place] = shape.nearest(tuple(points[place].tolist())).distance
    return 1e6 * above, "above the true surface (µm)", colormaps["RdBu_r"]


def _scale(values: Floats, *, signed: bool) -> Normalize:
    known = np.abs(values[np.isfinite(values)])
    most = max(float(np.percentile(known, 98)), 1.0) if len(known) else 1.0
    return Normalize(-most if signed else 0.0, most)
