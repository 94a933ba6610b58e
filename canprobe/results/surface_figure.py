"""The figure of a surface map: its surface over the true object, where passes cross, and their p-values."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import SubFigure
from numpy.typing import NDArray

from canprobe.results.picture import BLUE, FAINT, GREEN, GREY, INK, ORANGE, Part, box, legend, parts, picture
from canprobe.results.scores import SAME_DIRECTION_RAD
from canprobe.results.summary import RunResult
from canprobe.scene.geometry import true_object
from canprobe.touch.consistency import LEVEL, Consistency, check_consistency
from canprobe.touch.linear_algebra import tangent_rotation
from canprobe.touch.meshing import Mesh
from canprobe.touch.shapes import PlacedShape
from canprobe.touch.surface_map import SurfaceMap

# What the panels of a surface figure share: the map, its tests, the true object, the plane of the scan.

Array = NDArray[np.float64]
MARGIN_M, GRID = 5e-3, 34
"""How far a drawn surface goes beyond a path, and its points a side."""


class MapView(NamedTuple):
    """A map as seen along its mean normal; `axes` (3, 3) rows along, across, outward, `origin` (3,) its middle, m."""

    map: SurfaceMap
    consistency: Consistency
    shape: PlacedShape | None
    axes: Array
    origin: Array

    def plane(self, points: Array) -> Array:
        """(n, 3) mm along, across, outward from the middle of the map."""
        result: Array = (points - self.origin) @ self.axes.T * 1e3
        return result


def view_of(surface_map: SurfaceMap, consistency: Consistency, shape: PlacedShape | None) -> MapView:
    """The view of a map with at least one patch and of its tests; `shape` is the true object or None."""
    path = surface_map.path if len(surface_map.path) else surface_map.points
    middle = 0.5 * (path.min(axis=0) + path.max(axis=0))
    outward = surface_map.normals.mean(axis=0)
    R = tangent_rotation(outward / np.linalg.norm(outward))
    flat = (path - middle) @ R[:, :2]
    _, _, main = np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)
    along = R[:, :2] @ main[0]
    axes = np.array([along, np.cross(R[:, 2], along), R[:, 2]])
    return MapView(surface_map, consistency, shape, axes, middle)


def rejected(consistency: Consistency) -> NDArray[np.bool_]:
    """(n,) whether the joint test of each crossing rejects one surface."""
    return np.array([c.joint.p < LEVEL for c in consistency.crossings], dtype=bool)


def true_surface(shape: PlacedShape, path: Array, axes: Array, origin: Array) -> Array:
    """An object's surface below a path (n, 3): (3, GRID, GRID) mm along the rows of `axes` (3, 3) from `origin`."""
    flat = (path - origin) @ axes.T
    low, high = flat.min(axis=0) - MARGIN_M, flat.max(axis=0) + MARGIN_M
    us, vs = np.meshgrid(np.linspace(low[0], high[0], GRID), np.linspace(low[1], high[1], GRID))
    above = np.stack((us, vs, np.full_like(us, high[2])), axis=-1) @ axes + origin
    feet = np.array([shape.closest(point).point for point in above.reshape(-1, 3)])
    result: Array = ((feet - origin) @ axes.T * 1e3).T.reshape(3, GRID, GRID)
    return result


# The surface of the map over the true object.

CELL_M = 0.75e-3
"""Of the mesh."""


