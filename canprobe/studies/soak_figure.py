"""The picture of study `soak`: memory, answer latency and overruns over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from matplotlib.figure import Figure

if TYPE_CHECKING:
    from canprobe.studies.soak import Sample

INK, FAINT = "#1f2933", "#d9dee4"
MASTER, NODES = "#0f6e84", "#b7791f"


def draw_soak(samples: Sequence[Sample], path: Path) -> None:
    """Three panels over the same time axis."""
    figure = Figure(figsize=(9.0, 7.0), dpi=110, layout="constrained")
    figure.suptitle(f"The cell held for {samples[-1].t_s:.0f} s on vcan0", x=0.01, ha="left", fontsize=12, color=INK)
    memory, latency, lost = figure.subplots(3, 1, sharex=True)
    minutes = [s.t_s / 60 for s in samples]
    memory.plot(minutes, [s.master_mib for s in samples], color=MASTER, label="master")
    memory.plot(minutes, [s.nodes_mib for s in samples], color=NODES, label="emulated nodes")
    memory.set_ylim(bottom=0)
    memory.set_ylabel("resident memory (MiB)")
    memory.legend(frameon=False, fontsize=9)
    latency.plot(minutes, [s.latency_us for s in samples], ".-", color=MASTER)
    latency.set_ylim(bottom=0)
    latency.set_ylabel("SYNC → last TPDO (µs)")
    lost.plot(minutes, [s.overruns for s in samples], color=MASTER, label="overruns")
    lost.plot(minutes, [s.missed_pdos for s in samples], color=NODES, label="PDOs missed")
    lost.set_ylim(bottom=0)
    lost.set_ylabel("so far")
    lost.set_xlabel("time (min)")
    lost.legend(frameon=False, fontsize=9)
    for axes in (memory, latency, lost):
        axes.grid(color=FAINT, linewidth=0.5)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    figure.savefig(path)
