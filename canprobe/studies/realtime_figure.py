"""The picture of study `realtime`: histograms of the cycle, and the rates that were held."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

if TYPE_CHECKING:
    from canprobe.studies.cycle_times import Times
    from canprobe.studies.realtime_cases import Measured

INK, FAINT = "#1f2933", "#d9dee4"
OURS, PLAIN, THIRD = "#0f6e84", "#b7791f", "#c2410c"
CROWDED = 500.0
"""Width of an axis from which its labels would run into each other at 1, 2 and 5."""


def draw_realtime(measured: Sequence[Measured], path: Path) -> None:
    """Lateness of SYNC, computing time, answer latency, and held over asked rate."""
    figure = Figure(figsize=(11.5, 7.4), dpi=110, layout="constrained")
    scan, plain, bare = measured[:3]
    figure.suptitle(
        f"{scan.rate_hz:g} Hz on a real SocketCAN interface, {scan.times.seconds:.0f} s, emulated nodes beside it",
        x=0.01, ha="left", fontsize=12, color=INK,
    )  # fmt: skip
    grid = figure.subplots(2, 2)
    _histogram(
        grid[0][0],
        "lateness of SYNC (µs)",
        {
            "canprobe": scan.times.lateness_ns,
            "plain canopen": plain.times.lateness_ns,
            "a loop that does nothing": bare.times.lateness_ns,
        },
    )
    _histogram(
        grid[0][1],
        "from the last TPDO, whole controller (µs)",
        {"until the RPDOs are out": scan.times.response_ns, "with the work behind them": scan.times.compute_ns},
    )
    grid[0][1].axvline(
        scan.times.period_ns * 0.3e-3, color=INK, linewidth=1.0, linestyle=":", label="30 % of the period"
    )
    grid[0][1].legend(frameon=False, fontsize=9)
    _histogram(grid[1][0], "SYNC → last TPDO (µs)", {"canprobe": scan.times.latency_ns})
    _rates(grid[1][1], measured)
    figure.savefig(path)


def _histogram(axes: Axes, what: str, series: dict[str, Times]) -> None:
    values = {name: np.maximum(v, 1000) / 1e3 for name, v in series.items() if len(v)}
    if values:
        every = np.concatenate(list(values.values()))
        bins = np.geomspace(max(1.0, float(every.min())), float(every.max()) * 1.01, 60).tolist()
        for (name, v), colour in zip(values.items(), (OURS, PLAIN, THIRD), strict=False):
            axes.hist(v, bins=bins, weights=np.full(len(v), 100 / len(v)), color=colour, alpha=0.6, label=name)
        axes.set_xscale("log")
        wide = bins[-1] > CROWDED * bins[0]
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0,) if wide else (1.0, 2.0, 5.0)))
        axes.xaxis.set_major_formatter(ScalarFormatter())
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_yscale("log")
        axes.set_ylim(5e-3, 100)
        axes.legend(frameon=False, fontsize=9)
    axes.set_xlabel(what)
    axes.set_ylabel("share of cycles (%)")
    _plain(axes)


def _rates(axes: Axes, measured: Sequence[Measured]) -> None:
    holds = [m for m in measured if m.case == "hold"]
    for mode, colour in zip(dict.fromkeys(m.sensor for m in holds), (OURS, PLAIN, THIRD), strict=False):
        mine = [m for m in holds if m.sensor == mode]
        axes.plot([m.rate_hz for m in mine], [m.times.rate_hz for m in mine], "o-", color=colour, label=mode)
    top = max((m.rate_hz for m in holds), default=1.0)
    axes.plot([0, top], [0, top], color=FAINT, zorder=0)
    axes.axvline(639, color=FAINT, linestyle=":", zorder=0)
    axes.annotate("1 Mbit/s ends", (639, 0), fontsize=8, color=INK, rotation=90, va="bottom", ha="right")
    axes.set_xlabel("rate asked (Hz), joints held")
    axes.set_ylabel("cycles a second")
    axes.legend(frameon=False, fontsize=9)
    _plain(axes)


def _plain(axes: Axes) -> None:
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.grid(color=FAINT, linewidth=0.5)
    axes.set_axisbelow(True)