def draw_mesh(part: Part, view: MapView) -> None:
    """Draw the map's one surface, coloured by its distance from the truth or by its own σ, in three dimensions."""
    part, scale = parts(part, 1, 2, width_ratios=(8, 1))
    axes = part.add_subplot(projection="3d", computed_zorder=False)
    path = view.plane(view.map.path)
    if view.shape is not None:
        near = true_surface(view.shape, view.map.path, view.axes, view.origin)
        axes.plot_surface(*near, color=GREY, alpha=0.25, linewidth=0, shade=True, zorder=1)
    mesh = view.map.mesh(cell=CELL_M)
    values, what, colours = _colours(mesh, view.shape)
    colours = colours.with_extremes(bad=GREY)
    norm = _scale(values, signed=view.shape is not None)
    if len(mesh.triangles):
        x, y, z = view.plane(mesh.vertices).T
        drawn = axes.plot_trisurf(
            x, y, z, triangles=mesh.triangles, cmap=colours, norm=norm, linewidth=0, antialiased=False, zorder=2
        )
        drawn.set_array(values[mesh.triangles].mean(axis=1))
    axes.plot(*path.T, color=INK, linewidth=0.5, alpha=0.55, zorder=3)
    differ = rejected(view.consistency)
    if differ.any():
        places = np.array([c.T_base_common[:3, 3] for c in view.consistency.crossings])[differ]
        axes.plot(*view.plane(places).T, "o", color=ORANGE, markersize=3.5, zorder=4)
    labels = ("along the scan (mm)", "across (mm)", "outward (mm)")
    shown = ["the map's surface, as far as its patches reach", "line: the contact's path"]
    shown += ["true surface in light grey"] if view.shape is not None else []
    shown += ["orange: passes differ, p < 0.05"] if differ.any() else []
    box(part, axes, " · ".join(shown), labels, elev=42, azim=-68)
    scale.colorbar(ScalarMappable(norm, colours), cax=scale.subplots(), label=what)


def _colours(mesh: Mesh, shape: PlacedShape | None) -> tuple[Array, str, Colormap]:
    """(n,) values at the vertices, µm, what they are, and their colours."""
    if shape is None:
        return 1e6 * mesh.sigma, "σ of the surface's height (µm)", colormaps["viridis"]
    above = np.array([shape.nearest(tuple(p)).distance for p in mesh.vertices.tolist()])
    return 1e6 * above, "above the true surface (µm)", colormaps["RdBu_r"]


def _scale(values: Array, *, signed: bool) -> Normalize:
    known = np.abs(values[np.isfinite(values)])
    most = max(float(np.percentile(known, 98)), 1.0) if len(known) else 1.0
    return Normalize(-most if signed else 0.0, most)


# The figure of a surface map: its surface over the true object, where passes cross, and their p-values.

PARTS = (("curvature", ORANGE), ("normal", BLUE), ("height", GREEN))


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
    """Draw a map: its surface over the true object, crossings in the plane of the scan, their p-values.

    Args:
        surface_map: with at least one patch.
        path: of the PNG.
        consistency: the tests at its crossings; None for `check_consistency`, which takes a second.
        shape: the true object, for the ghost below the surface and for errors; None colours by σ.
        title: first line.
    """
    view = view_of(surface_map, consistency or check_consistency(surface_map), shape)
    crossings = len(view.consistency.crossings)
    told = (
        f"{title}\n{len(surface_map)} patches over {1e3 * surface_map.travelled[-1]:.0f} mm of path by"
        f" {surface_map.method or 'an estimator'}, {crossings} crossings"
    )
    with picture(path, told, 7.8) as figure:
        upper, lower = parts(figure, 2, 1, height_ratios=(4, 3))
        draw_mesh(upper, view)
        left, *right = parts(lower, 1, 2 if crossings else 1)
        _draw_crossings(left, view)
        for part in right:
            _draw_p_values(part, view.consistency)


def _draw_crossings(part: SubFigure, view: MapView) -> None:
    axes = part.subplots()
    path = view.plane(view.map.path)
    axes.plot(path[:, 0], path[:, 1], color=FAINT, linewidth=0.9, zorder=1)
    crossings = view.consistency.crossings
    if crossings:
        places = view.plane(np.array([c.T_base_common[:3, 3] for c in crossings]))
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
    axes.set_title("p-values of the tests at the crossings")
    legend(part)
