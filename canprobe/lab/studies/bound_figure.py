"""The picture of study `bound`: error over bound, and coverage, of every case."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from canprobe.cell.results.picture import BLUE, INK, ORANGE, SHADE, legend, picture
from canprobe.lab.studies.result import Row

RATIOS, COVERAGES = (0.0, 2.0), (0.85, 1.0)
"""Scales of the picture; a case beyond is drawn at the edge."""


def draw_bound(rows: Sequence[Row], path: Path) -> None:
    """Error over bound, and coverage, of every case: two panels for each method."""
    methods = list(dict.fromkeys(r["method"] for r in rows))
    surfaces = list(dict.fromkeys(r["surface"] for r in rows))
    title = (
        "Error of curvature over the least that any estimator can have (Cramér–Rao bound; below 1 the prior helps),\n"
        "and how often the stated 95 % regions hold the true curvature; a mark: one surface, size, noise and path\n"
        "filled: a local quadric describes the contacts (inside), so the bound has a meaning; open: it does not\n"
        "on each surface from left to right: 5 mm, 40 mm, 1 m in size, each with more and more noise\n"
        "shade: target; values beyond the scale are drawn at its edge"
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


def _draw(axes: Axes, rows: Sequence[Row], surfaces: Sequence[str], key: str, limits: tuple[float, float]) -> None:
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


def _place(row: Row, surfaces: Sequence[str]) -> float:
    """Smaller sizes to the left, more noise to the right."""
    size = 0.11 * (np.log10(row["size_mm"]) - 1.85)
    return surfaces.index(row["surface"]) + 2.2 * float(size) + 0.04 * float(np.log2(row["sigma_point_um"] / 20.0))
