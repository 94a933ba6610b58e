"""Study `explore`: the path that exploration, weaves, rasters and a circle need for the same error of one rectangle.

Every strategy touches the same shapes through the whole emulated sensor, without a bus, with the same array, force and
speed, for 10 s, or until it ends by itself. The shapes are those of study `shapes`: a draw names twelve that no
setting was found on. After every 5 mm the map of the contacts so far is compared with the true surface all over
the rectangle: ground that the map does not have counts as 1 mm, 0.1 rad and 20 1/m. A strategy that never reaches an
error counts with the longest path.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from canprobe.cell.planning.make import make_plan
from canprobe.cell.results.picture import BLUE, GREEN, GREY, INK, ORANGE, PINK, SKY, legend, log_scale, picture
from canprobe.cell.results.scores import curvature_tensor, score_contact
from canprobe.cell.scene.geometry import true_object
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.scene.setup import Approach, Touch
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_surface_map, make_task
from canprobe.errors import PlanError, SafetyStop, StudyError
from canprobe.lab.studies.harness import Column, Row, StudyResult
from canprobe.lab.studies.result_files import measuring_facts
from canprobe.lab.studies.shapes.scans import DEVELOPMENT, drawn, form_of, scene_of
from canprobe.lab.studies.sweep import Sweep
from canprobe.mechanics.touch import ContactSample, SurfaceMap
from canprobe.mechanics.touch.estimate.path_length import PathLength
from canprobe.mechanics.touch.shapes import PlacedShape
from canprobe.mechanics.touch.strategies import Circle, Strategy, Weave
from canprobe.mechanics.types import Floats

DRAW = 45
"""Draw of the published figures."""
LENGTH_MM, WIDTH_MM, TARGET_UM, SECONDS = 30.0, 20.0, 15.0, 10.0
MARK_M, TRUTH_M, LONGEST_M = 5e-3, 1.5e-3, 0.25
"""Path between two comparisons, spacing of the true surface's points, longest path, m."""
UNKNOWN = (1e-3, 0.1, 20.0)
"""Errors of ground that the map does not have: height (m), normal (rad), curvature (1/m)."""
LIMITS = {"height": 20e-6, "normal": 3e-3, "curvature": 2.0}
"""Mean errors that are to be reached: height, m; normal, rad; curvature, 1/m."""
DRAWS = 2000
_MODEL = ("fieldbus", "mechanics", "cell", "scenes", "lab/studies/shapes/scans.py", "lab/studies/explore.py")


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


STRATEGIES = ("explore", "weave 12 mm", "weave 9 mm", "raster 10 mm", "raster 8 mm", "raster 6 mm", "circle")
COLOURS = dict(zip(STRATEGIES, (ORANGE, BLUE, SKY, INK, GREEN, PINK, GREY), strict=True))


class ExploreCase(NamedTuple):
    """One scan of one shape."""

    shape: str
    strategy: str
    seconds: float


def run(*, quick: bool, sweep: Sweep, draw: int | None = None) -> StudyResult:
    """Touch the shapes with every strategy and compare; draw 0 stands for the development shapes."""
    shapes = DEVELOPMENT if draw == 0 else drawn(DRAW if draw is None else draw)
    strategies, shapes = (STRATEGIES[:2], shapes[:1]) if quick else (STRATEGIES, shapes)
    cases = [ExploreCase(shape, name, 2.0 if quick else SECONDS) for shape in shapes for name in strategies]
    sweep.say(f"{len(cases)} scans")
    found = sweep.map(measure, cases, model=_MODEL)
    by_shape = {shape: found[k * len(strategies) :][: len(strategies)] for k, shape in enumerate(shapes)}
    left_out = {shape: why for shape, scans in by_shape.items() for scan in scans if (why := scan.get("refused"))}
    shapes = tuple(shape for shape in shapes if shape not in left_out)
    if not shapes:
        raise StudyError(f"every shape has a strategy whose plan refuses it, such as: {next(iter(left_out.values()))}")
    each = {name: [by_shape[shape][k] for shape in shapes] for k, name in enumerate(strategies)}
    rows = [row_of(name, scans) for name, scans in each.items()]
    facts = measuring_facts(quick, len(shapes), _MODEL) | {"shapes": ", ".join(shapes)}
    words = findings(rows, each, shapes)
    words += [f"Left out: {shape}, {_kind(shape)}, where a plan says: {why}" for shape, why in left_out.items()]
    return StudyResult("explore", COLUMNS, rows, words, facts, partial(draw_paths, each))


COLUMNS = (
    Column("strategy", "strategy"),
    *(Column(f"{key}_mm", f"path to {text}, mm", ".0f") for key, text in (
        ("height", "20 µm"), ("normal", "3 mrad"), ("curvature", "2 1/m"),
    )),
    Column("reached", "reached"),
    Column("height_s", "time to 20 µm, s", ".1f"),
    Column("force_percent", "force %", ".1f"),
    Column("contact", "contact", ".1%"),
    Column("stopped", "stopped", "d"),
)  # fmt: skip


