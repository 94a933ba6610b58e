"""Figures that many studies have: one quantity of the rows over another, or over names, marked by a third."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from canprobe.cell.results.picture import AMBER, BLUE, GREEN, INK, ORANGE, PINK, SKY, legend, log_scale, picture
from canprobe.lab.studies.result import Row, shown

MARKS = tuple(zip((BLUE, ORANGE, SKY, AMBER, GREEN, PINK), "o^sDvX", strict=True))
LEAST = 0.01
"""Smaller values are drawn here on a logarithmic scale."""


def draw_points(
    rows: Sequence[Row],
    x: tuple[str, str],
    y: tuple[str, str],
    path: Path,
    *,
    title: str,
    by: str = "",
    log: bool = False,
    lines: Sequence[tuple[float, str]] = (),
) -> None:
    """Draw a mark for each row.

    Args:
        rows: rows of a table.
        x, y: keys of two columns, each with the axis's label.
        path: path of the picture.
        title: name of the content.
        by: key whose values have a colour and a mark each; empty: all rows are alike.
        log: whether both axes are logarithmic.
        lines: slopes of lines through the origin, each with its label.
    """
    with picture(path, title, 3.8) as figure:
        axes = figure.subplots()
        kinds = list(dict.fromkeys(row[by] for row in rows)) if by else [None]
        for kind, (colour, mark) in zip(kinds, MARKS, strict=False):
            mine = [row for row in rows if not by or row[by] == kind]
            columns = [[max(row[key], LEAST) if log else row[key] for row in mine] for key, _ in (x, y)]
            axes.plot(*columns, mark, color=colour, markersize=4.5, label=str(kind) if by else None)
        for (slope, label), style in zip(lines, "-:", strict=False):
            most = max((row[key] for row in rows for key, _ in (x, y)), default=1.0)
            along = [LEAST if log else 0.0, most / max(slope, 1.0)]
            axes.plot(along, [slope * value for value in along], style, color=INK, linewidth=0.8, label=label)
        if log:
            log_scale(axes, "xy")
        axes.set(xlabel=x[1], ylabel=y[1])
        legend(figure)


FORCE_AXIS = ("force_max_n", "highest true force (N)")


def draw_by_name(
    rows: Sequence[Row], name: str, x: tuple[str, str], path: Path, *, title: str, by: str, log: bool = True
) -> None:
    """Draw a mark for each row, in the line of its name.

    Args:
        rows: rows of a table.
        name: key whose values have a line each.
        x: key of a column, with the axis's label.
        path: path of the picture.
        title: name of the content.
        by: key whose values have a colour and a mark each.
        log: whether the axis is logarithmic.
    """
    names, sorts = (list(dict.fromkeys(row[key] for row in rows)) for key in (name, by))
    with picture(path, title, 1.8 + 0.25 * len(names)) as figure:
        axes = figure.subplots()
        for sort, (colour, mark) in zip(sorts, MARKS, strict=False):
            some = [row for row in rows if row[by] == sort]
            values = [max(row[x[0]], LEAST) if log else row[x[0]] for row in some]
            places = [names.index(row[name]) for row in some]
            axes.plot(values, places, mark, color=colour, markersize=4.5, label=f"{by}: {shown(sort)}")
        if log:
            log_scale(axes, "x")
        axes.set_yticks(range(len(names)), names)
        axes.set(xlabel=x[1], ylim=(len(names) - 0.5, -0.5))
        legend(figure)
