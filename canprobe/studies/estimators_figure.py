"""The picture of study `estimators`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

INK, FAINT, BOUND = "#1f2933", "#d9dee4", "#8a94a0"
COLOURS = {"chen1996": "#8a94a0", "chord": "#b7791f", "ml": "#0f6e84", "recursive": "#c2410c"}
BUDGET_MS = 5.0


def draw_estimators(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Error over the time of a frame with an answer: a row of panels a surface, a column a noise level."""
    surfaces = list(dict.fromkeys(r["surface"] for r in rows))
    noises = list(dict.fromkeys((r["sigma_point_um"], r["sigma_normal_mrad"]) for r in rows))
    figure = Figure(figsize=(4.3 * len(noises), 3.9 * len(surfaces)), dpi=110, layout="constrained")
    figure.suptitle(
        "Error of local curvature against the time of one tactile frame with an answer\n"
        "marker size: window of 40, 80, 160, 320 samples (5–40 mm of path); no marker: not observed\n"
        "dotted: Cramér–Rao bound of each window, and of all 480 samples (the memory of recursive fades)",
        x=0.01, ha="left", fontsize=11, color=INK,
    )  # fmt: skip
    grid = figure.subplots(len(surfaces), len(noises), squeeze=False, sharex=True, sharey=True)
    for i, surface in enumerate(surfaces):
        for j, noise in enumerate(noises):
            mine = [
                r for r in rows if r["surface"] == surface and (r["sigma_point_um"], r["sigma_normal_mrad"]) == noise
            ]
            _draw_panel(grid[i][j], mine)
            grid[i][j].set_title(
                f"{surface}, σ {noise[0]:.0f} µm, {noise[1]:.1f} mrad", loc="left", fontsize=10, color=INK
            )
    for axes in grid[-1]:
        axes.set_xlabel("time of a frame with an answer (ms)")
    for line in grid:
        line[0].set_ylabel("RMS error of K (%)")
    handles, labels = grid[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False, fontsize=9)
    figure.savefig(path)


def _draw_panel(axes: Axes, rows: Sequence[dict[str, Any]]) -> None:
    named: set[str] = set()
    ends: list[tuple[float, float, str]] = []
    for method, lag in dict.fromkeys((r["method"], r["lag_samples"]) for r in rows):
        line = [r for r in rows if r["method"] == method and r["lag_samples"] == lag]
        x = [(r["add_us"] + r["answer_us"]) * 1e-3 for r in line]
        y = [r["error_percent"] for r in line]
        axes.plot(x, y, color=COLOURS[method], linewidth=1.0, alpha=0.8)
        sizes = [12.0 * r["window_samples"] / 40 for r in line]
        axes.scatter(
            x, y, s=sizes, color=COLOURS[method], label=None if method in named else method, zorder=3, linewidths=0
        )
        named.add(method)
        if lag is not None and x and math.isfinite(y[-1]):
            ends.append((y[-1], x[-1], str(lag)))
    _name_lags(axes, sorted(ends))
    for r in rows:
        if r["method"] == "ml":
            _draw_bound(axes, r["bound_percent"], str(r["window_samples"]), r["window_samples"] == 40)
    whole = next(r["bound_percent"] for r in rows if r["method"] == "recursive")
    _draw_bound(axes, whole, "all 480", False)
    axes.axvspan(BUDGET_MS, 1e3, color=FAINT, alpha=0.5, linewidth=0)
    axes.axvline(BUDGET_MS, color=INK, linewidth=1.0, label="budget of a tactile frame, 5 ms")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(0.2, 100.0)
    axes.grid(color=FAINT, linewidth=0.6)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


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
        axes.annotate(text, at, textcoords="offset points", xytext=(7, -2), fontsize=7, color=BOUND)


def _draw_bound(axes: Axes, percent: float, text: str, named: bool) -> None:
    axes.axhline(percent, color=INK, linewidth=0.8, linestyle=":", label="Cramér–Rao bound" if named else None)
    axes.annotate(
        text, (1.0, percent), xycoords=("axes fraction", "data"), textcoords="offset points", xytext=(-2, 2),
        ha="right", fontsize=7, color=INK,
    )  # fmt: skip
