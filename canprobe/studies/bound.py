"""Study `bound`: how near to the Cramér–Rao bound `ml` and `recursive` come, and whether their regions cover.

Each case is a surface, a size, a path, its length and a noise; every seed is one path felt anew and one answer, scored
on (K11, K12, K22) at its end. Both estimators and the bound have the same prior, weak over the extent of the path; the
memory of `recursive` is the length of the path, starting from nothing.

The bound is a limit of what unbiased estimators can do. Where the true c13, c23, c33 happen to be what the prior takes
them for (planes, large radii) an estimate with that prior is better than it, and its ratio is below 1.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.studies.bound_cases import Case, all_cases, criteria, quick_cases, reasons_outside
from canprobe.studies.bound_scores import METHODS, Answer, answer_of, findings, length, score, verdict
from canprobe.studies.ground import FROBENIUS
from canprobe.studies.study import Column, StudyResult
from canprobe.studies.study_files import SIGMA_COLUMNS, measuring_facts, sigma_values
from canprobe.studies.sweep import Sweep
from canprobe.studies.sweep_store import as_json
from canprobe.touch.bound import cramer_rao
from canprobe.touch.fit import fit_surface
from canprobe.touch.prior import Prior

SEEDS, BLOCK = 200, 20
"""Seeds a case, and how many of them make a cell of the sweep."""
MODEL = ("touch", "studies/bound.py", "studies/bound_cases.py", "studies/bound_scores.py", "studies/ground.py")
AT = "at_"
"""Before the names of `bound_cases.criteria` in a row."""
COLUMNS = (
    Column("surface", "surface"),
    Column("path", "path"),
    Column("size_mm", "size mm", ".0f"),
    Column("length_mm", "path mm", ".1f"),
    *SIGMA_COLUMNS,
    Column("method", "method"),
    Column("bound_per_m", "bound 1/m", ".3g"),
    Column("ratio", "error/bound", ".2f"),
    Column("claimed", "claimed/bound", ".2f"),
    Column("bias", "bias/bound", ".2f"),
    Column("coverage", "cover", ".3f"),
    Column("observed", "observed", ".2f"),
    Column("inside", "inside"),
    Column("outside_for", "why not"),
    Column("verdict", "verdict"),
)


def run(*, quick: bool, sweep: Sweep) -> StudyResult:
    """Measure all cases."""
    return measure_all(list(quick_cases() if quick else all_cases()), 10 if quick else SEEDS, sweep, quick=quick)


def measure_all(cases: list[Case], seeds: int, sweep: Sweep, *, quick: bool = False) -> StudyResult:
    """The study of some cases with so many seeds each."""
    rows = measure_rows(cases, range(seeds), sweep)

    def draw(path: Path) -> None:
        from canprobe.studies.bound_figure import draw_bound

        draw_bound(rows, path)

    return StudyResult("bound", COLUMNS, rows, findings(rows), measuring_facts(quick, seeds, MODEL), draw)


def measure_rows(cases: list[Case], seeds: range, sweep: Sweep) -> list[dict[str, Any]]:
    """The table of some cases with these seeds each."""
    sweep.say(f"{len(cases)} cases, {len(seeds)} seeds each")
    blocks = [(first, min(BLOCK, seeds.stop - first)) for first in seeds[::BLOCK]]
    cells = [(case, method, *block) for block in blocks for case in cases for method in METHODS]
    answers: dict[tuple[Case, str], list[Answer]] = {(case, method): [] for case in cases for method in METHODS}
    for (case, method, *_), found in zip(cells, sweep.map(measure, cells, model=MODEL), strict=True):
        answers[case, method] += found
    return [row for case in cases for row in _rows(case, {m: answers[case, m] for m in METHODS})]


def measure(cell: tuple[Case, str, int, int]) -> list[Answer]:
    """Answers of a method to a case, with so many seeds from the first one on."""
    case, method, first, count = cell
    ground, fit, own = case.ground, _fitter(case), zlib.crc32(as_json(case).encode())
    generators = [np.random.default_rng([own, seed]) for seed in range(first, first + count)]
    felt = [ground.felt(case.sigma_point, case.sigma_normal, rng) for rng in generators]
    return [answer_of(ground, fit(points, normals, method=method)) for points, normals in felt]


def _fitter(case: Case) -> partial[Any]:
    points = case.ground.points
    prior = Prior.weak(float(np.linalg.norm(points - points[-1], axis=1).max()))
    return partial(fit_surface, prior=prior, sigma_point=case.sigma_point, sigma_normal=case.sigma_normal)


def _rows(case: Case, answers: dict[str, list[Answer]]) -> Iterator[dict[str, Any]]:
    """One row for each method."""
    ground, fit = case.ground, _fitter(case)
    C = cramer_rao(ground.points, ground.normals, ground.surface, **fit.keywords)
    bound = math.sqrt(float(FROBENIUS @ np.diag(C)))
    exact = fit(ground.points, ground.normals, quadric=True)
    model_bias = length(ground.error(exact.T_frame_contact, exact.K)) / bound
    values = criteria(case, ground, C, model_bias)
    why = reasons_outside(values)
    shared = {
        "surface": case.surface, "path": case.path, "size_mm": case.size * 1e3, "length_mm": case.length * 1e3,
        **sigma_values(case.sigma_point, case.sigma_normal),
        "bound_per_m": bound, "size_of_K_per_m": float(np.linalg.norm(ground.K)),
        **{AT + name: value for name, value in values.items()}, "inside": not why, "outside_for": ", ".join(why) or "–",
    }  # fmt: skip
    for method, mine in answers.items():
        row = shared | {"method": method} | score(mine, bound)
        yield row | {"verdict": verdict(row, len(mine))}
