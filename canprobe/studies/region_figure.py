"""The picture of study `region`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from canprobe.studies.bound import AT
from canprobe.studies.bound_cases import REGION
from canprobe.studies.figure import INK, METHODS, SHADE, legend, log_scale, picture

NAMES = {
    "path": "path / radius",
    "bound": "bound / size of K",
    "κσ": "κσₚ (rad)",
    "cubic": "cubic terms / bound",
    "spread": "noise / spread",
}
CLIP = 3.0


def draw_region(measured: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Error over bound and coverage of every case against each limit: a column of panels a limit."""
    title = (
        "How far out the Cramér–Rao bound means something: each case against each limit; line: the limit chosen\n"
        f"shade: as it should be; an error above {CLIP:g} bounds: at the edge"
    )
    with picture(path, title, 5.2) as figure:
        grid = figure.subplots(2, len(NAMES), sharey="row", sharex="col")
        for column, (limit, name) in zip(grid.T, NAMES.items(), strict=True):
            shown = ((column[0], "ratio", (0.0, 1.25), CLIP), (column[1], "coverage", (0.90, 1.0), 1.0))
            for axes, key, band, top in shown:
                axes.axhspan(*band, color=SHADE, linewidth=0, zorder=0)
                axes.axvline(REGION[limit], color=INK, linewidth=0.9)
                for method, marker in (("ml", "o"), ("recursive", "x")):
                    mine = [r for r in measured if r["method"] == method and r[key] is not None]
                    axes.scatter(
                        [max(r[AT + limit], 1e-4) for r in mine], [min(r[key], top) for r in mine],
                        s=16, marker=marker, color=METHODS[method], alpha=0.7, linewidths=1.0, label=method, zorder=3,
                    )  # fmt: skip
                log_scale(axes, "x")
            column[1].set_xlabel(name)
        grid[0][0].set_ylabel("error / bound")
        grid[1][0].set_ylabel("coverage of 95 % regions")
        legend(figure)
