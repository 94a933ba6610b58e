"""Study `surfaces`: whole surfaces of unknown shapes, by the package and by libraries, and what exploration saves.

Every strategy touches twelve shapes of a draw (`drawn_shapes`) through the whole emulated sensor, without a bus, for
10 s or until it ends by itself: exploration, weaves, rasters and a circle. The true surface is known at points of the
rectangle. Two tables:

- `surfaces`: the contacts of one weave, given to the package's map and to the methods of `surface_methods`. Heights,
  normals and curvature are compared where a method has a surface; likelihood and coverage are of the height with the σ
  that it states; time is the processor time of fit and answer, in one thread.
- `exploration`: the path that each strategy needs for an error of the map all over the rectangle. Ground that the map
  does not have counts as `WORST_ERRORS`; a strategy that never reaches an error counts with the longest path.

Intervals draw the shapes anew. No setting was found on the shapes of the default draw; draw 0 is for development.

Source: Gneiting and Raftery, "Strictly proper scoring rules, prediction, and estimation", 2007.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any, NamedTuple

import numpy as np

from canprobe.cell.planning.make import make_plan
from canprobe.cell.results.picture import BLUE, GREEN, INK, ORANGE, legend, log_scale, picture
from canprobe.cell.results.scores import score_contact
from canprobe.cell.scene.geometry import true_object
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.scene.setup import Touch
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_surface_map, make_task
from canprobe.errors import PlanError, SafetyStop, StudyError
from canprobe.lab.studies import exploration
from canprobe.lab.studies.drawn_shapes import DrawnShape, TrueGround, drawn, scene_of
from canprobe.lab.studies.result import Row, StudyResult, heading, mean_and_interval, measuring_facts
from canprobe.lab.studies.surface_methods import METHODS, FoundSurface
from canprobe.lab.studies.sweep import Sweep
from canprobe.mechanics.touch.contact import ContactSample

DRAW, SECONDS, QUICK_SECONDS = 45, exploration.SECONDS, 2.0
"""Draw of the published figures, and duration of a scan."""
QUICK_STRATEGIES = ("explore", "weave 9 mm")
COMPARED = "weave 9 mm"
"""Strategy whose contacts all methods get."""
MODEL = (
    "fieldbus", "mechanics", "cell", "scenes",
    *(f"lab/studies/{name}.py" for name in ("surfaces", "surface_methods", "exploration", "drawn_shapes")),
)  # fmt: skip
COLUMNS = (
    "method", "setting", "unit", "known", "height_um", "normal_mrad", "curvature_per_m", "nll", "coverage", "cpu_s",
)  # fmt: skip


class SurfaceCase(NamedTuple):
    """One scan of one shape."""

    shape: DrawnShape
    strategy: str
    seconds: float


def run(*, quick: bool, sweep: Sweep, draw: int = DRAW) -> StudyResult:
    """Touch the shapes of a draw with every strategy, and compare."""
    strategies, shapes = (QUICK_STRATEGIES, drawn(draw)[:1]) if quick else (exploration.STRATEGIES, drawn(draw))
    seconds = QUICK_SECONDS if quick else SECONDS
    cases = [SurfaceCase(shape, name, seconds) for shape in shapes for name in strategies]
    sweep.say(f"{len(cases)} scans, draw {draw}")
    scans = dict(zip(cases, sweep.map(measure, cases, model=MODEL), strict=True))
    left_out = {case.shape: why for case, scan in scans.items() if (why := scan.get("refused"))}
    names = [shape.name for shape in shapes if shape not in left_out]
    if not names:
        raise StudyError(f"every shape has a strategy whose plan refuses it, such as: {next(iter(left_out.values()))}")
    each = {
        name: [scan for case, scan in scans.items() if case.strategy == name and case.shape not in left_out]
        for name in strategies
    }
    rows = rows_of([scan["methods"] for scan in each[COMPARED]])
    paths = [exploration.row_of(name, scans) for name, scans in each.items()]
    facts = measuring_facts(quick, len(names), MODEL) | {"draw": draw}
    said = exploration.findings(paths, each, names)
    said += [f"Left out: {shape.name}, where a plan says: {why}" for shape, why in left_out.items()]
    more = StudyResult("exploration", paths, said, facts, partial(exploration.draw, each))
    return StudyResult("surfaces", rows, findings(rows), facts, partial(draw_surfaces, rows), COLUMNS, (more,))


def measure(case: SurfaceCase) -> dict[str, Any]:
    """Errors over the path of one scan, its force and contact, and the methods' scores; or why its plan refuses it."""
    with TemporaryDirectory() as folder:
        scene = scene_of(case.shape, Path(folder), case.seconds)
        assert scene.object is not None
        setup, shape = resolve(scene), true_object(scene.object)
        touch = setup.task
        assert isinstance(touch, Touch) and touch.scan is not None
        if case.strategy != "explore":
            scan = replace(touch.scan, strategy=exploration.fixed(case.strategy), name=case.strategy)
            touch = replace(touch, scan=scan)
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
        first, last = controller.record().scan_cycles
        scored = score_contact(session.buses.truth, first, last, touch.force)
        samples = list(controller.shape.samples)
        # an exploration lays its rectangle round the end of the approach, a curve lies round the first contact
        middle = touch.approach.start if case.strategy == "explore" else samples[0].p_base
        truth = TrueGround.of(shape, touch.approach, middle)
        answer = exploration.errors_over_path(make_surface_map(touch), samples, truth)
        if case.strategy == COMPARED:
            answer["methods"] = compare_methods(samples, touch, truth)
    return answer | {
        "force_percent": 100.0 * (scored["force_rms_error_n"] or 0.0) / touch.force,
        "contact": scored["contact_fraction"],
        "stopped": stopped,
    }


