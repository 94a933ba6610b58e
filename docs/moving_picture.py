"""Draw docs/img/scan.webp, the moving picture of the README: a scan as it goes. `python docs/measure.py pictures`"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from canprobe.cell.results.picture import BLUE, FAINT, GREY, INK, ORANGE
from canprobe.cell.results.run_data import RunData
from canprobe.cell.results.surface_figure import MapPlane, true_surface
from canprobe.cell.tasks.task import Phase

FRAMES, FRAME_MS, DPI = 48, 90, 90


def draw_moving(result: RunData, path: Path) -> None:
    """Draw the contact's path over the true surface, force, curvature and taxel image of a scan, as they grow."""
    log = result.log
    rows = np.flatnonzero((log["phase"] == Phase.SCAN) & np.isfinite(log["contact_mm"]).all(axis=1))
    ends = rows[np.linspace(0, len(rows) - 1, FRAMES + 1).astype(int)[1:]]
    frames = [_frame(result, rows[rows <= end]) for end in ends]
    frames[0].save(path, save_all=True, append_images=frames[1:], duration=FRAME_MS, loop=0, quality=60, method=6)


def _frame(result: RunData, rows: NDArray[np.intp]) -> Image.Image:
    log, answers = result.log, next(found for found in result.estimates.values() if found)
    scan = np.flatnonzero(log["phase"] == Phase.SCAN)
    points = log["contact_mm"]
    t, now = log["t_s"], float(log["t_s"][rows[-1]])
    figure = Figure(figsize=(8.0, 3.2), dpi=DPI)
    place = figure.add_axes((0.0, 0.0, 0.52, 1.0), projection="3d", computed_zorder=False)
    whole = points[scan][np.isfinite(points[scan]).all(axis=1)] * 1e-3
    shape = result.plan.setup.truth.object
    assert shape is not None
    sheet = 1e3 * true_surface(shape, whole, MapPlane.of(whole, log["normal"][scan][: len(whole)]))
    place.plot_surface(*np.moveaxis(sheet, 2, 0), color=GREY, alpha=0.35, linewidth=0, zorder=1)
    place.plot(*points[rows].T, color=ORANGE, linewidth=1.4, zorder=3)
    place.plot(*points[rows[-1:]].T, "o", color=INK, markersize=6, zorder=4)
    place.set_axis_off()
    place.set_aspect("equal")
    place.view_init(elev=38, azim=-160)
    place.set_box_aspect(place.get_box_aspect(), zoom=1.3)
    force = figure.add_axes((0.59, 0.62, 0.22, 0.24))
    force.plot(t[rows], log["force_n"][rows], color=BLUE, linewidth=0.8)
    force.set(title="force (N)", xlim=(t[scan[0]], t[scan[-1]]), ylim=(0.0, 3.0))
    bend = figure.add_axes((0.59, 0.14, 0.22, 0.28))
    known = [(one.t_s, *one.estimate.kappa) for one in answers if one.t_s <= now]
    if known:
        times, *kappa = np.array(known).T
        for values, colour in zip(kappa, (ORANGE, BLUE), strict=True):
            bend.plot(times, values, color=colour, linewidth=1.2)
    bend.set(title="curvatures (1/m)", xlim=(t[scan[0]], t[scan[-1]]), ylim=(-8.0, 36.0))
    for axes in (force, bend):
        axes.tick_params(labelsize=7)
        axes.title.set_fontsize(8)
        axes.grid(color=FAINT, linewidth=0.5)
        axes.spines[["top", "right"]].set_visible(False)
    taxels = figure.add_axes((0.84, 0.35, 0.15, 0.375))
    tactile = result.tactile
    image = int(np.searchsorted(tactile["t_s"], now, side="right")) - 1
    taxels.imshow(tactile["taxels"][max(image, 0)], cmap="magma", origin="lower", vmin=0, vmax=140)
    taxels.set_axis_off()
    taxels.set_title("taxels", fontsize=8)
    drawn = io.BytesIO()
    FigureCanvasAgg(figure).print_png(drawn)
    return Image.open(drawn).convert("RGB")
