"""The picture of study `stability`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from canprobe.studies.figure import AMBER, BLUE, GREY, INK, ORANGE, PINK, legend, log_scale, parts, picture
from canprobe.studies.stability import approach_limit
from canprobe.studies.stability_loop import Array, ForceLoop, spectral_radius
from canprobe.studies.stability_runs import Case, loop_of

Row = dict[str, Any]
ENDS = {
    "stable": (BLUE, "o", "stable within limits"),
    "stopped": (AMBER, "s", "stopped safely"),
    "refused": (GREY, "X", "refused by the plan"),
    "hunting": (PINK, "D", "force not settled"),
    "failed": (ORANGE, "v", "failed"),
}
"""How a touch ended: colour, marker, words."""
VIEWS = {"told": "believes what it was told", "felt": "feels the stiffness"}
SIDES = {"drives": "bandwidth of the drives", "pose": "pose", "radii": "radii", "speed": "speed of a scan"}
COLUMNS = 3


def draw_stability(rows: Sequence[Row], path: Path) -> None:
    """The map: a panel for each servo and bus; below, how the other cases end."""
    buses = list(dict.fromkeys((r["rate_hz"], r["late_ms"]) for r in rows if r["view"] in VIEWS))
    title = (
        "Force loop: largest eigenvalue over one period of the sensor, and how touches in lockstep end\n"
        "shade: the eigenvalue; black line: where it is 1, unstable to the right; marks: touches carried out\n"
        "dotted: from here on the approach at 4 mm/s is over the force limit before its first sample can stop it"
    )
    lines = -(-len(buses) // COLUMNS)
    with picture(path, title, 4.3 + 1.75 * lines * len(VIEWS)) as figure:
        *maps, lower = parts(figure, len(VIEWS) + 1, 1, height_ratios=(*[1.75 * lines] * len(VIEWS), 3.2))
        stiffness = np.geomspace(70.0, 1.5e7, 40)
        for part, (view, words) in zip(maps, VIEWS.items(), strict=True):
            part.suptitle(f"servo that {words}", x=0.01, ha="left", fontsize="medium", fontweight="bold")
            ratios = [loop_of(Case(view, float(k), feels=view == "felt")).depth_ratio for k in stiffness]
            grid = part.subplots(lines, min(COLUMNS, len(buses)), squeeze=False, sharex=True, sharey=True)
            for axes in grid.flat[len(buses) :]:
                axes.set_visible(False)
            for axes, (rate, late) in zip(grid.flat, buses, strict=False):
                mine = [r for r in rows if r["view"] == view and (r["rate_hz"], r["late_ms"]) == (rate, late)]
                _draw_map(axes, stiffness, ratios, loop_of(Case(view, 1e4, rate_hz=rate, late_ms=late)), mine)
                axes.set_title(f"{rate:g} Hz" + (f", {late:g} ms late" if late else ""))
            for axes in grid[-1]:
                axes.set_xlabel("contact stiffness (N/m)")
            for line in grid:
                line[0].set_ylabel("force gain (Hz)")
        sides = {view: [r for r in rows if r["view"] == view] for view in SIDES}
        panels = lower.subplots(1, len(sides), squeeze=False)[0]
        for axes, (view, mine) in zip(panels, sides.items(), strict=True):
            _draw_side(axes, SIDES[view], mine)
        marks = [Line2D([], [], color=c, marker=m, linestyle="", label=words) for c, m, words in ENDS.values()]
        legend(lower, marks)


def _draw_map(axes: Axes, stiffness: Array, ratios: Sequence[float], bus: ForceLoop, rows: Sequence[Row]) -> None:
    """One panel of the map."""
    gains = np.geomspace(1.5, 70.0, 20)
    radius = [
        [spectral_radius(replace(bus, depth_ratio=ratio, height_hz=float(gain))) for ratio in ratios] for gain in gains
    ]
    axes.contourf(stiffness, gains, radius, levels=np.linspace(0.0, 2.0, 11), cmap="Greys", alpha=0.35, extend="both")
    axes.contour(stiffness, gains, radius, levels=[1.0], colors=INK, linewidths=1.6)
    if rows:
        axes.axvline(approach_limit(rows[0]), color=INK, linestyle=":", linewidth=1.2)
    for row in rows:
        _mark(axes, row, row["contact_n_m"], row["height_hz"])
    log_scale(axes, "xy")
    axes.set_yticks([2.0, 8.0, 25.0])
    axes.grid(visible=False)


def _mark(axes: Axes, row: Row, x: float, y: float) -> None:
    colour, marker, _ = ENDS[row["ended"]]
    axes.plot(x, y, marker, color=colour, markersize=6, markeredgecolor="white", markeredgewidth=0.5)


def _draw_side(axes: Axes, title: str, rows: Sequence[Row]) -> None:
    """How the cases of one line end: a mark each, in a table of what they are."""
    places = [_place(r) for r in rows]
    lines, columns = (list(dict.fromkeys(names)) for names in zip(*places, strict=True)) if places else ([], [])
    for row, (line, column) in zip(rows, places, strict=True):
        _mark(axes, row, columns.index(column), lines.index(line))
    axes.set_yticks(range(len(lines)), lines)
    axes.set_xticks(range(len(columns)), columns, rotation=45, ha="right", rotation_mode="anchor")
    axes.set(title=title, xlim=(-0.6, len(columns) - 0.4), ylim=(max(len(lines), 1) - 0.5, -0.5))
    axes.spines["bottom"].set_visible(False)


def _place(row: Row) -> tuple[str, str]:
    """Line and column of a case in its table."""
    stiff = f"{row['contact_n_m']:.0e} N/m".replace("e+0", "e")
    return {
        "drives": (f"{row['bandwidth_hz']:g} Hz", f"{row['fidelity']}, {stiff}"),
        "pose": (row["what"].removesuffix(" scan"), "scan" if row["speed_mm_s"] else "press"),
        "radii": (f"probe {row['probe_mm']:g} mm", f"object {row['radius_mm']:g} mm"),
        "speed": (f"{row['speed_mm_s']:g} mm/s", stiff),
    }[row["view"]]  # fmt: skip
