"""The picture of study `region`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from canprobe.studies.bound import AT
from canprobe.studies.bound_cases import REGION

INK, FAINT = "#1f2933", "#d9dee4"
COLOURS = {"ml": "#0f6e84", "recursive": "#c2410c"}
NAMES = {
    "path": "path / radius",
    "bound": "bound / size of K",
    "κσ": "κσ_p, rad",
    "cubic": "cubic terms / bound",
    "spread": "noise / spread of points",
}
CLIP = 3.0


def draw_region(measured: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Error over bound and coverage of every case against each limit: a column of panels a limit."""
    figure = Figure(figsize=(16.0, 6.4), dpi=110, layout="constrained")
    figure.suptitle(
        "How far out the bound means something: each case against each limit (line); grey: asked for",
        x=0.01, ha="left", fontsize=11, color=INK,
    )  # fmt: skip
    grid = figure.subplots(2, len(NAMES), sharey="row", sharex="col")
    for j, (limit, name) in enumerate(NAMES.items()):
        for row, (key, band, top) in enumerate((("ratio", (0.0, 1.25), CLIP), ("coverage", (0.90, 1.0), 1.0))):
            axes = grid[row][j]
            axes.axhspan(*band, color=FAINT, alpha=0.6, linewidth=0, zorder=0)
            axes.axvline(REGION[limit], color=INK, linewidth=0.9)
            for method, colour in COLOURS.items():
                mine = [r for r in measured if r["method"] == method and r[key] is not None]
                axes.scatter(
                    [max(r[AT + limit], 1e-4) for r in mine], [min(r[key], top) for r in mine],
                    s=14, color=colour, alpha=0.6, linewidths=0, label=method, zorder=3,
                )  # fmt: skip
            axes.set_xscale("log")
            for side in ("top", "right"):
                axes.spines[side].set_visible(False)
        grid[1][j].set_xlabel(name)
    grid[0][0].set_ylabel(f"error / bound (above {CLIP:g}: at the edge)")
    grid[1][0].set_ylabel("coverage of 95 % regions")
    figure.legend(*grid[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    figure.savefig(path)
