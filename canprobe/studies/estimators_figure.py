"""The picture of study `estimators`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes

from canprobe.studies.figure import INK, METHODS, SHADE, legend, log_scale, picture

BUDGET_MS = 5.0


def draw_estimators(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Error over the time of a frame with an answer: a row of panels a surface, a column a noise level."""
    surfaces = list(dict.fromkeys(r["surface"] for r in rows))
    noises = list(dict.fromkeys((r["sigma_point_um"], r["sigma_normal_mrad"]) for r in rows))
    title = (
        "Error of local curvature against the time of one tactile frame with an answer\n"
        "marker size: window of 40, 80, 160, 320 samples (5–40 mm of path); no marker: not observed\n"
        "dotted: Cramér–Rao bound of each window, and of all 480 samples (the memory of recursive fades)"
    )
    with picture(path, title, 1.1 + 2.7 * len(surfaces)) as figure:
        grid = figure.subplots(len(surfaces), len(noises), squeeze=False, sharex=True, sharey=True)
        for surface, line in zip(surfaces, grid, strict=True):
            of_surface = [r for r in rows if r["surface"] == surface]
            for (point, normal), axes in zip(noises, line, strict=True):
                _draw_panel(axes, [r for r in of_surface if r["sigma_point_um"] == point])
                axes.set_title(f"{surface}, σ {point:.0f} µm, {normal:.1f} mrad")
            line[0].set_ylabel("RMS error of K (%)")
        for axes in grid[-1]:
            axes.set_xlabel("time of a frame with an answer (ms)")
        legend(figure)


def _draw_panel(axes: Axes, rows: Sequence[dict[str, Any]]) -> None:
    ends: list[tuple[float, float, str]] = []
    for method, lag in dict.fromkeys((r["method"], r["lag_samples"]) for r in rows):
        line = [r for r in rows if r["method"] == method and r["lag_samples"] == lag]
        x = [(r["add_us"] + r["answer_us"]) * 1e-3 for r in line]
        y = [r["error_percent"] for r in line]
        axes.plot(x, y, color=METHODS[method], alpha=0.8)
        sizes = [12.0 * r["window_samples"] / 40 for r in line]
        axes.scatter(x, y, s=sizes, color=METHODS[method], label=method, zorder=3, linewidths=0)
        if lag is not None and x and math.isfinite(y[-1]):
            ends.append((y[-1], x[-1], str(lag)))
    _name_lags(axes, sorted(ends))
    for r in rows:
        if r["method"] == "ml":
            _draw_bound(axes, r["bound_percent"], str(r["window_samples"]))
    _draw_bound(axes, next(r["bound_percent"] for r in rows if r["method"] == "recursive"), "all 480")
    axes.axvspan(BUDGET_MS, 1e3, color=SHADE, linewidth=0, zorder=0)
    axes.axvline(BUDGET_MS, color=INK, label="budget of a tactile frame, 5 ms")
    log_scale(axes, "xy")
    axes.set_xlim(0.2, 200.0)


def _name_lags(axes: Axes, ends: Sequence[tuple[float, float, str]]) -> None:
    """A name at the end of each line; one for those that end together."""
    together: list[list[tuple[float, float, str]]] = []
    for end in ends:
        if together and end[0] < 1.25 * together[-1][-1][0]:
            together[-1].append(end)
        else:
            together.append([end])
    for lines in together:
        y = math.sqrt(lines[0][0] * lines[-1][0])
        text = "lag " + ", ".join(sorted((lag for *_, lag in lines), key=int))
        at = (max(x for _, x, _ in lines), y)
        axes.annotate(text, at, textcoords="offset points", xytext=(7, -2), fontsize="small")


def _draw_bound(axes: Axes, percent: float, text: str) -> None:
    axes.axhline(percent, color=INK, linewidth=0.8, linestyle=":", label="Cramér–Rao bound")
    axes.annotate(
        text, (0.0, percent), xycoords=("axes fraction", "data"), textcoords="offset points", xytext=(3, 2),
        fontsize="small",
    )  # fmt: skip
