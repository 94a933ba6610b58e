"""The picture of the whole cell's half of study `workprec`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from canprobe.studies.figure import FAINT, INK, METHODS, legend, log_scale, picture
from canprobe.studies.workprec_cell import CLASSICAL, FASTER, FD, FIDELITIES, default_of, good

MARKS = {"features": "^", "window": "o", "image": "s"}
SIZES = {100.0: 14.0, 200.0: 34.0, 400.0: 72.0, 500.0: 90.0, 1000.0: 140.0, 2000.0: 210.0}
PANELS = (
    ("curvature_percent", "curvature error (%)"),
    ("normal_deg", "normal error (deg)"),
    ("force_percent", "force error (%)"),
)
Row = dict[str, Any]


def draw_cell(rows: Sequence[Row], path: Path) -> None:
    """Error against cost: a row of panels a measure, a column a fidelity."""
    title = (
        "Whole cell: error against processor time a second of the scan, master, bus, nodes and plant in one process\n"
        f"ring: the default; star: the knee; not drawn: {_left_out(rows)}"
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


def _left_out(rows: Sequence[Row]) -> str:
    refused = sum(r["ended"] == "refused" for r in rows)
    stopped = sum(r["ended"] == "stopped" for r in rows)
    return f"{refused} settings that the plan refuses, {stopped} scans that were stopped for safety"


def _draw(axes: Axes, rows: Sequence[Row], key: str, fidelity: str) -> None:
    mine = [r for r in rows if r["fidelity"] == fidelity and r.get(key) is not None]
    for r in mine:
        filled = {CLASSICAL: METHODS[r["method"]], FASTER: FAINT}.get(r["bus"], "none")
        axes.scatter(
            r["cost_ms_per_s"], r[key], s=SIZES.get(r["rate_hz"], 110.0), marker=MARKS[r["mode"]],
            facecolor=filled, edgecolor=METHODS[r["method"]], linewidth=1.2,
        )  # fmt: skip
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
    found = [dot(m, c, "o", 7.0) for m, c in METHODS.items() if any(r["method"] == m for r in done)]
    found += [dot(m, INK, mark, 7.0) for m, mark in MARKS.items() if any(r["mode"] == m for r in done)]
    rates = sorted({r["rate_hz"] for r in done})
    found += [dot(f"{rate:.0f} Hz", INK, "o", SIZES.get(rate, 110.0) ** 0.5) for rate in rates]
    if any(r["bus"] == FD for r in done):
        found.append(dot("CAN FD", INK, "o", 7.0, "white"))
    if any(r["bus"] == FASTER for r in done):
        found.append(dot("8 Mbit/s, no CAN", INK, "o", 7.0, FAINT))
    return found
