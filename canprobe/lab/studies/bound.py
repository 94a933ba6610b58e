"""Study `bound`: errors of `ml` and `recursive` over the Cramér–Rao bound, and the coverage of their 95 % regions.

A case is a surface, a size, a path, its length and a noise. A seed draws the noise on the path once; the answer is
scored on (K11, K12, K22) at its end. Both estimators and the bound have the same prior, weak over the extent of the
path; the memory of `recursive` is the length of the path.

The bound is the limit of unbiased estimators. Where the true c13, c23, c33 equal the mean of the prior (planes, large
radii) an estimate with that prior is better, and its ratio is below 1.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from canprobe.lab.studies.bound_cases import REGION, BoundCase, all_cases, criteria, quick_cases
from canprobe.lab.studies.bound_figure import draw_bound
from canprobe.lab.studies.bound_scores import METHODS, Answer, answer_of, findings, length, score, verdict
from canprobe.lab.studies.cell_store import as_json
from canprobe.lab.studies.result import (
    FROBENIUS,
    SIGMA_COLUMNS,
    Column,
    Row,
    StudyResult,
    measuring_facts,
    sigma_values,
)
from canprobe.lab.studies.sweep import Sweep
from canprobe.mechanics.touch.estimate.fit import fit_surface
from canprobe.mechanics.touch.estimate.likelihood import cramer_rao
from canprobe.mechanics.touch.estimate.prior import Prior

SEEDS, BLOCK = 200, 20
"""Seeds of a case, and how many of them make a cell of the sweep."""
MODEL = (
    "mechanics/touch",
    *(f"lab/studies/{name}.py" for name in ("bound", "bound_cases", "bound_scores", "ground")),
)
CRITERION_PREFIX = "at_"
"""Prefix of the names of `criteria` in a row."""
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


def measure_all(cases: list[BoundCase], seeds: int, sweep: Sweep, *, quick: bool = False) -> StudyResult:
    """The study of some cases with a number of seeds each."""
    sweep.say(f"{len(cases)} cases, {seeds} seeds each")
    blocks = [(first, min(BLOCK, seeds - first)) for first in range(0, seeds, BLOCK)]
    cells = [(case, method, *block) for block in blocks for case in cases for method in METHODS]
    answers: dict[tuple[BoundCase, str], list[Answer]] = {(case, method): [] for case in cases for method in METHODS}
    for (case, method, *_), found in zip(cells, sweep.map(measure, cells, model=MODEL), strict=True):
        answers[case, method] += found
    rows = [row for case in cases for row in _rows(case, {m: answers[case, m] for m in METHODS})]
    facts = measuring_facts(quick, seeds, MODEL)
    return StudyResult("bound", COLUMNS, rows, findings(rows), facts, partial(draw_bound, rows))


def measure(cell: tuple[BoundCase, str, int, int]) -> list[Answer]:
    """Answers of a method to a case, with a number of seeds from the first one on."""
    case, method, first, count = cell
    ground, fit, own = case.ground, _fitter(case), zlib.crc32(as_json(case).encode())
    generators = [np.random.default_rng([own, seed]) for seed in range(first, first + count)]
    felt = [ground.felt(case.sigma_point, case.sigma_normal, rng) for rng in generators]
    return [answer_of(ground, fit(points, normals, method=method)) for points, normals in felt]


def _fitter(case: BoundCase) -> partial[Any]:
    points = case.ground.points
    prior = Prior.weak(float(np.linalg.norm(points - points[-1], axis=1).max()))
    return partial(fit_surface, prior=prior, sigma_point=case.sigma_point, sigma_normal=case.sigma_normal)


def _rows(case: BoundCase, answers: dict[str, list[Answer]]) -> Iterator[Row]:
    """One row for each method."""
    ground, fit = case.ground, _fitter(case)
    C = cramer_rao(ground.points, ground.normals, ground.surface, **fit.keywords)
    bound = math.sqrt(float(FROBENIUS @ np.diag(C)))
    exact = fit(ground.points, ground.normals, quadric=True)
    model_bias = length(ground.error(exact.T_frame_contact, exact.K)) / bound
    values = criteria(case, ground, C, model_bias)
    why = [name for name, limit in REGION.items() if not values[name] <= limit * (1.0 + 1e-9)]
    shared = {
        "surface": case.surface, "path": case.path, "size_mm": case.size * 1e3, "length_mm": case.length * 1e3,
        **sigma_values(case.sigma_point, case.sigma_normal),
        "bound_per_m": bound, "size_of_K_per_m": float(np.linalg.norm(ground.K)),
        **{CRITERION_PREFIX + name: value for name, value in values.items()},
        "inside": not why, "outside_for": ", ".join(why) or "–",
    }  # fmt: skip
    for method, mine in answers.items():
        row = shared | {"method": method} | score(mine, bound)
        yield row | {"verdict": verdict(row, len(mine))}
