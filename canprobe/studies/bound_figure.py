"""The picture of study `bound`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

INK, FAINT, IN, OUT = "#1f2933", "#d9dee4", "#0f6e84", "#c2410c"
CLIP = 5.0


def draw_bound(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Error over bound, and coverage, of every case: a column of panels a method."""
    methods = list(dict.fromkeys(r["method"] for r in rows))
    surfaces = list(dict.fromkeys(r["surface"] for r in rows))
    figure = Figure(figsize=(7.0 * len(methods), 8.0), dpi=110, layout="constrained")
    figure.suptitle(
        "Error of K over the Cramér–Rao bound, and share of 95 % regions that hold the truth: one dot a case\n"
        "filled: inside the region where a local quadratic bound means something; open: outside",
        x=0.01, ha="left", fontsize=11, color=INK,
    )  # fmt: skip
    grid = figure.subplots(2, len(methods), squeeze=False, sharex=True, sharey="row")
    for j, method in enumerate(methods):
        mine = [r for r in rows if r["method"] == method and r["ratio"] is not None]
        limit = 1.1 if method == "ml" else 1.25
        _draw(grid[0][j], mine, surfaces, "ratio", (0.0, CLIP))
        grid[0][j].axhline(1.0, color=INK, linewidth=1.0)
        grid[0][j].axhspan(0.0, limit, color=FAINT, alpha=0.5, linewidth=0, zorder=0)
        grid[0][j].set_title(f"{method}: error / bound (above {CLIP:g}: at the edge)", loc="left", fontsize=10)
        _draw(grid[1][j], mine, surfaces, "coverage", (0.0, 1.02))
        grid[1][j].axhline(0.95, color=INK, linewidth=1.0)
        grid[1][j].axhspan(0.90, 0.99, color=FAINT, alpha=0.5, linewidth=0, zorder=0)
        grid[1][j].set_title(f"{method}: coverage of 95 % regions", loc="left", fontsize=10)
    handles, labels = grid[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    figure.savefig(path)


def _draw(
    axes: Axes, rows: Sequence[dict[str, Any]], surfaces: Sequence[str], key: str, limits: tuple[float, float]
) -> None:
    for inside, colour in ((False, OUT), (True, IN)):
        for path, marker in (("weave", "o"), ("circle", "s")):
            mine = [r for r in rows if r["inside"] == inside and r["path"] == path]
            x = [_place(r, surfaces) for r in mine]
            y = np.clip([r[key] for r in mine], *limits) if mine else []
            axes.scatter(
                x, y, s=26, marker=marker, linewidths=1.0, edgecolors=colour,
                facecolors=colour if inside else "none", label=f"{path}, {'inside' if inside else 'outside'}", zorder=3,
            )  # fmt: skip
    axes.set_xticks(range(len(surfaces)), surfaces)
    axes.set_xlim(-0.6, len(surfaces) - 0.4)
    axes.set_ylim(limits[0] - 0.02 * limits[1], 1.03 * limits[1])
    axes.grid(color=FAINT, linewidth=0.6, axis="y")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _place(row: dict[str, Any], surfaces: Sequence[str]) -> float:
    """Smaller sizes to the left, more noise to the right."""
    size = 0.11 * (np.log10(row["size_mm"]) - 1.85)
    return surfaces.index(row["surface"]) + 2.2 * float(size) + 0.04 * float(np.log2(row["sigma_point_um"] / 20.0))
