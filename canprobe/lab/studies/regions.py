"""Study `regions`: whether the online estimator's 95 % regions hold the truth with the whole sensor on, scene by scene.

Scenes are drawn at random from everything that a cell may meet: five cells, eleven kinds of surfaces from planes to
rough height fields with radii from 12 mm, weaves, straight paths and circles, 0.2 to 10 N, 3 to 100 mm/s, tool errors,
arrays with blur, gains, hysteresis and creep of their own. Each is scanned without a bus, with the same numbers, to
the last bit, as on a lockstep bus whose frames take no time (`bus.timed = false`). Frames that take time make images
older, and errors of a single scan others. A scene that answers nothing (its plan refuses it, or it is stopped before)
is counted, and another one is drawn in its place.

All seeds follow from the number of the draw. Settings of the estimator come from draws with other numbers than
`TEST_DRAW`. A scan is one draw of errors that last, so intervals come from drawing scenes anew (bootstrap), and
scenes are counted whose regions hold the truth seldom. Goals are stated for each kind of surface.

Source: Efron and Tibshirani, "An introduction to the bootstrap", 1993; Gneiting and Raftery, "Strictly proper scoring
rules, prediction, and estimation", 2007.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from canprobe.cell.results.picture import AMBER, BLUE, INK, ORANGE, SHADE, legend, log_scale, parts, picture
from canprobe.errors import UsageError
from canprobe.lab.studies.random_scenes import FOREIGN, KINDS, SceneSeed
from canprobe.lab.studies.region_scores import ScoredScan, held_share, measure
from canprobe.lab.studies.result import (
    CHI2_95_OF_3,
    Row,
    Say,
    StudyResult,
    drawn_anew,
    heading,
    interval_of,
    measuring_facts,
    shown,
    write_csv,
)
from canprobe.lab.studies.sweep import Sweep

TEST_DRAW = 100
SCENES, QUICK_SCENES = 40, 3
"""Scenes wanted of a kind that yield an estimate, K observed or not."""
DRAWS_PER_SCENE = 4
"""Largest number of scenes that are drawn for each one that is wanted."""
COVERAGE_GOAL, STATED_GOAL = (0.93, 0.97), (0.9, 1.4)
"""Pooled coverage, and geometric mean over scenes of stated over error, of every kind."""
LOW_COVERAGE, VERY_LOW_COVERAGE = 0.8, 0.4
"""Shares of the answers of a scene."""
LOW_SCENES_GOAL, VERY_LOW_SCENES_GOAL = 0.08, 0.01
"""Largest shares of such scenes."""
SCENES_NAMED = 8
MODEL = (
    "fieldbus", "mechanics", "cell", "scenes", "cells", "arrays", "calibrations", "lab/studies/array_presses.py",
    "lab/studies/random_scenes.py", "lab/studies/region_scores.py",
)  # fmt: skip
BESIDE = ("force", "bands", "relative_bands")
"""Shares of a scene beside its regions, whose mean over scenes a row has."""
COMPARED = ("refused", "stopped", "observed", "coverage", "stated_over_error", "log_score")
"""Figures that are shown beside those of an earlier run."""
BY: Mapping[str, Callable[[ScoredScan], str]] = {
    "array": lambda scan: scan.array,
    "cell": lambda scan: scan.cell,
    "path": lambda scan: scan.path,
    "speed": lambda scan: _between(scan.speed_mm_s, (3.0, 14.0, 40.0, 100.0), "mm/s"),
    "force": lambda scan: _between(scan.force_n, (0.2, 0.5, 3.0, 10.0), "N"),
    "tool": lambda scan: "true tool" if scan.tool_error_mm == 0.0 else "wrong tool",
}
"""Groups of the table besides the kinds of surfaces."""


def _between(value: float, ends: Sequence[float], unit: str) -> str:
    """The span of these that has a value."""
    low, high = next(pair for pair in pairwise(ends) if value < pair[1] or pair[1] == ends[-1])
    return f"{low:g}–{high:g} {unit}"


def run(*, quick: bool, sweep: Sweep, draw: int = TEST_DRAW, against: Path | None = None) -> StudyResult:
    """Scan the scenes of a draw.

    Args:
        quick: a few scenes of each kind.
        sweep: computes the scans.
        draw: number that all seeds follow from.
        against: result file (`regions.json`) of an earlier run, to compare with.
    """
    earlier = None if against is None else earlier_rows(against)
    wanted = QUICK_SCENES if quick else SCENES
    scans = scan_all(sweep, draw, KINDS, wanted)
    write_csv(sweep.folder / "regions_scenes.csv", [scene_row(scan) for scan in scans])
    rows = rows_of(scans)
    said = findings(rows, scans)
    if earlier is not None:
        said += compared(rows, earlier)
    facts = measuring_facts(quick, len(scans), MODEL) | {"draw": draw}
    return StudyResult("regions", rows, said, facts, partial(draw_regions, rows, scans))


def scan_all(sweep: Sweep, draw: int, kinds: Sequence[str], wanted: int) -> list[ScoredScan]:
    """Scan scenes of each kind until the wanted number of them answers; at most `DRAWS_PER_SCENE` for each."""
    scans: dict[str, list[ScoredScan]] = {kind: [] for kind in kinds}
    while True:
        todo = []
        for kind, done in scans.items():
            missing = wanted - sum(scan.late > 0 for scan in done)
            numbers = range(len(done), min(len(done) + missing, DRAWS_PER_SCENE * wanted))
            todo += [SceneSeed(draw, kind, number).value() for number in numbers]
        if not todo:
            return [scan for done in scans.values() for scan in done]
        sweep.say(f"{len(todo)} scans")
        for answer in sweep.map(measure, todo, model=MODEL):
            scan = ScoredScan.of(answer)
            scans[scan.kind].append(scan)


def rows_of(scans: Sequence[ScoredScan]) -> list[Row]:
    """Rows of the table: each kind, all of them, behind jumps, and the other groups; foreign arrays count apart."""
    known = [scan for scan in scans if scan.kind != FOREIGN]
    kinds = dict.fromkeys(scan.kind for scan in scans)
    rows = [row_of("kind", kind, [scan for scan in scans if scan.kind == kind]) for kind in kinds]
    rows.append(row_of("kind", "all but foreign", known))
    jumps = [scan._replace(scores=scan.behind, late=scan.behind_late) for scan in known if scan.behind_late]
    if jumps:
        rows.append(row_of("behind a jump", "all but foreign", jumps))
    for group, name in BY.items():
        mine = scans if group == "array" else known
        for value in sorted({name(scan) for scan in mine}):
            rows.append(row_of(group, value, [scan for scan in mine if name(scan) == value]))
    return rows


def row_of(group: str, name: str, scans: Sequence[ScoredScan]) -> Row:
    """One row of the table."""
    answering = [scan for scan in scans if len(scan.scores)]
    answers = np.concatenate([scan.scores for scan in answering]) if answering else np.full((1, 5), math.nan)
    # of each scene: answers, regions that hold the truth, and the logarithm of stated over error
    sums = np.array([
        [len(scan.scores), len(scan.scores) * scan.share, math.log(scan.stated_per_m / scan.error_per_m)]
        for scan in answering
    ]).reshape(-1, 3)  # fmt: skip
    coverage, stated = (math.nan, math.nan), (math.nan, math.nan)
    if answering:  # intervals over scenes that are drawn anew
        drawn = sums[drawn_anew(len(sums))].sum(axis=1)
        coverage = interval_of(drawn[:, 1] / drawn[:, 0])
        low, high = interval_of(drawn[:, 2] / len(sums))
        stated = math.exp(low), math.exp(high)
    shares = [scan.share for scan in answering]
    worst = min(answering, key=lambda scan: scan.share, default=None)
    seeds = sorted(scan.seed for scan in scans)
    return {
        "group": group, "of": name,
        "seeds": f"{seeds[0]}–{seeds[-1]}" if group == "kind" and seeds[0] // 1000 == seeds[-1] // 1000 else "",
        "scenes": len(scans), "refused": sum(scan.ended.startswith("refused") for scan in scans),
        "stopped": sum(scan.ended.startswith("stopped") for scan in scans), "answers": int(sums[:, 0].sum()),
        "observed": float(sums[:, 0].sum()) / max(sum(scan.late for scan in scans), 1),
        "coverage": math.nan if (held := held_share(answering)) is None else held,
        "coverage_low": coverage[0], "coverage_high": coverage[1],
        "below_80": float(np.mean(np.array(shares) < LOW_COVERAGE)) if shares else math.nan,
        "below_40": float(np.mean(np.array(shares) < VERY_LOW_COVERAGE)) if shares else math.nan,
        "error_per_m": math.sqrt(float(np.mean(answers[:, 1]))),
        "stated_over_error": math.exp(float(np.mean(sums[:, 2]))) if shares else math.nan,
        "stated_low": stated[0], "stated_high": stated[1], "log_score": float(np.mean(answers[:, 4])),
        **{name: mean_of([getattr(scan, name) for scan in answering]) for name in BESIDE},
        "worst": f"{worst.seed}: {worst.share:.2f}" if worst is not None else "",
    }  # fmt: skip


def mean_of(shares: Sequence[float]) -> float:
    """Mean of the shares that are known; NaN without any."""
    known = [share for share in shares if not math.isnan(share)]
    return sum(known) / len(known) if known else math.nan


def findings(rows: Sequence[Row], scans: Sequence[ScoredScan]) -> list[str]:
    """Coverage of all, each goal with the kinds that miss it, and the worst scenes with the line that repeats one."""
    kinds = [row for row in rows if row["group"] == "kind"]
    whole, surfaces = kinds[-1], [row for row in kinds[:-1] if row["answers"]]
    said = [
        f"{whole['scenes']} scenes of known arrays, {whole['refused']} refused by their plans and "
        f"{whole['stopped']} stopped: {100 * whole['coverage']:.1f} % of {whole['answers']} regions hold the truth "
        f"({100 * whole['coverage_low']:.1f} to {100 * whole['coverage_high']:.1f} by scenes drawn anew), stated over "
        f"error {whole['stated_over_error']:.2f}, {100 * whole['observed']:.1f} % of the answers observe all of K."
    ]
    said.append(
        f"Within 2σ, means over scenes: forces of {100 * whole['force']:.1f} % of the seconds; of the map's heights"
        f" {100 * whole['bands']:.1f} %, and {100 * whole['relative_bands']:.1f} % against the rest of the surface."
    )
    low, high = COVERAGE_GOAL
    least, most = STATED_GOAL
    odd = {
        f"{100 * low:g}–{100 * high:g} % of the regions of every kind hold the truth": [
            f"{r['of']} {100 * r['coverage']:.1f} %" for r in surfaces if not low <= r["coverage"] <= high
        ],
        f"stated over error {least:g}–{most:g} for every kind (geometric mean over scenes)": [
            f"{r['of']} {r['stated_over_error']:.2f}" for r in surfaces if not least <= r["stated_over_error"] <= most
        ],
    }
    for key, edge, goal in (("below_80", 80, LOW_SCENES_GOAL), ("below_40", 40, VERY_LOW_SCENES_GOAL)):
        kinds_of = [f"{r['of']} {100 * r[key]:.0f} %" for r in surfaces if r[key] > LOW_SCENES_GOAL]
        missed = [f"{100 * whole[key]:.1f} %", *kinds_of] if whole[key] > goal else []
        odd[f"at most {100 * goal:g} % of the scenes below {edge} %"] = missed
    said += [f"Goal: {text}: {'missed by ' + ', '.join(missed) if missed else 'met'}." for text, missed in odd.items()]
    for row in (row for row in rows if row["group"] == "behind a jump"):
        said.append(
            f"Scored apart, up to 1.5 mm behind a jump of the surface: {100 * row['observed']:.0f} % of the answers "
            f"observe all of K, {100 * row['coverage']:.0f} % of those regions hold the truth, error "
            f"{row['error_per_m']:.1f} 1/m."
        )
    worst = sorted((scan for scan in scans if scan.share < LOW_COVERAGE), key=lambda scan: scan.share)[:SCENES_NAMED]
    if worst:
        said.append("The worst scenes, and the line that repeats each:")
        said += [
            f"  {100 * scan.share:.0f} %, {in_words(scan)}: canprobe study regions --seed {scan.seed}" for scan in worst
        ]
    return said


def in_words(scan: ScoredScan) -> str:
    """The scene of a scan in words."""
    tool = f", tool {scan.tool_error_mm:.2f} mm off" if scan.tool_error_mm else ""
    return (
        f"{scan.object} on {scan.cell}, {scan.path}, {scan.speed_mm_s:g} mm/s, {scan.force_n:g} N, {scan.array} array"
        f" of {scan.full_scale_kpa:.0f} kPa{tool}"
    )


def earlier_rows(path: Path) -> dict[str, Row]:
    """Rows by kind of the result file of an earlier run.

    Raises:
        UsageError: it is no such file.
    """
    try:
        rows = json.loads(path.read_text(encoding="utf-8"))["rows"]
        found = {row["of"]: row for row in rows if row["group"] == "kind"}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"--against {path}: expected the regions.json of an earlier run: {error}") from error
    if not found:
        raise UsageError(f"--against {path}: expected the regions.json of an earlier run, got one without kinds")
    return found


def compared(rows: Sequence[Row], earlier: Mapping[str, Row]) -> list[str]:
    """What is withheld, and the log score, beside those of an earlier run, for each kind."""
    said = ["Now / in the earlier run:"]
    for row in rows:
        if row["group"] == "kind" and (before := earlier.get(row["of"])) is not None:
            pairs = [f"{heading(key)} {shown(row[key])} / {shown(before[key])}" for key in COMPARED]
            said.append(f"  {row['of']}: {', '.join(pairs)}")
    return said


def scene_row(scan: ScoredScan) -> Row:
    """The facts of a scene, its seed first, and its scores."""
    facts = {name: value for name, value in scan._asdict().items() if name not in ("scores", "behind")}
    scores = ("share", "error_per_m", "stated_per_m")
    return {**facts, "answers": len(scan.scores)} | {
        name: getattr(scan, name) if len(scan.scores) else None for name in scores
    }


def replay(seed: int, say: Say) -> dict[str, Any]:
    """Scan the scene of one seed again and report each answer.

    Returns:
        The facts of the scan; `failures` says so where less than `LOW_COVERAGE` of the regions hold the truth.
    """
    scan = measure(seed)
    say(f"seed {seed}: {in_words(scan)}")
    rows = [(row, "") for row in scan.scores.tolist()] + [(row, ", behind a jump") for row in scan.behind.tolist()]
    for (t_s, error, stated, square, _), where in sorted(rows):
        held = "holds" if square < CHI2_95_OF_3 else "misses"
        say(f"  {t_s:.2f} s: error {math.sqrt(error):.2f} 1/m, stated {math.sqrt(stated):.2f}, region {held}{where}")
    say(f"  {len(scan.scores)} of {scan.late} answers observe all of K{', ' + scan.ended if scan.ended else ''}")
    failures = []
    if scan.share < LOW_COVERAGE:
        failures.append(f"{100 * scan.share:.0f} % of the regions hold the truth")
        say(f"  FAILURE: {failures[0]}")
    return {**scene_row(scan), "failures": failures}


SHARES = (
    (0.8, 1.01, BLUE, "o", "80 % of the scene's regions or more hold the truth"),
    (0.4, 0.8, AMBER, "s", "40 to 80 %"),
    (0.0, 0.4, ORANGE, "v", "less than 40 %"),
)
"""Least and greatest share of the regions of a scene that hold the truth, with colour, marker and words."""
PANELS_IN_A_ROW = 4


def draw_regions(rows: Sequence[Row], scans: Sequence[ScoredScan], path: Path) -> None:
    """A panel for each kind with a mark for each scene; below them the coverage with its interval."""
    kinds = [row for row in rows if row["group"] == "kind"]
    title = (
        "Whether the online estimator knows its error: each mark is a random scene, each panel a kind\n"
        "number: mean of stated over error; above the line: cautious; shade: as asked for, 0.9 to 1.4, 93 to 97 %\n"
        "lowest: share of the 95 % regions that hold the truth, with 95 % of the draws of scenes"
    )
    panels = kinds[:-1]
    lines = -(-len(panels) // PANELS_IN_A_ROW)
    with picture(path, title, 3.0 + 1.9 * lines) as figure:
        upper, lower = parts(figure, 2, 1, height_ratios=(1.9 * lines, 2.2))
        grid = upper.subplots(lines, PANELS_IN_A_ROW, squeeze=False, sharex=True, sharey=True)
        found = [value for scan in scans if len(scan.scores) for value in (scan.error_per_m, scan.stated_per_m)]
        span = (0.8 * min(found), 1.25 * max(found)) if found else (0.1, 10.0)
        for axes, row in zip(grid.flat, panels, strict=False):
            mine = [scan for scan in scans if scan.kind == row["of"] and len(scan.scores)]
            _draw_kind(axes, f"{row['of']}: {row['stated_over_error']:.2f}", mine, span)
        for axes in grid.flat[len(panels) :]:
            axes.set_visible(False)
        legend(upper)
        _draw_coverage(lower.subplots(), kinds)


def _draw_kind(axes: Axes, title: str, scans: Sequence[ScoredScan], span: tuple[float, float]) -> None:
    ends = np.array(span)
    axes.fill_between(ends, 0.9 * ends, 1.4 * ends, color=SHADE, linewidth=0, zorder=0)
    axes.plot(ends, ends, color=INK, linewidth=0.8)
    for low, high, colour, marker, words in SHARES:
        mine = [scan for scan in scans if low <= scan.share < high]
        x, y = [scan.error_per_m for scan in mine], [scan.stated_per_m for scan in mine]
        axes.scatter(x, y, s=14, color=colour, marker=marker, label=words, zorder=3, linewidths=0)
    log_scale(axes, "xy")
    axes.set(title=title, xlabel="RMS error (1/m)", ylabel="stated (1/m)", xlim=span, ylim=span)
    axes.label_outer()


def _draw_coverage(axes: Axes, rows: Sequence[Row]) -> None:
    shown = [row for row in rows if not math.isnan(row["coverage"])]
    y = np.array([row["coverage"] for row in shown])
    bars = np.abs(np.array([[row[end] for row in shown] for end in ("coverage_low", "coverage_high")]) - y)
    axes.axhspan(0.93, 0.97, color=SHADE, linewidth=0, zorder=0)
    axes.errorbar(range(len(shown)), y, yerr=bars, fmt="o", markersize=4, linewidth=1, color=BLUE, zorder=3)
    axes.set_xticks(range(len(shown)), [row["of"] for row in shown], rotation=30, ha="right", rotation_mode="anchor")
    axes.set(ylabel="coverage", xlim=(-0.6, len(shown) - 0.4))
    axes.grid(visible=False, axis="x")
