"""Scores of the methods on the test shapes, each over its budget; table, findings and picture."""

from __future__ import annotations

import math
import statistics
import tracemalloc
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from canprobe.cell.results.picture import GREEN, INK, METHOD_COLOURS, PINK, SKY, legend, log_scale, picture
from canprobe.lab.studies.harness import Column, Row, StudyResult
from canprobe.lab.studies.result_files import measuring_facts
from canprobe.lab.studies.shapes import revisits
from canprobe.lab.studies.shapes.contacts_file import ShapeContacts, read_columns, read_contacts, write_contacts
from canprobe.lab.studies.shapes.methods import METHODS, FittedSurface, Method
from canprobe.lab.studies.shapes.scans import DEVELOPMENT, SECONDS, TEST, ScanCase, drawn, reached, scan
from canprobe.lab.studies.sweep import Sweep
from canprobe.mechanics.touch.linear_algebra import rms
from canprobe.mechanics.touch.meshing import Mesh, mesh_of
from canprobe.mechanics.types import Floats

FILE = "contacts.npz"
MESH_CELL_M = 1e-3
"""Side of a cell of the scored meshes."""
LIMITS_MM = (0.05, 0.1, 0.2, 0.5)
WORST_M = 1e-3
"""A larger error counts as this much, and so does truth where a method has no surface."""
TRUTH_STEP = 2
"""Step in the points of the truth that are looked for in the map."""
TIMED_SHAPE = "free-2"
"""Shape on which time and memory are measured; a contact costs the same on all."""
REPEATS, DRAWS = 3, 2000
KNOWN_AFTER_S = (2.0, 4.0, 6.0, 8.0)
"""Times of the scan after which the methods are asked, besides its end."""
PAIRED = ("accuracy_um", "completeness_um", "f_0.05mm", "f_0.1mm", "normal_mrad", "curvature_per_m", "nll")
"""Scores whose difference from the map's is taken shape by shape."""
_SCANS = ("fieldbus", "mechanics", "cell", "scenes", "lab/studies/shapes/scans.py")
_FITS = ("mechanics/touch", "cell/tasks", "lab/studies/shapes")
COLUMNS = (
    Column("method", "method"),
    Column("budget", "budget", "g"),
    Column("unit", "of"),
    Column("accuracy_um", "acc µm", ".0f"),
    Column("completeness_um", "compl µm", ".0f"),
    *(Column(f"f_{limit:g}mm", f"F {limit:g}", ".3f") for limit in LIMITS_MM),
    Column("normal_mrad", "normal mrad", ".1f"),
    Column("curvature_per_m", "K 1/m", ".2f"),
    Column("nll", "NLL", ".2f"),
    Column("coverage", "cover", ".2f"),
    Column("cpu_s", "CPU s", ".2f"),
    Column("memory_mb", "MB", ".1f"),
)

AFTER = (
    Column("seconds", "after s", "g"),
    *(column for column in COLUMNS if column.key not in {"cpu_s", "memory_mb"}),
)
AFTER_FINDINGS = (
    "What is known while the scan goes on, each method within one budget. The truth is that of the whole scan: ground"
    f" that was not reached yet counts as {1e3 * WORST_M:g} mm in the completeness, and nowhere else.",
)


class MethodFit(NamedTuple):
    """A method (index in `METHODS`) with settings on a shape of a file of contacts; repeats where it is timed.

    `seconds` is how much of the scan it gets.
    """

    method: int
    budget: float
    settings: Mapping[str, float]
    shape: str
    path: str
    sha256: str
    repeats: int
    seconds: float


