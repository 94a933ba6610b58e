"""Part of study `surfaces`: the path that exploration, weaves, rasters and a circle need for the same errors.

After every 5 mm of path the map of the contacts so far is compared with the true surface, all over the rectangle.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.cell.results.picture import BLUE, GREEN, GREY, INK, ORANGE, PINK, SKY, legend, log_scale, picture
from canprobe.cell.tasks.shape import PATH_STEP_M
from canprobe.lab.studies.drawn_shapes import LENGTH_MM, WIDTH_MM, TrueGround
from canprobe.lab.studies.result import Row, drawn_anew, interval_of
from canprobe.lab.studies.surface_methods import evaluate_map
from canprobe.mechanics.touch import ContactSample, SurfaceMap
from canprobe.mechanics.touch.estimate.path_length import PathLength
from canprobe.mechanics.touch.strategies import Circle, Strategy, Weave
from canprobe.mechanics.types import Floats

SECONDS = 10.0
MARK_M, LONGEST_M = 5e-3, 0.25
"""Path between two comparisons, and the longest path, m."""
LIMITS = {"height": 20e-6, "normal": 3e-3, "curvature": 2.0}
"""Mean errors that are to be reached: height, m; normal, rad; curvature, 1/m."""
STRATEGIES = ("explore", "weave 12 mm", "weave 9 mm", "raster 10 mm", "raster 8 mm", "raster 6 mm", "circle")
COLOURS = dict(zip(STRATEGIES, (ORANGE, BLUE, SKY, INK, GREEN, PINK, GREY), strict=True))


class Lines:
    """A raster: from the middle to a corner, then lines along the heading that are joined by half circles; closed.

    Args:
        length, width: size of the rectangle, m.
        spacing: largest distance between two lines, m.
    """

    def __init__(self, length: float, width: float, spacing: float) -> None:
        lines = _serpentine(length, width, spacing) - 0.5 * np.array([length, width])
        self._places = np.concatenate([np.zeros((1, 2)), lines, np.zeros((1, 2))])
        self._ways = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self._places, axis=0), axis=1))])

    def point(self, phase: float) -> tuple[float, float]:
        """Place at a share of the path, whose phase is from 0 to 2π."""
        way = phase % (2.0 * math.pi) / (2.0 * math.pi) * self._ways[-1]
        x, y = (float(np.interp(way, self._ways, self._places[:, k])) for k in (0, 1))
        return x, y

    def tangent(self, phase: float) -> tuple[float, float]:
        """Derivative of the place by the phase."""
        step = 1e-4
        (ax, ay), (bx, by) = self.point(phase), self.point(phase + step)
        return (bx - ax) / step, (by - ay) / step


def _serpentine(length: float, width: float, spacing: float) -> Floats:
    """(n, 2) places of lines from a corner on that are joined by half circles, m."""
    count = math.ceil(width / spacing)
    gap = width / count
    found = []
    for k in range(count):
        begin, end, y = (0.5 * gap, length - 0.5 * gap, (k + 0.5) * gap)
        if k % 2:
            begin, end = end, begin
        found += [(begin, y), (end, y)]
        side = 1.0 if end > begin else -1.0
        if k + 1 < count:
            found += [
                (end + side * 0.5 * gap * math.cos(a), y + 0.5 * gap + 0.5 * gap * math.sin(a))
                for a in np.linspace(-math.pi / 2, math.pi / 2, 13)[1:-1]
            ]
    return np.array(found)


def fixed(name: str) -> Strategy:
    """A strategy that does not ask the map, by its name here."""
    length, width = 1e-3 * LENGTH_MM, 1e-3 * WIDTH_MM
    what, _, size = name.partition(" ")
    if what == "circle":
        return Circle(0.75 * width)
    apart = 1e-3 * float(size.split()[0])
    return Weave(length, width, apart) if what == "weave" else Lines(length, width, apart)


def errors_over_path(surface_map: SurfaceMap, samples: Sequence[ContactSample], truth: TrueGround) -> dict[str, Any]:
    """Mean errors after every `MARK_M` of the path of contacts, and the time at which each was walked."""
    travel = PathLength(PATH_STEP_M)
    path = np.array([travel.total for sample in samples if travel.add(sample.p_base) is not None])
    seconds = np.array([sample.t_s for sample in samples]) - samples[0].t_s
    names, rows, taken = ("path", "seconds", *LIMITS), list[Any](), 0
    for mark in np.arange(MARK_M, min(path[-1], LONGEST_M) + MARK_M, MARK_M):
        until = int(np.searchsorted(path, mark, side="right"))
        surface_map.add_samples(samples[taken:until])
        taken = until
        errors = truth.errors(evaluate_map(surface_map, truth.points))
        rows.append((path[until - 1], seconds[until - 1], *(error.mean() for error in errors)))
    return dict(zip(names, np.array(rows).reshape(-1, len(names)).T.tolist(), strict=True))


def path_to(scan: Mapping[str, Any], key: str, limit: float, over: str = "path") -> float | None:
    """Path (m), or another column, after which an error stays below a limit; None: never."""
    below = [error <= limit for error in scan[key]]
    first = len(below) - next((k for k, good in enumerate(reversed(below)) if not good), len(below))
    return scan[over][first] if first < len(below) else None


def paths_of(scans: Sequence[Mapping[str, Any]], key: str) -> Floats:
    """(n,) path to the limit of an error on each shape, m; the longest path where it was never reached."""
    return np.array([one if (one := path_to(scan, key, LIMITS[key])) is not None else LONGEST_M for scan in scans])


def row_of(name: str, scans: Sequence[Mapping[str, Any]]) -> Row:
    """Means of a strategy over the shapes."""
    reached = [path_to(scan, key, limit) is not None for scan in scans for key, limit in LIMITS.items()]
    times = [path_to(scan, "height", LIMITS["height"], "seconds") for scan in scans]
    return {
        "strategy": name,
        **{f"{key}_mm": 1e3 * float(paths_of(scans, key).mean()) for key in LIMITS},
        "reached": f"{sum(reached)} of {len(reached)}",
        "height_s": float(np.mean([SECONDS if t is None else t for t in times])),
        "force_percent": float(np.mean([scan["force_percent"] for scan in scans])),
        "contact": float(np.mean([scan["contact"] for scan in scans])),
        "stopped": sum(scan["stopped"] is not None for scan in scans),
    }


def findings(rows: Sequence[Row], each: Mapping[str, Sequence[Mapping[str, Any]]], shapes: Sequence[str]) -> list[str]:
    """Exploration against the best fixed strategy, error by error, with 95 % of the draws of shapes."""
    said = [
        f"Means over {len(shapes)} shapes in a rectangle of {LENGTH_MM:g} × {WIDTH_MM:g} mm; an error that is never"
        f" reached counts as {1e3 * LONGEST_M:g} mm."
    ]
    fixed_ones = [row["strategy"] for row in rows if row["strategy"] != "explore"]
    draws = drawn_anew(len(shapes))
    for key in LIMITS:
        best = min(fixed_ones, key=lambda name: float(paths_of(each[name], key).mean()))
        mine, theirs = paths_of(each["explore"], key), paths_of(each[best], key)
        ratio = mine.mean() / theirs.mean()
        low, high = interval_of(mine[draws].mean(axis=1) / theirs[draws].mean(axis=1))
        worse = [f"{s} {m / t:.2f}" for s, m, t in zip(shapes, mine, theirs, strict=True) if m > t]
        said.append(
            f"{key}: explore needs {ratio:.2f} ({low:.2f} to {high:.2f}) of the path of the best fixed strategy,"
            f" {best}; longer on {', '.join(worse) or 'no shape'}."
        )
    return said


def draw(each: Mapping[str, Sequence[Mapping[str, Any]]], path: Path) -> None:
    """Median errors over the path, a curve for each strategy."""
    title = "Errors all over the rectangle while the path grows: medians over the shapes, and the limits (dashed)"
    with picture(path, title, 3.8) as figure:
        panels = figure.subplots(1, 3)
        for axes, (key, limit) in zip(panels, LIMITS.items(), strict=True):
            scale, unit = {"height": (1e6, "µm"), "normal": (1e3, "mrad"), "curvature": (1.0, "1/m")}[key]
            for name, scans in each.items():
                marks = np.arange(MARK_M, LONGEST_M + 1e-9, MARK_M)
                curves = [np.interp(marks, scan["path"], scan[key]) for scan in scans]
                axes.plot(1e3 * marks, scale * np.median(curves, axis=0), label=name, color=COLOURS[name])
            axes.axhline(scale * limit, color=INK, linestyle="--", linewidth=0.8)
            axes.set(title=f"{key} ({unit})", xlabel="path (mm)")
            log_scale(axes, "y")
        legend(figure)
