"""The picture of the whole cell in study `workprec`: error against computing time, spread over seeds, and the bound."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from canprobe.cell.results.picture import FAINT, INK, METHOD_COLOURS, legend, log_scale, picture
from canprobe.lab.studies.result import Row
from canprobe.lab.studies.workprec_cell_choice import CLASSICAL, FASTER, FD, FIDELITIES, default_of, good

MARKS = {"features": "^", "window": "o", "image": "s"}
MARK_AREAS = {100.0: 14.0, 200.0: 34.0, 400.0: 72.0, 500.0: 90.0, 1000.0: 140.0, 2000.0: 210.0}
PANELS = (
    ("curvature_percent", "curvature error (%)"),
    ("normal_deg", "normal error (deg)"),
    ("force_percent", "force error (%)"),
)


def draw_cell(rows: Sequence[Row], path: Path) -> None:
    """Error against cost: a row of panels for each measure, a column for each fidelity."""
    refused, stopped = (sum(r["ended"] == how for r in rows) for how in ("refused", "stopped"))
    title = (
        "Whole cell, all in one process: error over the processor time that a second of a scan takes; best lower left\n"
        "a mark: rate, what the array sends, estimator and bus; ring: the default; star: cheapest that is good enough\n"
        "bars: lowest to highest of the seeds; short lines: Cramér–Rao bound, which only the curvature has\n"
        f"not drawn: {refused} settings that the plan refuses, {stopped} scans that were stopped for safety"
    )
    with picture(path, title, 9.6) as figure:
        grid = figure.subplots(len(PANELS), len(FIDELITIES), squeeze=False, sharex=True, sharey="row")
        for (key, label), line in zip(PANELS, grid, strict=True):
            for fidelity, axes in zip(FIDELITIES, line, strict=True):
                _draw(axes, rows, key, fidelity)
            line[0].set_ylabel(label)
        for fidelity, top, bottom in zip(FIDELITIES, grid[0], grid[-1], strict=True):
            top.set_title(f"{fidelity} plant")
            bottom.set_xlabel("processor time a second (ms)")
        legend(figure, _keys(rows))


def _draw(axes: Axes, rows: Sequence[Row], key: str, fidelity: str) -> None:
    mine = [r for r in rows if r["fidelity"] == fidelity and r.get(key) is not None]
    for r in mine:
        filled = {CLASSICAL: METHOD_COLOURS[r["method"]], FASTER: FAINT}.get(r["bus"], "none")
        axes.scatter(
            r["cost_ms_per_s"], r[key], s=MARK_AREAS.get(r["rate_hz"], 110.0), marker=MARKS[r["mode"]],
            facecolor=filled, edgecolor=METHOD_COLOURS[r["method"]], linewidth=1.2, zorder=3,
        )  # fmt: skip
        axes.vlines(
            r["cost_ms_per_s"], r[f"{key}_low"], r[f"{key}_high"], color=METHOD_COLOURS[r["method"]], linewidth=0.9
        )
        if key == "curvature_percent" and r["bound_percent"] is not None:
            axes.scatter(r["cost_ms_per_s"], r["bound_percent"], marker="_", s=30.0, color=INK, linewidth=0.9)
    knee, default = next(iter(good(rows, fidelity)), None), default_of(rows, fidelity)
    for chosen, mark, size in ((default, "o", 260.0), (knee, "*", 420.0)):
        if chosen is not None and chosen.get(key) is not None:
            axes.scatter(
                chosen["cost_ms_per_s"], chosen[key], s=size, marker=mark, facecolor="none", edgecolor=INK,
                linewidth=1.4,
            )  # fmt: skip
    axes.margins(0.12)
    log_scale(axes, "xy")


def _keys(rows: Sequence[Row]) -> list[Line2D]:
    """Colours, marks and sizes that occur."""

    def dot(label: str, colour: str, mark: str, size: float, fill: str | None = None) -> Line2D:
        face = colour if fill is None else fill
        return Line2D(
            [], [], linestyle="none", marker=mark, color=colour, markerfacecolor=face, markersize=size, label=label
        )

    done = [r for r in rows if r["ended"] == "done"]
    found = [dot(m, c, "o", 7.0) for m, c in METHOD_COLOURS.items() if any(r["method"] == m for r in done)]
    found += [dot(m, INK, mark, 7.0) for m, mark in MARKS.items() if any(r["mode"] == m for r in done)]
    rates = sorted({r["rate_hz"] for r in done})
    found += [dot(f"{rate:.0f} Hz", INK, "o", MARK_AREAS.get(rate, 110.0) ** 0.5) for rate in rates]
    if any(r.get("bound_percent") is not None for r in done):
        found.append(dot("Cramér–Rao bound", INK, "_", 7.0))
    if any(r["bus"] == FD for r in done):
        found.append(dot("CAN FD", INK, "o", 7.0, "white"))
    if any(r["bus"] == FASTER for r in done):
        found.append(dot("8 Mbit/s, no CAN", INK, "o", 7.0, FAINT))
    return found
