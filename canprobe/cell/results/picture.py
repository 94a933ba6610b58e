"""Common style of all pictures: size, type, colours, ticks, place of legends, and the way to save.

A picture is as wide as a page: in a column of 800 pixels, as in the README, its smallest type is 9 pixels high. Its
title names its content and explains marks and shades. A legend stands below its panels, never among the data.
The colours are those of Okabe and Ito, which people with any colour vision distinguish; a mark, a line style or a place
distinguishes them as well.
"""

from __future__ import annotations

import io
import math
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MaxNLocator, NullLocator

from canprobe.fieldbus.bus.files import whole_file

Part = Figure | SubFigure
WIDTH_IN, DPI = 9.0, 150
INK, GREY, FAINT, SHADE = "#1f2933", "#8a94a0", "#d9dee4", "#eceff2"
BLUE, ORANGE, GREEN, PINK, AMBER, SKY = "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"
METHOD_COLOURS = MappingProxyType({"chen1996": GREY, "chord": AMBER, "ml": BLUE, "recursive": ORANGE})
"""Colours of the estimators."""
_STYLE: Any = MappingProxyType(
    {
        "font.size": 9.0, "axes.titlesize": 9.0, "figure.titlesize": 10.0, "legend.fontsize": 8.5,
        "xtick.labelsize": 8.5, "ytick.labelsize": 8.5, "lines.linewidth": 1.1, "legend.frameon": False,
        "axes.grid": True, "grid.color": FAINT, "grid.linewidth": 0.6, "axes.axisbelow": True,
        "axes.spines.top": False, "axes.spines.right": False, "axes.edgecolor": INK, "axes.labelcolor": INK,
        "axes.titlelocation": "left", "axes.titlecolor": INK, "text.color": INK, "xtick.color": INK, "ytick.color": INK,
    }
)  # fmt: skip
_LETTER_IN = 0.062
"""Mean width of a letter of a legend, inches."""
MIN_DEPTH_MM = 6.0
"""Least height of a box, mm, for planes."""
ROWS_DRAWN = 40_000
"""Most points of a curve: 100 s of a cell at 400 Hz."""