def run(*, quick: bool, sweep: Sweep, draw: int | None = None) -> StudyResult:
    """Scan the shapes, fit every method within every budget, and score; with a draw on its shapes."""
    develop, test = DEVELOPMENT, TEST if draw is None else drawn(draw)
    if quick:
        develop, test = develop[:1], test[:1]
    if draw is not None:
        test = reached(test, sweep.say)
    whole = 1.2 if quick else SECONDS
    cases = [ScanCase(name, whole) for name in (*develop, *test)]
    sweep.say(f"{len(cases)} scans of {whole:g} s")
    found = sweep.map(scan, cases, model=_SCANS)
    path = sweep.folder / FILE
    digest = write_contacts(path, {case.shape: columns for case, columns in zip(cases, found, strict=True)})
    sweep.say(f"{path}: SHA-256 {digest}")
    shapes = [read_contacts(path, name) for name in develop]
    settings = [method.develop(shapes) for method in METHODS]
    every = [(m, budget) for m, method in enumerate(METHODS) for budget in method.budgets]
    usual = [(m, method.budgets[len(method.budgets) // 2]) for m, method in enumerate(METHODS)]
    repeats = 1 if quick else REPEATS

    def fits(chosen: Sequence[tuple[int, float]], names: Sequence[str], seconds: float) -> list[MethodFit]:
        return [
            MethodFit(m, budget, settings[m], name, str(path), digest, repeats, seconds)
            for m, budget in chosen
            for name in names
        ]

    def rows_of(chosen: Sequence[tuple[int, float]], seconds: float) -> tuple[list[Row], list[list[dict[str, Any]]]]:
        scores = sweep.map(score, fits(chosen, test, seconds), model=_FITS)
        each = [scores[k * len(test) : (k + 1) * len(test)] for k in range(len(chosen))]
        rows = [row_of(METHODS[m], b, mine) for (m, b), mine in zip(chosen, each, strict=True)]
        return [
            row | {"seconds": seconds} | over_map(mine, each[0]) for row, mine in zip(rows, each, strict=True)
        ], each

    chosen = usual if quick else every
    rows, each = rows_of(chosen, whole)
    timed = TIMED_SHAPE if TIMED_SHAPE in test else test[0]
    costs = sweep.time(cost, fits(chosen, [timed], whole), model=_FITS)
    rows = [row | c for row, c in zip(rows, costs, strict=True)]
    known = [row for seconds in KNOWN_AFTER_S if seconds < whole for row in rows_of(usual, seconds)[0]]
    known += [row for row, one in zip(rows, chosen, strict=True) if one in usual]
    facts = measuring_facts(quick, len(test), _FITS) | {"contacts": digest[:16], "shapes": ", ".join(test)}
    words = findings(rows, each, timed)
    after = StudyResult("shapes_after", AFTER, known, AFTER_FINDINGS, facts, partial(draw_after, known))
    back = sweep.map(revisits.measure, [revisits.Revisit(name, str(path), digest) for name in test], model=_FITS)
    words_back, draw_back = revisits.findings(back), partial(revisits.draw, back)
    again = StudyResult("shapes_revisits", revisits.COLUMNS, back, words_back, facts, draw_back)
    return StudyResult("shapes", COLUMNS, rows, words, facts, partial(draw_shapes, rows), [after, again])


def surface_of(fit: MethodFit, contacts: ShapeContacts) -> tuple[FittedSurface, Mesh]:
    """A method's answer and its mesh; the cost of both is what a method costs."""
    contacts = contacts.until(fit.seconds)
    surface = METHODS[fit.method].fit(contacts, fit.budget, fit.settings)
    return surface, mesh_of(surface.closest, contacts.touched.points[::20], MESH_CELL_M)


def cost(fit: MethodFit) -> dict[str, float]:
    """Processor time from contacts to mesh, median of the repeats, and the most memory that it takes at once."""
    contacts = read_contacts(Path(fit.path), fit.shape)
    times = []
    for _ in range(fit.repeats):
        begun = process_time()
        surface_of(fit, contacts)
        times.append(process_time() - begun)
    tracemalloc.start()
    surface_of(fit, contacts)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return {"cpu_s": statistics.median(times), "memory_mb": most / 1e6}


def score(fit: MethodFit) -> dict[str, Any]:
    """Scores of a method on one shape."""
    surface, mesh = surface_of(fit, read_contacts(Path(fit.path), fit.shape))
    return scored(surface, mesh, read_columns(Path(fit.path), fit.shape))


def scored(surface: FittedSurface, mesh: Mesh, truth: Mapping[str, Floats]) -> dict[str, Any]:
    """Scores of a surface and its mesh against the columns of the truth; None where there is nothing to score."""
    points, normals = truth["truth_point"], truth["truth_normal"]
    tensors = truth["truth_tensor"].reshape(-1, 3, 3)
    off = np.abs(distance_from(points, normals, tensors, mesh.vertices))
    use = np.flatnonzero(truth["truth_counts"] > 0.0)[::TRUTH_STEP]
    feet = surface.closest(points[use])
    missed = ~np.isfinite(feet.height)
    away = np.where(missed, math.inf, np.abs(feet.height))
    hit, found = [[float((e < 1e-3 * limit).mean()) if len(e) else 0.0 for limit in LIMITS_MM] for e in (off, away)]
    smooth = ~missed & (truth["truth_edge"][use] == 0.0)
    turned = np.linalg.norm(np.cross(feet.normal[smooth], normals[use][smooth]), axis=1)
    bent = np.linalg.norm(surface.curvature(points[use][smooth]) - tensors[use][smooth], axis=(1, 2))
    sigma = surface.sigma(points[use][~missed])
    known = sigma > 0.0
    z, sigma_mm = feet.height[~missed][known] / sigma[known], 1e3 * sigma[known]
    density = 0.5 * z**2 + np.log(sigma_mm) + 0.5 * math.log(2.0 * math.pi)
    return {
        "accuracy_um": 1e6 * float(np.minimum(off, WORST_M).mean()) if len(off) else 1e6 * WORST_M,
        "completeness_um": 1e6 * float(np.minimum(away, WORST_M).mean()),
        "missed": float(missed.mean()),
        **{f"f_{limit:g}mm": _harmonic(p, r) for limit, p, r in zip(LIMITS_MM, hit, found, strict=True)},
        "normal_mrad": 1e3 * rms(turned),
        "curvature_per_m": rms(bent[np.isfinite(bent)]),
        "nll": float(np.mean(density)) if len(z) else None,
        "coverage": float(np.mean(np.abs(z) < 1.96)) if len(z) else None,
    }  # fmt: skip


def distance_from(points: Floats, normals: Floats, tensors: Floats, at: Floats) -> Floats:
    """Signed distances of places from a surface known at close points (n,), m, by the quadric of the nearest one."""
    nearest = cKDTree(points).query(at)[1] if len(at) else np.zeros(0, np.intp)
    d = at - points[nearest]
    up = np.einsum("ij,ij->i", d, normals[nearest])
    flat = d - up[:, None] * normals[nearest]
    result: Floats = up + 0.5 * np.einsum("ij,ijk,ik->i", flat, tensors[nearest], flat)
    return result


def _harmonic(a: float, b: float) -> float:
    return 2.0 * a * b / (a + b) if a + b else 0.0


def row_of(method: Method, budget: float, scores: Sequence[Mapping[str, Any]]) -> Row:
    """Means over the shapes, each with the interval of 95 % of the draws of shapes."""
    row: Row = {"method": method.name, "budget": budget, "unit": method.unit}
    draws = _draws(len(scores))
    for key in scores[0]:
        values = np.array([math.nan if one[key] is None else one[key] for one in scores])
        known = bool(np.isfinite(values).all())
        low, high = np.quantile(values[draws].mean(axis=1), [0.025, 0.975]) if known else (math.nan, math.nan)
        row |= {key: float(values.mean()), f"{key}_low": float(low), f"{key}_high": float(high)}
    return row


def _draws(count: int) -> Any:
    """Indices (DRAWS, count) of shapes drawn anew."""
    return np.random.default_rng(0).integers(count, size=(DRAWS, count))


def over_map(scores: Sequence[Mapping[str, Any]], of_map: Sequence[Mapping[str, Any]]) -> Row:
    """Mean differences of a method's scores from the map's, shape by shape, with 95 % of the draws of shapes."""
    row: Row = {}
    for key in PAIRED:
        mine, others = ([math.nan if one.get(key) is None else one[key] for one in all_] for all_ in (of_map, scores))
        less = np.subtract(others, mine)
        low, high = np.quantile(less[_draws(len(less))].mean(axis=1), [0.025, 0.975])
        row |= {f"{key}_over_map": float(less.mean()), f"{key}_over_map_low": low, f"{key}_over_map_high": high}
    return row


def findings(rows: Sequence[Row], each: Sequence[Sequence[Mapping[str, Any]]], timed: str) -> list[str]:
    """The map against the best of the others, score by score; `each` has the scores of every row, the map's first."""
    said = [
        f"Means over {len(each[0])} shapes that no setting was found on. accuracy: map to truth; completeness: truth in"
        f" the footprint to map; both mean distances, at most {1e3 * WORST_M:g} mm; NLL: of the height in mm; time and"
        f" memory on {timed}. Differences with 95 % of the draws of shapes."
    ]
    for key, heading, best in (
        ("accuracy_um", "accuracy", min), ("completeness_um", "completeness", min),
        *((f"f_{limit:g}mm", f"F at {limit:g} mm", max) for limit in LIMITS_MM),
        ("normal_mrad", "normals", min), ("curvature_per_m", "curvature", min), ("nll", "NLL", min),
    ):  # fmt: skip
        others = [k for k in range(1, len(rows)) if not math.isnan(rows[k][key])]
        if not others or math.isnan(rows[0][key]):
            continue
        i = best(others, key=lambda k: rows[k][key])
        less = np.array([a[key] - b[key] for a, b in zip(each[0], each[i], strict=True)])
        low, high = np.quantile(less[_draws(len(less))].mean(axis=1), [0.025, 0.975])
        mine, theirs = (
            f"{row['method']} ({row['budget']:g} {row['unit']}) {row[key]:.3g} in {row['cpu_s']:.2f} s"
            for row in (rows[0], rows[i])
        )
        who = (
            "as good"
            if less.mean() == 0.0
            else f"{rows[i if (less.mean() > 0.0) == (best is min) else 0]['method']} better"
        )
        said.append(f"  {heading}: {who}: {mine}; {theirs}; difference {less.mean():.2g} ({low:.2g} to {high:.2g}).")
    held = [one["coverage"] for one in each[0] if one["coverage"] is not None]
    if held:
        said.append(
            f"  bands of the map: {statistics.mean(held):.1%} hold the truth; on the worst shape {min(held):.1%}, on"
            f" the best {max(held):.1%}. An error that a whole scan has in common puts a shape wholly in or out."
        )
    return said


COLOURS = {**METHOD_COLOURS, "map": "black", "quadrics": GREEN, "process, RBF": PINK, "process, thin plate": INK}
MARKERS = {"map": "*", "quadrics": "D", "process, RBF": "^", "process, thin plate": "v"}
PANELS = (
    ("f_0.1mm", "F-score at 0.1 mm (1 is best)", False),
    ("accuracy_um", "accuracy: map to truth (µm)", True),
    ("completeness_um", "completeness: truth to map (µm)", True),
    ("normal_mrad", "normals, away from edges (mrad)", True),
    ("curvature_per_m", "curvature, away from edges (1/m)", True),
    ("coverage", "share of 95 % bands that hold the truth", False),
)


AFTER_PANELS = (
    ("completeness_um", "completeness: truth of the whole scan to map (µm)", True),
    ("accuracy_um", "accuracy: map to truth (µm)", True),
    ("curvature_per_m", "curvature, away from edges (1/m)", True),
)


def draw_shapes(rows: Sequence[Row], path: Path) -> None:
    """Every score over processor time, a curve for each method."""
    title = (
        "Surfaces of the same contacts by every method, over the processor time from contacts to mesh: a curve joins\n"
        "the budgets of a method (5–40 mm of path, 3–9 mm of radius, 50–400 contacts); means over the test shapes"
    )
    with picture(path, title, 6.6) as figure:
        panels = figure.subplots(2, 3, sharex=True)
        _curves(rows, "cpu_s", panels.flat, PANELS, "x")
        for axes in panels[1]:
            axes.set_xlabel("processor time (s)")
        legend(figure)


def draw_after(rows: Sequence[Row], path: Path) -> None:
    """Scores over the time of the scan, a curve for each method."""
    title = "What every method knows while the scan goes on, each within one budget; means over the test shapes"
    with picture(path, title, 3.6) as figure:
        panels = figure.subplots(1, 3, sharex=True)
        _curves(rows, "seconds", panels, AFTER_PANELS, "")
        for axes in panels:
            axes.set_xlabel("time of the scan (s)")
        legend(figure)


def _curves(
    rows: Sequence[Row], over: str, panels: Any, what: Sequence[tuple[str, str, bool]], logarithmic: str
) -> None:
    for axes, (key, heading, log) in zip(panels, what, strict=True):
        for name in dict.fromkeys(row["method"] for row in rows):
            mine = [row for row in rows if row["method"] == name and not math.isnan(row[key])]
            if not mine:
                continue
            x, y = (np.array([row[k] for row in mine]) for k in (over, key))
            own, _, patched = name.partition(" + ")
            marker = MARKERS.get(own, "s" if patched else "o")
            style = "--" if patched else "-"
            axes.plot(x, y, label=name, color=COLOURS.get(own, SKY), marker=marker, markersize=4, linestyle=style)
        axes.set_title(heading)
        if scales := logarithmic + "y" * log:
            log_scale(axes, scales)