def measure(case: ExploreCase) -> dict[str, Any]:
    """Paths, times and errors of one scan, its force and contact; or the reason of a plan that refuses it."""
    with TemporaryDirectory() as folder:
        scene = scene_of(case.shape, Path(folder), case.seconds)
        assert scene.object is not None
        task = replace(
            scene.task, strategy="explore", length_mm=LENGTH_MM, width_mm=WIDTH_MM, target_sigma_um=TARGET_UM
        )
        setup, shape = resolve(replace(scene, task=task)), true_object(scene.object)
        touch = setup.task
        assert isinstance(touch, Touch) and touch.scan is not None
        if case.strategy != "explore":
            touch = replace(touch, scan=replace(touch.scan, strategy=fixed(case.strategy), name=case.strategy))
        try:
            plan = make_plan(replace(setup, task=touch))
        except PlanError as refusal:
            return {"refused": str(refusal).splitlines()[0]}
        controller: Any = make_task(plan)
        stopped = None
        with Session(plan) as session:
            try:
                session.run(controller)
            except SafetyStop as error:  # a scan that ends early has shown less
                stopped = error.reason
        first, last = controller.scan_cycles
        scored = score_contact(session.truth, first, last, touch.force)
        samples = list(controller.shape.samples)
        # an exploration lays its rectangle round the end of the approach, a curve lies round the first contact
        middle = touch.approach.start if case.strategy == "explore" else samples[0].p_base
        truth = TrueGround.of(shape, touch.approach, middle)
        errors = errors_over_path(make_surface_map(touch), samples, truth)
    return errors | {
        "force_percent": 100.0 * (scored["force_rms_error_n"] or 0.0) / touch.force,
        "contact": scored["contact_fraction"],
        "stopped": stopped,
    }


def fixed(name: str) -> Strategy:
    """A strategy that does not ask the map, by its name here."""
    length, width = 1e-3 * LENGTH_MM, 1e-3 * WIDTH_MM
    what, _, size = name.partition(" ")
    if what == "circle":
        return Circle(0.75 * width)
    apart = 1e-3 * float(size.split()[0])
    return Weave(length, width, apart) if what == "weave" else Lines(length, width, apart)


class TrueGround(NamedTuple):
    """The true surface of the rectangle: points (n, 3), m, normals (n, 3), curvature tensors (n, 3, 3), 1/m."""

    points: Floats
    normals: Floats
    tensors: Floats

    @classmethod
    def of(cls, shape: PlacedShape, approach: Approach, middle: Floats) -> TrueGround:
        """The surface of an object under the rectangle of an approach's plane round a place (3,), m."""
        sides = (1e-3 * LENGTH_MM, 1e-3 * WIDTH_MM)
        x, y = (np.arange(-0.5 * side + 0.5 * TRUTH_M, 0.5 * side, TRUTH_M) for side in sides)
        flat = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        feet = []
        for place in middle + flat @ approach.axes[:2]:
            height = 0.0
            for _ in range(20):  # Newton, along the approach
                foot = shape.closest(place + height * approach.normal)
                height -= foot.distance / max(float(foot.normal @ approach.normal), 0.3)
            feet.append(foot)
        return cls(
            np.array([foot.point for foot in feet]),
            np.array([foot.normal for foot in feet]),
            np.array([curvature_tensor(foot.kappa, *foot.directions) for foot in feet]),
        )


def errors_over_path(surface_map: SurfaceMap, samples: Sequence[ContactSample], truth: TrueGround) -> dict[str, Any]:
    """Errors after every `MARK_M` of the path of contacts, and the time at which each was walked."""
    travel = PathLength(0.2e-3)
    path = np.array([travel.total for sample in samples if travel.add(sample.p_base) is not None])
    seconds = np.array([sample.t_s for sample in samples]) - samples[0].t_s
    found: dict[str, list[float]] = {key: [] for key in ("path", "seconds", *LIMITS)}
    taken = 0
    for mark in np.arange(MARK_M, min(path[-1], LONGEST_M) + MARK_M, MARK_M):
        until = int(np.searchsorted(path, mark, side="right"))
        surface_map.add_samples(samples[taken:until])
        taken = until
        feet, curvature = surface_map.closest(truth.points), surface_map.curvature(truth.points)
        away = np.abs(feet.height)
        turned = np.linalg.norm(np.cross(feet.normal, truth.normals), axis=1)
        bent = np.linalg.norm(curvature.tensor - truth.tensors, axis=(1, 2))
        known = [
            np.minimum(np.where(np.isfinite(e), e, most), most)
            for e, most in zip((away, turned, bent), UNKNOWN, strict=True)
        ]
        found["path"].append(float(path[until - 1]))
        found["seconds"].append(float(seconds[until - 1]))
        found["height"].append(float(known[0].mean()))
        found["normal"].append(float(known[1].mean()))
        found["curvature"].append(float(known[2].mean()))
    return found


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
    row: Row = {"strategy": name}
    for key in LIMITS:
        row[f"{key}_mm"] = 1e3 * float(paths_of(scans, key).mean())
    reached = [path_to(scan, key, limit) is not None for scan in scans for key, limit in LIMITS.items()]
    times = [path_to(scan, "height", LIMITS["height"], "seconds") for scan in scans]
    return row | {
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
    draws = np.random.default_rng(0).integers(len(shapes), size=(DRAWS, len(shapes)))
    for key in LIMITS:
        best = min(fixed_ones, key=lambda name: float(paths_of(each[name], key).mean()))
        mine, theirs = paths_of(each["explore"], key), paths_of(each[best], key)
        ratio = mine.mean() / theirs.mean()
        low, high = np.quantile(mine[draws].mean(axis=1) / theirs[draws].mean(axis=1), [0.025, 0.975])
        worse = [f"{_kind(s)} {m / t:.2f}" for s, m, t in zip(shapes, mine, theirs, strict=True) if m > t]
        said.append(
            f"{key}: explore needs {ratio:.2f} ({low:.2f} to {high:.2f}) of the path of the best fixed strategy,"
            f" {best}; longer on {', '.join(worse) or 'no shape'}."
        )
    return said


def _kind(shape: str) -> str:
    form = form_of(shape)
    return str(form["made"][0] if "made" in form else form["kind"])


def draw_paths(each: Mapping[str, Sequence[Mapping[str, Any]]], path: Path) -> None:
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
