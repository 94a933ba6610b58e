"""The picture of study `pipeline`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.studies.figure import BLUE, GREY, INK, SHADE, legend, log_scale, picture

COLOURS = {"calibration": GREY, "verification": BLUE}
ENTRIES = {"K11": "o", "K12": "s", "K22": "D"}


def draw_pipeline(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Coverage, and z of each entry, by scene."""
    scenes = list(dict.fromkeys(r["scene"] for r in rows))
    groups = list(dict.fromkeys(r["seeds"] for r in rows))
    title = (
        "The online estimator with the whole sensor pipeline on: share of its 95 % regions that hold the truth,\n"
        "and errors of the entries of K over their stated standard deviation (RMS); shade: as it should be"
    )
    with picture(path, title, 4.4) as figure:
        left, right = figure.subplots(1, 2)
        left.axhspan(0.90, 0.99, color=SHADE, linewidth=0, zorder=0)
        left.axhline(0.95, color=INK, linewidth=0.8)
        right.axhline(1.0, color=INK, linewidth=0.8)
        for j, group in enumerate(groups):
            mine = [r for r in rows if r["seeds"] == group]
            x = np.array([scenes.index(r["scene"]) for r in mine]) + 0.3 * (j - 0.5 * (len(groups) - 1))
            name = f"{group} seeds"
            left.scatter(x, [r["coverage"] for r in mine], s=30, color=COLOURS[group], label=name, zorder=3)
            for i, (entry, mark) in enumerate(ENTRIES.items()):
                y = [r[f"z_rms_{entry}"] for r in mine]
                label = f"{entry}, {name}"
                right.scatter(x + 0.07 * (i - 1), y, s=18, marker=mark, color=COLOURS[group], label=label, zorder=3)
        left.set_ylim(min(0.88, *(r["coverage"] - 0.02 for r in rows)), 1.01)
        log_scale(right, "y")
        left.set(title="coverage", ylabel="share of regions")
        right.set(title="error over stated σ", ylabel="RMS of z")
        for axes in (left, right):
            axes.set_xticks(range(len(scenes)), scenes, rotation=30, ha="right", rotation_mode="anchor")
            axes.set_xlim(-0.6, len(scenes) - 0.4)
            axes.grid(visible=False, axis="x")
        legend(figure)
