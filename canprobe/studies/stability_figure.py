"""The picture of study `stability`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from canprobe.studies.stability import approach_limit
from canprobe.studies.stability_loop import Array, ForceLoop, spectral_radius
from canprobe.studies.stability_runs import Case, loop_of

INK, FAINT = "#1f2933", "#d9dee4"
ENDS = {
    "stable": ("#0f6e84", "o", "stable within limits"),
    "stopped": ("#ca8a04", "s", "stopped safely"),
    "refused": ("#64748b", "X", "refused by the plan"),
    "hunting": ("#6d28d9", "D", "carried out, force not settled"),
    "failed": ("#c2410c", "v", "failed"),
}
"""How a touch ended: colour, marker, words."""
VIEWS = {"told": "believes the stiffness it was told", "felt": "feels the stiffness"}
SIDES = {"drives": "drives, 1e4 and 1e6 N/m", "pose": "pose", "radii": "radii", "speed": "1e4, 4e4 N/m"}


def draw_stability(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """The map: a row of panels a servo, a column a bus; below, how the other cases end."""
    buses = list(dict.fromkeys((r["rate_hz"], r["late_ms"]) for r in rows if r["view"] in VIEWS))
    figure = Figure(figsize=(max(3.6 * len(buses), 11.0), 12.5), dpi=110, layout="constrained")
    figure.suptitle(
        "Force loop: largest eigenvalue over one period of the sensor (shade; black line: 1, unstable above), and how "
        "touches in lockstep end (marks)\n"
        "dotted: the approach at 4 mm/s is over the force limit before the touch's first sample can stop it",
        x=0.01, ha="left", fontsize=11, color=INK,
    )  # fmt: skip
    upper, lower = figure.subfigures(2, 1, squeeze=False, height_ratios=(3, 2))[:, 0]
    grid = upper.subplots(len(VIEWS), len(buses), squeeze=False, sharex=True, sharey=True)
    stiffness = np.geomspace(70.0, 1.5e7, 40)
    for i, (view, words) in enumerate(VIEWS.items()):
        ratios = [loop_of(Case(view, float(k), feels=view == "felt")).depth_ratio for k in stiffness]
        for axes, (rate, late) in zip(grid[i], buses, strict=True):
            mine = [r for r in rows if r["view"] == view and (r["rate_hz"], r["late_ms"]) == (rate, late)]
            _draw_map(axes, stiffness, ratios, loop_of(Case(view, 1e4, rate_hz=rate, late_ms=late)), mine)
            if i == 0:
                axes.set_title(f"{rate:g} Hz" + (f", {late:g} ms late" if late else ""), loc="left", fontsize=10)
        grid[i][0].set_ylabel(f"{words}\nforce gain, Hz")
    for axes in grid[-1]:
        axes.set_xlabel("contact stiffness, N/m")
    panels = lower.subplots(1, len(SIDES), squeeze=False)[0]
    for axes, (view, words) in zip(panels, SIDES.items(), strict=True):
        _draw_side(axes, words, [r for r in rows if r["view"] == view])
    marks = [Line2D([], [], color=c, marker=m, linestyle="", label=words) for c, m, words in ENDS.values()]
    figure.legend(handles=marks, loc="outside lower center", ncols=len(marks), frameon=False, fontsize=9)
    figure.savefig(path)


def _draw_map(
    axes: Axes, stiffness: Array, ratios: Sequence[float], bus: ForceLoop, rows: Sequence[dict[str, Any]]
) -> None:
    """One panel of the map."""
    gains = np.geomspace(1.5, 70.0, 20)
    radius = [
        [spectral_radius(replace(bus, depth_ratio=ratio, height_hz=float(gain))) for ratio in ratios] for gain in gains
    ]
    axes.contourf(stiffness, gains, radius, levels=np.linspace(0.0, 2.0, 11), cmap="Greys", alpha=0.35, extend="both")
    axes.contour(stiffness, gains, radius, levels=[1.0], colors=INK, linewidths=1.6)
    if rows:
        axes.axvline(approach_limit(rows[0]), color=INK, linestyle=":", linewidth=1.2)
    for end, (colour, marker, _) in ENDS.items():
        mine = [r for r in rows if r["ended"] == end]
        axes.plot(
            [r["contact_n_m"] for r in mine], [r["height_hz"] for r in mine], marker, color=colour, markersize=6,
            markeredgecolor="white", markeredgewidth=0.6, linestyle="",
        )  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_yticks([2.0, 8.0, 25.0, 50.0], ["2", "8", "25", "50"])
    axes.minorticks_off()


def _draw_side(axes: Axes, words: str, rows: Sequence[dict[str, Any]]) -> None:
    """How the cases of one line end: a row of words each, a mark a case."""
    names = list(dict.fromkeys(r["what"] for r in rows))
    for i, name in enumerate(names):
        for j, row in enumerate(r for r in rows if r["what"] == name):
            colour, marker, _ = ENDS[row["ended"]]
            axes.plot([j], [i], marker, color=colour, markersize=6, linestyle="")
    axes.set_yticks(range(len(names)), names, fontsize=7)
    axes.set_xticks([])
    axes.set_xlim(-1.0, 4.0)
    axes.set_ylim(max(len(names), 1) - 0.5, -0.5)
    axes.set_title(words, loc="left", fontsize=10)
    for side in ("top", "right", "bottom"):
        axes.spines[side].set_visible(False)
