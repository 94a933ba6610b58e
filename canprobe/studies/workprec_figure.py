"""The picture of study `workprec`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

INK, FAINT = "#1f2933", "#d9dee4"
COLOURS = {
    "semi-implicit": "#b45309",
    "rk4": "#c2410c",
    "implicit": "#64748b",
    "rosenbrock": "#0f6e84",
    "exponential": "#6d28d9",
    "adaptive": "#15803d",
}
MEASURES = (
    ("force_percent", "force error, %", "force"),
    ("position_um", "position error, µm", "position"),
    ("taxel_counts", "taxel error, counts", "taxels"),
)


def draw_workprec(
    rows: Sequence[dict[str, Any]], floors: Mapping[float, dict[str, float]], default: dict[str, Any], path: Path
) -> None:
    """Error against cost: a row of panels a measure, a column a stiffness."""
    from canprobe.studies.workprec import ENOUGH

    figure = Figure(figsize=(4.2 * len(floors), 10.0), dpi=110, layout="constrained")
    figure.suptitle(
        "Dynamic plant: error against processor time a cycle of 2.5 ms, each dot a step size\n"
        "solid: mass matrix, bias and contact geometry held over a cycle; dotted: evaluated in every call; "
        "ring: the default; grey: accurate enough",
        x=0.01, ha="left", fontsize=11, color=INK,
    )  # fmt: skip
    grid = figure.subplots(len(MEASURES), len(floors), squeeze=False, sharex=True, sharey="row")
    for i, (key, label, name) in enumerate(MEASURES):
        for axes, (stiffness, floor) in zip(grid[i], floors.items(), strict=True):
            mine = [r for r in rows if r["stiffness_n_m3"] == stiffness and r[key] is not None]
            _draw(axes, mine, key, floor[key], default)
            axes.axhspan(1e-12, ENOUGH[name], color=FAINT, alpha=0.5, linewidth=0)
            if i == 0:
                axes.set_title(f"K/h {stiffness:.3g} N/m³", loc="left", fontsize=10)
            if i == len(MEASURES) - 1:
                axes.set_xlabel("µs a cycle")
        grid[i][0].set_ylabel(label)
        low = min((f[key] for f in floors.values()), default=1e-6)
        grid[i][0].set_ylim(max(low, 1e-7), 1e3)
    handles, labels = grid[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False, fontsize=9)
    figure.savefig(path)


def _draw(axes: Axes, rows: Sequence[dict[str, Any]], key: str, floor: float, default: dict[str, Any]) -> None:
    """One panel; nothing below the reference's own error."""
    for method, colour in COLOURS.items():
        for held, line in ((True, "-"), (False, ":")):
            mine = [r for r in rows if r["method"] == method and r["held"] is held]
            axes.plot(
                [r["cost_us"] for r in mine], [max(r[key], floor) for r in mine], line, color=colour, linewidth=1.2,
                marker="o", markersize=3.5, label=method if held else None,
            )  # fmt: skip
    chosen = [r for r in rows if all(r[name] == value for name, value in default.items())]
    axes.plot(
        [r["cost_us"] for r in chosen], [max(r[key], floor) for r in chosen], "o", markersize=12,
        markerfacecolor="none", markeredgecolor=INK, markeredgewidth=1.4,
    )  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.grid(color=FAINT, linewidth=0.6)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
