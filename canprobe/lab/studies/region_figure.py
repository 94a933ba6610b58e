"""The picture of study `regions`: stated against true error of every scene, and coverage by kind."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from canprobe.cell.results.picture import AMBER, BLUE, INK, ORANGE, SHADE, legend, log_scale, parts, picture
from canprobe.lab.studies.region_scores import ScoredScan
from canprobe.lab.studies.result import Row

SHARES = (
    (0.8, 1.01, BLUE, "o", "80 % of the scene's regions or more hold the truth"),
    (0.4, 0.8, AMBER, "s", "40 to 80 %"),
    (0.0, 0.4, ORANGE, "v", "less than 40 %"),
)
"""Least and greatest share of the regions of a scene that hold the truth, with colour, marker and words."""
PANELS_IN_A_ROW = 4


def draw_regions(rows: Sequence[Row], scans: Sequence[ScoredScan], path: Path) -> None:
    """A panel for each kind with a mark for each scene; below them the coverage with its interval.

    Args:
        rows: rows of the table.
        scans: scans behind them.
        path: path of the picture.
    """
    kinds = [row for row in rows if row["group"] == "kind"]
    title = (
        "Whether the online estimator knows its error: each mark is a random scene, each panel a kind\n"
        "number: mean of stated over error; above the line: cautious; shade: as asked for, 0.9 to 1.4, 93 to 97 %\n"
        "lowest: share of the 95 % regions that hold the truth, with 95 % of the draws of scenes"
    )
    panels = kinds[:-1]
    lines = -(-len(panels) // PANELS_IN_A_ROW)
    with picture(path, title, 3.0 + 1.9 * lines) as figure:
        upper, lower = parts(figure, 2, 1, height_ratios=(1.9 * lines, 2.2))
        grid = upper.subplots(lines, PANELS_IN_A_ROW, squeeze=False, sharex=True, sharey=True)
        span = _span(scans)
        for axes, row in zip(grid.flat, panels, strict=False):
            mine = [scan for scan in scans if scan.kind == row["of"] and len(scan.scores)]
            _draw_kind(axes, f"{row['of']}: {row['stated_over_error']:.2f}", mine, span)
        for axes in grid.flat[len(panels) :]:
            axes.set_visible(False)
        for axes in grid[-1]:
            axes.set_xlabel("RMS error (1/m)")
        for line in grid:
            line[0].set_ylabel("stated (1/m)")
        legend(upper)
        _draw_coverage(lower.subplots(), kinds)


def _span(scans: Sequence[ScoredScan]) -> tuple[float, float]:
    """Least and greatest error of the scenes, true or stated."""
    found = [value for scan in scans if len(scan.scores) for value in (scan.error_per_m, scan.stated_per_m)]
    return (0.8 * min(found), 1.25 * max(found)) if found else (0.1, 10.0)


def _draw_kind(axes: Axes, title: str, scans: Sequence[ScoredScan], span: tuple[float, float]) -> None:
    ends = np.array(span)
    axes.fill_between(ends, 0.9 * ends, 1.4 * ends, color=SHADE, linewidth=0, zorder=0)
    axes.plot(ends, ends, color=INK, linewidth=0.8)
    for low, high, colour, marker, words in SHARES:
        mine = [scan for scan in scans if low <= scan.share < high]
        x, y = [scan.error_per_m for scan in mine], [scan.stated_per_m for scan in mine]
        axes.scatter(x, y, s=14, color=colour, marker=marker, label=words, zorder=3, linewidths=0)
    log_scale(axes, "xy")
    axes.set(title=title, xlim=span, ylim=span)


def _draw_coverage(axes: Axes, rows: Sequence[Row]) -> None:
    shown = [row for row in rows if not math.isnan(row["coverage"])]
    y = np.array([row["coverage"] for row in shown])
    bars = np.abs(np.array([[row[end] for row in shown] for end in ("coverage_low", "coverage_high")]) - y)
    axes.axhspan(0.93, 0.97, color=SHADE, linewidth=0, zorder=0)
    axes.errorbar(range(len(shown)), y, yerr=bars, fmt="o", markersize=4, linewidth=1, color=BLUE, zorder=3)
    axes.set_xticks(range(len(shown)), [row["of"] for row in shown], rotation=30, ha="right", rotation_mode="anchor")
    axes.set(ylabel="coverage", xlim=(-0.6, len(shown) - 0.4))
    axes.grid(visible=False, axis="x")
