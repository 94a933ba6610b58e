"""The picture of study `realtime`: histograms of the cycle, and the rates that were held."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import SubFigure

from canprobe.studies.figure import BLUE, GREY, INK, ORANGE, SKY, legend, log_scale, parts, picture

if TYPE_CHECKING:
    from canprobe.studies.cycle_times import Times
    from canprobe.studies.realtime_cases import Measured

LINES = ((BLUE, "-"), (ORANGE, "--"), (SKY, ":"))


def draw_realtime(measured: Sequence[Measured], path: Path) -> None:
    """Lateness of SYNC, computing time, answer latency, and held over asked rate."""
    scan, plain, bare = measured[:3]
    rate, seconds = f"{scan.rate_hz:g} Hz", f"{scan.times.seconds:.0f} s"
    title = f"{rate} on a real SocketCAN interface, {seconds}, emulated nodes beside it; from a microsecond up"
    with picture(path, title, 6.6) as figure:
        panels = parts(figure, 2, 2)
        late = {"canprobe": scan, "plain canopen": plain, "a loop that does nothing": bare}
        _histogram(panels[0], "lateness of SYNC (µs)", {name: m.times.lateness_ns for name, m in late.items()})
        done = {"RPDOs out": scan.times.response_ns, "work behind them done": scan.times.compute_ns}
        axes = _histogram(panels[1], "from the last TPDO, whole controller (µs)", done)
        axes.axvline(scan.times.period_ns * 0.3e-3, color=INK, linewidth=0.9, label="30 % of the period")
        _histogram(panels[2], "SYNC → last TPDO (µs)", {"canprobe": scan.times.latency_ns})
        _rates(panels[3].subplots(), measured)
        for part in panels:
            legend(part)


def _histogram(part: SubFigure, what: str, series: dict[str, Times]) -> Axes:
    axes: Axes = part.subplots()
    values = {name: np.maximum(v, 1000) / 1e3 for name, v in series.items() if len(v)}
    if values:
        every = np.concatenate(list(values.values()))
        bins = np.geomspace(max(1.0, float(every.min())), float(every.max()) * 1.01, 60).tolist()
        for (name, v), (colour, line) in zip(values.items(), LINES, strict=False):
            share = np.full(len(v), 100 / len(v))
            axes.hist(v, bins, weights=share, histtype="step", color=colour, linestyle=line, linewidth=1.3, label=name)
        axes.set_ylim(5e-3, 100)
        log_scale(axes, "xy")
    axes.set(xlabel=what, ylabel="share of cycles (%)")
    return axes


def _rates(axes: Axes, measured: Sequence[Measured]) -> None:
    holds = [m for m in measured if m.case == "hold"]
    for mode, (colour, line) in zip(dict.fromkeys(m.sensor for m in holds), LINES, strict=False):
        mine = [m for m in holds if m.sensor == mode]
        axes.plot(
            [m.rate_hz for m in mine], [m.times.rate_hz for m in mine], "o", linestyle=line, color=colour, label=mode
        )
    top = max((m.rate_hz for m in holds), default=1.0)
    axes.plot([0, top], [0, top], color=GREY, linewidth=0.8, zorder=0, label="as asked")
    axes.axvline(639, color=GREY, linestyle="-.", zorder=0, label="end of 1 Mbit/s, six drives")
    axes.set(xlabel="rate asked, joints held (Hz)", ylabel="cycles a second")
