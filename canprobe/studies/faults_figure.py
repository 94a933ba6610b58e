"""The picture of the fault campaign: what came of each kind of fault, and the true force over all runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from canprobe.emulator.faults import FaultKind
from canprobe.studies.fault_scenes import FORCE_MAX_N

COLOURS = {
    "completed": "#4c9f70",
    "stopped for safety": "#e0a030",
    "bus or node failure": "#4a7ebb",
    "bring-up refused": "#9a9a9a",
}


def draw_faults(runs: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw to ``path``."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    kinds = [kind.value for kind in FaultKind]
    of_kind = {kind: [one for one in runs if kind in one["kinds"]] for kind in kinds}
    start = [0.0] * len(kinds)
    for outcome, colour in COLOURS.items():
        shares = [
            sum(one["outcome"] == outcome for one in some) / len(some) if (some := of_kind[k]) else 0.0 for k in kinds
        ]
        left.barh(kinds, shares, left=start, color=colour, label=outcome)
        start = [a + b for a, b in zip(start, shares, strict=True)]
    left.invert_yaxis()
    left.set(xlabel="share of the runs with this fault", xlim=(0, 1))
    left.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False)
    forces = [one["force_max_n"] for one in runs if one["force_bound_n"] is not None]
    right.hist(forces, bins=60, color="#4a7ebb")
    right.axvline(FORCE_MAX_N, color="#c03030", label=f"limit {FORCE_MAX_N:g} N")
    right.set(xlabel="highest true force of a run that presses, N", ylabel="runs", yscale="log")
    failed = sum(bool(one["failures"]) for one in runs)
    right.set_title(f"{len(runs)} runs, {failed} failed")
    right.legend(frameon=False)
    figure.savefig(path, dpi=110)


def draw_ends(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw how long the master took to end, by what happened to it, to ``path``."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3), layout="constrained")
    axes = figure.subplots()
    kinds = list(dict.fromkeys(row["fault"] for row in rows))
    for colour, label, some in (
        ("#4a7ebb", "as it should be", [row for row in rows if not row["failures"]]),
        ("#c03030", "failed", [row for row in rows if row["failures"]]),
    ):
        axes.plot(
            [row["ended_s"] for row in some],
            [kinds.index(row["fault"]) for row in some],
            "o",
            color=colour,
            label=label,
        )
    axes.set(
        yticks=range(len(kinds)), yticklabels=kinds, xlabel="from the fault to the end of the master, s", xlim=(0, None)
    )
    axes.set_ylim(len(kinds) - 0.5, -0.5)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=110)
