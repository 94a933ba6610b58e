"""The picture of study `soak`: memory, answer latency and overruns over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from canprobe.studies.figure import BLUE, ORANGE, legend, parts, picture

if TYPE_CHECKING:
    from canprobe.studies.soak import Sample


def draw_soak(samples: Sequence[Sample], path: Path) -> None:
    """Three panels over the same time axis."""
    with picture(path, f"The cell held for {samples[-1].t_s:.0f} s on vcan0", 6.6) as figure:
        panels = parts(figure, 3, 1)
        memory, latency, lost = (part.subplots() for part in panels)
        minutes = [s.t_s / 60 for s in samples]
        memory.plot(minutes, [s.master_mib for s in samples], color=BLUE, label="master")
        memory.plot(minutes, [s.nodes_mib for s in samples], "--", color=ORANGE, label="emulated nodes")
        memory.set_ylabel("resident\nmemory (MiB)")
        latency.plot(minutes, [s.latency_us for s in samples], ".-", color=BLUE)
        latency.set_ylabel("SYNC →\nlast TPDO (µs)")
        lost.plot(minutes, [s.overruns for s in samples], color=BLUE, label="overruns")
        lost.plot(minutes, [s.missed_pdos for s in samples], "--", color=ORANGE, label="PDOs missed")
        lost.set_ylabel("number so far")
        for axes, part in zip((memory, latency, lost), panels, strict=True):
            axes.set_ylim(bottom=-0.04 * axes.get_ylim()[1])
            axes.set_xlabel("time (min)")
            legend(part)