def compare_methods(samples: Sequence[ContactSample], task: Touch, truth: TrueGround) -> list[dict[str, Any]]:
    """Scores of every method and setting on the same contacts, the map's first."""
    found = []
    for name, (find, settings, unit) in METHODS.items():
        for setting in settings:
            begun = process_time()
            surface = find(samples, task, setting, truth.points)
            spent = process_time() - begun
            found.append({"method": name, "setting": setting, "unit": unit, **score(surface, truth), "cpu_s": spent})
    return found


def score(found: FoundSurface, truth: TrueGround) -> dict[str, Any]:
    """Scores of a surface where it is; None where there is nothing to score."""
    known = np.isfinite(found.height)
    height, normal, curvature = (errors[known] for errors in truth.errors(found))
    stated = known & (found.sigma > 0.0)
    z, sigma_mm = found.height[stated] / found.sigma[stated], 1e3 * found.sigma[stated]
    density = 0.5 * z**2 + np.log(sigma_mm) + 0.5 * math.log(2.0 * math.pi)
    return {
        "known": float(known.mean()),
        "height_um": 1e6 * float(height.mean()) if len(height) else None,
        "normal_mrad": 1e3 * float(normal.mean()) if len(height) else None,
        "curvature_per_m": float(curvature.mean()) if len(height) else None,
        "nll": float(density.mean()) if len(z) else None,
        "coverage": float(np.mean(np.abs(z) < 1.96)) if len(z) else None,
    }


def rows_of(each: Sequence[Sequence[Mapping[str, Any]]]) -> list[Row]:
    """Means over the shapes, and differences from the map shape by shape, each with 95 % of the draws of shapes."""
    rows = []
    for k, first in enumerate(each[0]):
        row: Row = {name: first[name] for name in ("method", "setting", "unit")}
        for key in COLUMNS[3:]:
            mine, maps = (np.array([math.nan if one[i][key] is None else one[i][key] for one in each]) for i in (k, 0))
            row |= mean_and_interval(key, mine) | mean_and_interval(f"{key}_over_map", mine - maps)
        rows.append(row)
    return rows


def findings(rows: Sequence[Row]) -> list[str]:
    """The map against the best of the others, score by score."""
    said = ["Errors are means where a method has a surface; NLL is of the height in mm; time of one thread."]
    for key, words in (
        ("height_um", "height"), ("normal_mrad", "normals"), ("curvature_per_m", "curvature"), ("nll", "NLL"),
    ):  # fmt: skip
        others = [row for row in rows[1:] if not math.isnan(row[key])]
        if not others or math.isnan(rows[0][key]):
            continue
        best = min(others, key=lambda row: row[key])
        more, low, high = (best[f"{key}_over_map{end}"] for end in ("", "_low", "_high"))
        said.append(
            f"{words}: map {rows[0][key]:.3g} in {rows[0]['cpu_s']:.2f} s; best of the others {best['method']}"
            f" ({best['setting']:g} {best['unit']}) {best[key]:.3g} in {best['cpu_s']:.2f} s; difference {more:.2g}"
            f" ({low:.2g} to {high:.2g})."
        )
    if not math.isnan(rows[0]["coverage"]):
        said.append(f"95 % bands of the map's height hold the truth at {rows[0]['coverage']:.1%} of the points.")
    return said


def draw_surfaces(rows: Sequence[Row], path: Path) -> None:
    """Every score over processor time, a curve for each method."""
    title = "Surfaces of the same contacts, over the processor time from contacts to answers; means over the shapes"
    with picture(path, title, 3.6) as figure:
        panels = figure.subplots(1, 4, sharex=True)
        for axes, score_key in zip(panels, COLUMNS[4:8], strict=True):
            for name, colour, marker in zip(METHODS, (INK, BLUE, GREEN, ORANGE), "*Dv^", strict=True):
                mine = [row for row in rows if row["method"] == name]
                times, values = ([row[key] for row in mine] for key in ("cpu_s", score_key))
                axes.plot(times, values, marker=marker, color=colour, label=name)
            log_scale(axes, "x" if score_key == "nll" else "xy")
            axes.set(title=heading(score_key), xlabel="processor time (s)")
        legend(figure)
