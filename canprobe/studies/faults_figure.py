"""The picture of the fault campaign: what came of each kind of fault, and the true force over all runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator

from canprobe.emulator.faults import FaultKind
from canprobe.studies.fault_scenes import FORCE_MAX_N
from canprobe.studies.figure import AMBER, BLUE, GREEN, GREY, ORANGE, legend, log_scale, parts, picture

COLOURS = {
    "completed": (GREEN, ""),
    "stopped for safety": (AMBER, "//"),
    "bus or node failure": (BLUE, "\\\\"),
    "bring-up refused": (GREY, "xx"),
}
"""Colour and hatch."""
BIN_N, FEW = 0.05, 20


def draw_faults(runs: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw to ``path``."""
    failed = sum(bool(one["failures"]) for one in runs)
    title = f"{len(runs)} runs with random faults of nodes and links, {failed} failed; in brackets: runs with the fault"
    of_kind = {kind.value: [one["outcome"] for one in runs if kind.value in one["kinds"]] for kind in FaultKind}
    found = {f"{kind} ({len(ends)})": ends for kind, ends in of_kind.items() if ends}
    forces = [one["force_max_n"] for one in runs if one["force_bound_n"] is not None]
    with picture(path, title, 4.6) as figure:
        sides = parts(figure, 1, 2)
        left, right = (part.subplots() for part in sides)
        start = np.zeros(len(found))
        for outcome, (colour, hatch) in COLOURS.items():
            shares = np.array([ends.count(outcome) / len(ends) for ends in found.values()])
            if shares.any():
                left.barh(list(found), shares, left=start, color=colour, hatch=hatch, edgecolor="white", label=outcome)
            start += shares
        left.invert_yaxis()
        left.grid(visible=False, axis="y")
        left.set(xlabel="share of the runs with this fault", xlim=(0, 1))
        if forces:
            low, high = BIN_N * np.floor(min(forces) / BIN_N), max(*forces, FORCE_MAX_N) + BIN_N
            counts, *_ = right.hist(forces, np.arange(low, high + BIN_N, BIN_N).tolist(), color=BLUE)
            if np.max(counts) > FEW:
                log_scale(right, "y")
                right.set_ylim(bottom=0.8)
            else:
                right.yaxis.set_major_locator(MaxNLocator(integer=True))
        right.axvline(FORCE_MAX_N, color=ORANGE, label=f"limit {FORCE_MAX_N:g} N")
        right.set(xlabel="highest true force of a run that presses (N)", ylabel="runs")
        for part in sides:
            legend(part)


def draw_ends(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw how long the master took to end, by what happened to it, to ``path``."""
    kinds = list(dict.fromkeys(row["fault"] for row in rows))
    with picture(path, "How long the master took to end, by what happened on vcan0", 1.6 + 0.25 * len(kinds)) as figure:
        axes = figure.subplots()
        for colour, mark, label, failed in ((BLUE, "o", "as it should be", False), (ORANGE, "X", "failed", True)):
            some = [row for row in rows if bool(row["failures"]) == failed]
            places = [kinds.index(row["fault"]) for row in some]
            axes.plot([row["ended_s"] for row in some], places, mark, color=colour, label=label)
        axes.set_yticks(range(len(kinds)), kinds)
        axes.set(xlabel="from the fault to the end of the master (s)", xlim=(0, None), ylim=(len(kinds) - 0.5, -0.5))
        legend(figure)
