"""The picture of study `pipeline`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

INK, FAINT = "#1f2933", "#d9dee4"
COLOURS = {"calibration": "#8a94a0", "verification": "#0f6e84"}


def draw_pipeline(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Coverage, and z of each entry, by scene."""
    scenes = list(dict.fromkeys(r["scene"] for r in rows))
    groups = list(dict.fromkeys(r["seeds"] for r in rows))
    figure = Figure(figsize=(11.0, 4.2), dpi=110, layout="constrained")
    figure.suptitle(
        "The online estimator with the whole sensor pipeline on: share of its 95 % regions that hold the truth,\n"
        "and errors of K11, K12, K22 over their stated standard deviation (RMS, left to right)",
        x=0.01, ha="left", fontsize=11, color=INK,
    )  # fmt: skip
    left, right = figure.subplots(1, 2)
    left.axhspan(0.90, 0.99, color=FAINT, alpha=0.6, linewidth=0, zorder=0)
    left.axhline(0.95, color=INK, linewidth=0.8)
    right.axhline(1.0, color=INK, linewidth=0.8)
    for j, group in enumerate(groups):
        mine = [r for r in rows if r["seeds"] == group]
        x = np.array([scenes.index(r["scene"]) for r in mine]) + 0.3 * (j - 0.5 * (len(groups) - 1))
        left.scatter(x, [r["coverage"] for r in mine], s=30, color=COLOURS[group], label=f"{group} seeds", zorder=3)
        for i, entry in enumerate(("K11", "K12", "K22")):
            y = [r[f"z_rms_{entry}"] for r in mine]
            right.scatter(x + 0.07 * (i - 1), y, s=18, marker="osD"[i], color=COLOURS[group], zorder=3)
    left.set_ylim(min(0.8, *(r["coverage"] - 0.02 for r in rows)), 1.01)
    right.set_yscale("log")
    right.yaxis.set_major_formatter("{x:g}")
    left.set_title("coverage", loc="left", fontsize=10)
    right.set_title("error over stated σ", loc="left", fontsize=10)
    for axes in (left, right):
        axes.set_xticks(range(len(scenes)), scenes, rotation=30, ha="right", rotation_mode="anchor")
        axes.set_xlim(-0.6, len(scenes) - 0.4)
        axes.grid(color=FAINT, linewidth=0.6, axis="y")
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    left.legend(frameon=False, fontsize=9, loc="lower left")
    figure.savefig(path)