def drawn_rows(count: int) -> slice:
    """Rows that a picture shows of a number of rows: all, or every k-th of a long run."""
    return slice(None, None, -(-count // ROWS_DRAWN) or 1)


class Sheet(Figure):
    """A figure that a notebook shows, also where `matplotlib.pyplot` was never imported."""

    def _repr_png_(self) -> bytes:
        drawn = io.BytesIO()
        self.savefig(drawn, format="png")
        return drawn.getvalue()


@contextmanager
def sheet(title: str, height_in: float) -> Iterator[Figure]:
    """A sheet to draw on within the block; for its arguments see `picture`."""
    with rc_context(dict(_STYLE)):
        figure = Sheet(figsize=(WIDTH_IN, height_in), dpi=DPI, layout="constrained")
        lines = [part for line in title.splitlines() for part in textwrap.wrap(line, 118)]
        figure.suptitle("\n".join(lines), x=0.01, ha="left", parse_math=False)
        yield figure


@contextmanager
def picture(path: Path | str, title: str, height_in: float) -> Iterator[Figure]:
    """A sheet that is written when the block ends.

    Args:
        path: path of the picture; its suffix names the format.
        title: name of the content; more lines explain it.
        height_in: height of the sheet, inches.

    Raises:
        ValueError: when matplotlib does not know the format.
    """
    path = Path(path)
    with sheet(title, height_in) as figure:
        yield figure
        with whole_file(path) as part:
            if (form := path.suffix[1:] or "png") == "png":
                canvas: Any = FigureCanvasAgg(figure)
                canvas.print_png(part)  # `savefig` draws everything twice
            else:
                figure.savefig(part, format=form)


def parts(of: Part, rows: int, columns: int, **ratios: Any) -> list[SubFigure]:
    """Parts of a sheet, row by row, each with its legend."""
    return list(np.asarray(of.subfigures(rows, columns, squeeze=False, **ratios)).flat)


def legend(part: Part, handles: Sequence[Any] = ()) -> None:
    """Draw a legend below the panels of a sheet or a part of one: each of their labels once, or `handles`."""
    panels: list[Axes] = part.axes
    pairs = [pair for axes in panels for pair in zip(*axes.get_legend_handles_labels(), strict=True)]
    shown = {handle.get_label(): handle for handle in handles} or {label: handle for handle, label in pairs}
    widths = [_LETTER_IN * len(label) + 0.6 for label in shown]
    for rows in range(1, len(shown) + 1):  # it is filled column by column
        columns = range(0, len(shown), rows)
        if rows == len(shown) or sum(max(widths[i : i + rows]) for i in columns) < part.bbox.width / DPI:
            part.legend(shown.values(), shown.keys(), loc="outside lower center", ncols=len(columns))
            break


def log_scale(axes: Axes, names: str) -> None:
    """Make `x`, `y` or `xy` logarithmic, with as many plain numbers as there is room for."""
    for name in names:
        getattr(axes, f"set_{name}scale")("log")
        axis = getattr(axes, f"{name}axis")
        axis.set_major_locator(_LogTicks())
        axis.set_major_formatter(FuncFormatter(lambda value, _: _number(value)))
        axis.set_minor_locator(NullLocator())


class _LogTicks(LogLocator):
    """Logarithmic ticks: the more room there is, the more numbers a decade has."""

    def tick_values(self, vmin: float, vmax: float) -> Sequence[float]:
        axis: Any = self.axis
        room = axis.get_tick_space() / math.log10(vmax / vmin)
        few = (1.0, 2.0, 5.0) if room > 4 or vmax < 10 * vmin else (1.0,)  # else there could be none
        self.set_params(subs=(1.0, 2.0, 3.0, 5.0, 7.0) if room > 6 else few)
        return super().tick_values(vmin, vmax)


def _number(value: float) -> str:
    exponent = math.log10(value)
    if 1e-3 <= value < 1e5 or not math.isclose(exponent, round(exponent), abs_tol=1e-9):
        return f"{value:g}"
    return f"$10^{{{exponent:.0f}}}$"


def box(
    part: Part, axes: Any, title: str, labels: Sequence[str], *, elev: float, azim: float, beside_in: float = 1.2
) -> None:
    """Let axes in three dimensions fill their part: one scale for all, as many ticks as a side has room for.

    Labels, and what else stands in the part, take `beside_in` inches of its width.
    """
    low, high = axes.get_zlim()
    spare = max(0.0, MIN_DEPTH_MM - (high - low)) / 2
    axes.set_zlim(low - spare, high + spare)
    axes.set_aspect("equal")
    axes.view_init(elev=elev, azim=azim)
    axes.apply_aspect()
    sides = {axes.xaxis: axes.get_xlim(), axes.yaxis: axes.get_ylim(), axes.zaxis: axes.get_zlim()}
    corners = np.array(list(product(*sides.values(), (1.0,)))) @ axes.get_proj().T
    seen = np.ptp(axes.transData.transform(corners[:, :2] / corners[:, 3:]), axis=0) / axes.bbox.size
    title_in = 0.2 * len(title.splitlines()) + 0.1  # it takes its place later
    below = part.bbox.size - DPI * np.array([0.0, title_in])
    room = (below - DPI * np.array([beside_in, 0.5])) / min(below)  # beside the labels
    axes.set_box_aspect(axes.get_box_aspect(), zoom=float(min(room / seen)))
    longest = max(high - low for low, high in sides.values())
    for (axis, (low, high)), label in zip(sides.items(), labels, strict=True):
        axis.set_label_text(label)
        axis.labelpad = 5
        if axis is axes.zaxis:
            axis.set_rotate_label(False)  # seen from some sides it stood on its head
            axis.label.set_rotation("vertical")
        axis.set_tick_params(pad=0)
        count, inset = round(5 * (high - low) / longest), 0.25 * (high - low)
        two = count == 2 or part.bbox.height > 4.0 * DPI
        few = [round(low + inset), round(high - inset)] if two else [round(0.5 * (low + high))]
        axis.set_major_locator(
            MaxNLocator(count, steps=(1, 2, 5, 10), integer=True) if count > 2 else FixedLocator(few)
        )
        axis.pane.set_facecolor("white")
        axis.pane.set_edgecolor(FAINT)
    for artist in axes.get_children():
        artist.set_clip_on(False)
        artist.set_in_layout(False)
    part.suptitle(title, x=0.02, ha="left", fontsize="medium")
