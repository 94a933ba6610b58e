"""The picture of study `workprec`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes

from canprobe.studies.figure import AMBER, BLUE, GREEN, GREY, INK, ORANGE, PINK, SHADE, legend, log_scale, picture

COLOURS = {
    "semi-implicit": AMBER,
    "rk4": ORANGE,
    "implicit": GREY,
    "rosenbrock": BLUE,
    "exponential": PINK,
    "adaptive": GREEN,
}
MEASURES = (
    ("force_percent", "force error (%)", "force"),
    ("position_um", "position error (µm)", "position"),
    ("taxel_counts", "taxel error (counts)", "taxels"),
)


def draw_workprec(
    rows: Sequence[dict[str, Any]], floors: Mapping[float, dict[str, float]], default: dict[str, Any], path: Path
) -> None:
    """Error against cost: a row of panels a measure, a column a stiffness."""
    from canprobe.studies.workprec import ENOUGH

    title = (
        "Dynamic plant: error against processor time a cycle of 2.5 ms, each dot a step size\n"
        "solid: mass matrix, bias and contact geometry held over a cycle; dotted: evaluated in every call\n"
        "ring: the default; open: rattles against a contact of 10 MN/m; shade: accurate enough"
    )
    with picture(path, title, 8.2) as figure:
        grid = figure.subplots(len(MEASURES), len(floors), squeeze=False, sharex=True, sharey="row")
        for line, (key, label, name) in zip(grid, MEASURES, strict=True):
            known = [r for r in rows if r[key] is not None]
            for axes, (stiffness, floor) in zip(line, floors.items(), strict=True):
                _draw(axes, [r for r in known if r["stiffness_n_m3"] == stiffness], key, floor[key], default)
                axes.axhspan(1e-12, ENOUGH[name], color=SHADE, linewidth=0, zorder=0)
                log_scale(axes, "xy")
            line[0].set_ylabel(label)
            seen = [ENOUGH[name], *(max(r[key], floors[r["stiffness_n_m3"]][key]) for r in known)]
            line[0].set_ylim(max(0.3 * min(seen), 1e-7), min(3.0 * max(seen), 1e3))
        for axes, stiffness in zip(grid[0], floors, strict=True):
            axes.set_title(f"K/h {stiffness:.3g} N/m³")
        for axes in grid[-1]:
            axes.set_xlabel("processor time a cycle (µs)")
        legend(figure)


def _draw(axes: Axes, rows: Sequence[dict[str, Any]], key: str, floor: float, default: dict[str, Any]) -> None:
    """One panel; nothing below the reference's own error."""
    for method, colour in COLOURS.items():
        for held, line in ((True, "-"), (False, ":")):
            mine = [r for r in rows if r["method"] == method and r["held"] is held]
            axes.plot(
                [r["cost_us"] for r in mine], [max(r[key], floor) for r in mine], line, color=colour,
                label=method if held else None,
            )  # fmt: skip
            for stands in (True, False):
                dots = [r for r in mine if r["stands"] is stands]
                axes.plot(
                    [r["cost_us"] for r in dots], [max(r[key], floor) for r in dots], "o", color=colour, markersize=4.5,
                    markerfacecolor=colour if stands else "white",
                )  # fmt: skip
    chosen = [r for r in rows if all(r[name] == value for name, value in default.items())]
    axes.plot(
        [r["cost_us"] for r in chosen], [max(r[key], floor) for r in chosen], "o", markersize=12,
        markerfacecolor="none", markeredgecolor=INK, markeredgewidth=1.4,
    )  # fmt: skip
