"""The picture of study `bound`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from canprobe.studies.figure import BLUE, INK, ORANGE, SHADE, legend, picture

RATIOS, COVERAGES = (0.0, 2.0), (0.85, 1.0)
"""What is shown; a case beyond is drawn at the edge."""


def draw_bound(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Error over bound, and coverage, of every case: a row of panels a method."""
    methods = list(dict.fromkeys(r["method"] for r in rows))
    surfaces = list(dict.fromkeys(r["surface"] for r in rows))
    title = (
        "Error of K over the Cramér–Rao bound, and share of 95 % regions that hold the truth: one mark a case\n"
        "filled: inside the region where a local quadratic bound means something; open: outside\n"
        "on each surface from left to right: 5 mm, 40 mm, 1 m in size, each with more and more noise\n"
        "shade: as it should be; what is beyond the scale is drawn at its edge"
    )
    with picture(path, title, 1.3 + 3.3 * len(methods)) as figure:
        grid = figure.subplots(2 * len(methods), 1, squeeze=False, sharex=True)[:, 0]
        for method, upper, lower in zip(methods, grid[::2], grid[1::2], strict=True):
            mine = [r for r in rows if r["method"] == method and r["ratio"] is not None]
            _draw(upper, mine, surfaces, "ratio", RATIOS)
            upper.axhline(1.0, color=INK)
            upper.axhspan(0.0, 1.1 if method == "ml" else 1.25, color=SHADE, linewidth=0, zorder=0)
            upper.set(title=f"{method}: error", ylabel="error / bound")
            _draw(lower, mine, surfaces, "coverage", COVERAGES)
            lower.axhline(0.95, color=INK)
            lower.axhspan(0.90, 0.99, color=SHADE, linewidth=0, zorder=0)
            lower.set(title=f"{method}: coverage of 95 % regions", ylabel="coverage")
        legend(figure)


def _draw(
    axes: Axes, rows: Sequence[dict[str, Any]], surfaces: Sequence[str], key: str, limits: tuple[float, float]
) -> None:
    for inside, colour in ((False, ORANGE), (True, BLUE)):
        for path, marker in (("weave", "o"), ("circle", "s")):
            mine = [r for r in rows if r["inside"] == inside and r["path"] == path]
            axes.scatter(
                [_place(r, surfaces) for r in mine], np.clip([r[key] for r in mine], *limits), s=22, marker=marker,
                linewidths=1.0, edgecolors=colour, facecolors=colour if inside else "none", clip_on=False, zorder=3,
                label=f"{path}, {'inside' if inside else 'outside'}",
            )  # fmt: skip
    axes.set_xticks(range(len(surfaces)), surfaces)
    axes.set_xlim(-0.6, len(surfaces) - 0.4)
    axes.set_ylim(limits[0], limits[1] + 0.07 * (limits[1] - limits[0]))
    axes.grid(visible=False, axis="x")


def _place(row: dict[str, Any], surfaces: Sequence[str]) -> float:
    """Smaller sizes to the left, more noise to the right."""
    size = 0.11 * (np.log10(row["size_mm"]) - 1.85)
    return surfaces.index(row["surface"]) + 2.2 * float(size) + 0.04 * float(np.log2(row["sigma_point_um"] / 20.0))
