"""Part of study `estimators`: errors of `ml` and `recursive` over the Cramér–Rao bound, and coverage of 95 % regions.

A case is a surface, a size, a path, its length and a noise. A seed draws the noise on the path once; the answer is
scored on (K11, K12, K22) at its end. Both estimators and the bound have the same prior, weak over the extent of the
path; the memory of `recursive` is the length of the path.

The bound is the limit of unbiased estimators. Where the true c13, c23, c33 equal the mean of the prior (planes, large
radii) an estimate with that prior is better, and its ratio is below 1. A local quadratic bound has a meaning inside
`REGION` only.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from canprobe.cell.results.picture import BLUE, INK, ORANGE, SHADE, legend, picture
from canprobe.lab.studies.cell_store import as_json
from canprobe.lab.studies.ground import PATHS, SURFACES, Ground, make_ground
from canprobe.lab.studies.result import CHI2_95_OF_3, FROBENIUS, Row, StudyResult, measuring_facts, sigma_values
from canprobe.lab.studies.sweep import Sweep
from canprobe.mechanics.touch import Prior, SurfaceEstimate, cramer_rao, fit_surface
from canprobe.mechanics.types import Floats

METHODS = ("ml", "recursive")
SEEDS, QUICK_SEEDS, BLOCK = 200, 10, 20
"""Seeds of a case, and how many of them make a cell of the sweep."""
SIZES_M, LONGEST_M, SAMPLES = (0.005, 0.04, 1.0), 0.02, 160
NOISES = ((5e-6, 2e-4), (20e-6, 1e-3), (100e-6, 5e-3))
LEAST_SIZE = 50.0
"""Least ‖K‖ that counts, 1/m: a smaller one counts as this."""
REGION: Mapping[str, float] = {"path": 1.0, "bound": 0.2, "κσ": 5e-3, "cubic": 1.0 / 3.0, "spread": 0.25}
"""Largest path over the radius, bound on an entry of K over its size, κσ_p (turn of the normal over the noise of a
point, rad), error of the quadric without noise (its prior, and cubic terms of the surface) over the bound, and noise of
a point over the spread of the points where that is narrowest: beyond, a path is not well excited.
"""
POOLED_RATIO, CASE_RATIO = {"ml": 1.1, "recursive": 1.25}, {"ml": 1.25, "recursive": 1.4}
LARGEST_BIAS = 1.0 / 3.0
"""Largest bias of K over the bound."""
Answer = list[float] | None
"""Error of K11, K12, K22, its squared length in standard deviations, and the stated ‖·‖²; None where not observed."""
MODEL = ("mechanics/touch", "lab/studies/bound.py", "lab/studies/ground.py")
COLUMNS = (
    "surface", "path", "size_mm", "length_mm", "sigma_point_um", "sigma_normal_mrad", "method", "bound_per_m", "ratio",
    "claimed", "bias", "coverage", "observed", "inside", "outside_for", "verdict",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class BoundCase:
    """One row of the study, m and rad."""

    surface: str
    path: str
    size: float
    length: float
    sigma_point: float
    sigma_normal: float

    @property
    def ground(self) -> Ground:
        """The path over the exact surface."""
        return make_ground(self.surface, self.size, self.path, self.length, SAMPLES)


def all_cases() -> Iterator[BoundCase]:
    """Weaves and circles over every surface and size with every noise, and weaves of 1.5 radii."""
    for surface in SURFACES:
        for size in SIZES_M[:2] if surface == "plane" else SIZES_M:
            for path, noise in product(PATHS, NOISES):
                yield BoundCase(surface, path, size, min(size, LONGEST_M), *noise)
        if surface != "plane":
            for noise in NOISES[1:]:
                yield BoundCase(surface, "weave", SIZES_M[0], 1.5 * SIZES_M[0], *noise)


def quick_cases() -> Iterator[BoundCase]:
    """Every surface once, and sizes, paths and noises in turn."""
    for i, surface in enumerate(SURFACES):
        size = SIZES_M[i % 2]
        yield BoundCase(surface, PATHS[i % 2], size, min(size, LONGEST_M), *NOISES[i % 3])


def run_bound(*, quick: bool, sweep: Sweep) -> StudyResult:
    """Measure all cases."""
    seeds = QUICK_SEEDS if quick else SEEDS
    rows = rows_of(list(quick_cases() if quick else all_cases()), seeds, sweep)
    facts = measuring_facts(quick, seeds, MODEL)
    return StudyResult("bound", rows, findings(rows), facts, partial(draw_bound, rows), COLUMNS)


def rows_of(cases: Sequence[BoundCase], seeds: int, sweep: Sweep) -> list[Row]:
    """The rows of some cases with a number of seeds each."""
    sweep.say(f"bound: {len(cases)} cases, {seeds} seeds each")
    cells = [(case, first, min(first + BLOCK, seeds)) for first in range(0, seeds, BLOCK) for case in cases]
    answers: dict[BoundCase, list[list[Answer]]] = {case: [] for case in cases}
    for (case, *_), found in zip(cells, sweep.map(measure, cells, model=MODEL), strict=True):
        answers[case] += found
    return [row for case, found in answers.items() for row in _rows(case, found)]


def measure(cell: tuple[BoundCase, int, int]) -> list[list[Answer]]:
    """Answers to a case for each seed from a first to before a last one: those of all methods to the same noise."""
    case, first, last = cell
    ground, fit, own = case.ground, _fitter(case), zlib.crc32(as_json(case).encode())
    answers = []
    for seed in range(first, last):
        measured = ground.measured(case.sigma_point, case.sigma_normal, np.random.default_rng([own, seed]))
        answers.append([_scored(ground, fit(*measured, method=method)) for method in METHODS])
    return answers


def _scored(ground: Ground, estimate: SurfaceEstimate) -> Answer:
    if estimate.rank < 3:
        return None
    e, C = ground.error(estimate.T_frame_contact, estimate.K), estimate.covariance
    return [*e.tolist(), float(e @ np.linalg.solve(C, e)), float(FROBENIUS @ np.diag(C))]


def _fitter(case: BoundCase) -> partial[Any]:
    points = case.ground.points
    prior = Prior.weak(float(np.linalg.norm(points - points[-1], axis=1).max()))
    return partial(fit_surface, prior=prior, sigma_point=case.sigma_point, sigma_normal=case.sigma_normal)


def _rows(case: BoundCase, answers: Sequence[Sequence[Answer]]) -> Iterator[Row]:
    """One row for each method."""
    ground, fit = case.ground, _fitter(case)
    C = cramer_rao(ground.points, ground.normals, ground.surface, **fit.keywords)
    bound = math.sqrt(float(FROBENIUS @ np.diag(C)))
    exact = fit(ground.points, ground.normals, quadric=True)
    size = float(np.linalg.norm(ground.K))
    criteria = {
        "path": 0.0 if case.surface == "plane" else case.length / case.size,
        "bound": math.sqrt(float(np.diag(C).max())) / max(size, LEAST_SIZE),
        "κσ": float(np.abs(np.linalg.eigvalsh(ground.K)).max()) * case.sigma_point,
        "cubic": _length(ground.error(exact.T_frame_contact, exact.K)) / bound,
        "spread": case.sigma_point / math.sqrt(float(np.linalg.eigvalsh(np.cov(ground.points[:, :2].T))[0])),
    }
    why = [name for name, limit in REGION.items() if not criteria[name] <= limit * (1.0 + 1e-9)]
    shared = {
        "surface": case.surface, "path": case.path, "size_mm": case.size * 1e3, "length_mm": case.length * 1e3,
        **sigma_values(case.sigma_point, case.sigma_normal), "bound_per_m": bound, "size_of_K_per_m": size,
        **{f"at_{name}": value for name, value in criteria.items()},
        "inside": not why, "outside_for": ", ".join(why) or "–",
    }  # fmt: skip
    for method, mine in zip(METHODS, zip(*answers, strict=True), strict=True):
        row = shared | {"method": method} | score(mine, bound)
        yield row | {"verdict": verdict(row, len(mine))}


def score(answers: Sequence[Answer], bound: float) -> dict[str, Any]:
    """Error, stated error and bias over the bound on ‖K‖ (1/m), coverage, and the share observed."""
    seen = np.array([a for a in answers if a is not None])
    if not len(seen):
        return dict.fromkeys(("ratio", "claimed", "bias", "coverage")) | {"observed": 0.0}
    errors = seen[:, :3]
    mean, scatter = errors.mean(axis=0), float(errors.var(axis=0) @ FROBENIUS) / len(errors)  # the mean's own scatter
    return {
        "ratio": math.sqrt(float(np.mean(errors**2 @ FROBENIUS))) / bound,
        "claimed": math.sqrt(float(np.median(seen[:, 4]))) / bound,
        "bias": math.sqrt(max(_length(mean) ** 2 - scatter, 0.0)) / bound,
        "coverage": float(np.mean(seen[:, 3] < CHI2_95_OF_3)),
        "observed": len(seen) / len(answers),
    }


def _length(error: Floats) -> float:
    """‖·‖ of (K11, K12, K22)."""
    return math.sqrt(float(FROBENIUS @ error**2))


def verdict(row: Row, seeds: int) -> str:
    """`good`, or the figures of a row that are out of line.

    With few seeds the limits are wider: by three standard deviations of the coverage (where that is more than 5 %), one
    of the mean error and two of its size (1/√(6n): three entries, sum of squares).
    """
    if row["ratio"] is None:
        return "not observed" if row["inside"] else "good"
    open_cover = max(0.05, 3.0 * math.sqrt(0.95 * 0.05 / seeds))
    wrong = []
    if row["inside"]:
        if row["ratio"] > CASE_RATIO[row["method"]] * (1.0 + (0.0 if seeds >= 200 else 2.0 / math.sqrt(6.0 * seeds))):
            wrong.append("error")
        if row["bias"] > LARGEST_BIAS + row["ratio"] / math.sqrt(seeds):
            wrong.append("bias")
        if row["observed"] < 1.0:
            wrong.append("not observed")
    if row["coverage"] < 0.95 - open_cover:
        wrong.append("overconfident")
    elif row["inside"] and row["coverage"] > min(0.99, 0.95 + open_cover) and seeds >= 200:
        wrong.append("covers too much")
    return ", ".join(wrong) or "good"


def findings(rows: Sequence[Row]) -> list[str]:
    """Pooled figures inside the region, the cases out of line there, and the count outside."""
    said = []
    for method in METHODS:
        mine = [r for r in rows if r["method"] == method]
        inside = [r for r in mine if r["inside"] and r["ratio"] is not None]
        outside = [r for r in mine if not r["inside"]]
        pooled = math.sqrt(float(np.mean([r["ratio"] ** 2 for r in inside])))
        cover = float(np.mean([r["coverage"] for r in inside]))
        bad = [r for r in inside if r["verdict"] != "good"]
        honest = sum(r["verdict"] == "good" for r in outside)
        said.append(
            f"{method}: inside the region {len(inside)} cases, error pooled {pooled:.3f} × bound (asked for: at most "
            f"{POOLED_RATIO[method]}), 95 % regions cover {100 * cover:.1f} % pooled (asked for: 94–96 %), "
            f"{len(bad)} cases out of line; outside {len(outside)} cases, {honest} with honest covariance."
        )
        said += [
            f"  out of line: {r['surface']} {r['size_mm']:.0f} mm, {r['path']}, {r['sigma_point_um']:.0f} µm (error"
            f" {r['ratio']:.2f}, bias {r['bias']:.2f}, cover {r['coverage']:.3f}): {r['verdict']}"
            for r in bad
        ]
    return said


RATIOS, COVERAGES = (0.0, 2.0), (0.85, 1.0)
"""Scales of the picture; a case beyond is drawn at the edge."""


def draw_bound(rows: Sequence[Row], path: Path) -> None:
    """Error over bound, and coverage, of every case: two panels for each method."""
    surfaces = list(dict.fromkeys(r["surface"] for r in rows))
    title = (
        "Error of curvature over the least that any estimator can have (Cramér–Rao bound; below 1 the prior helps),\n"
        "and how often the stated 95 % regions hold the true curvature; a mark: one surface, size, noise and path\n"
        "filled: a local quadric describes the contacts (inside), so the bound has a meaning; open: it does not\n"
        "on each surface from left to right: 5 mm, 40 mm, 1 m in size, each with more and more noise\n"
        "shade: target; values beyond the scale are drawn at its edge"
    )
    with picture(path, title, 1.3 + 3.3 * len(METHODS)) as figure:
        grid = figure.subplots(2 * len(METHODS), 1, squeeze=False, sharex=True)[:, 0]
        for method, upper, lower in zip(METHODS, grid[::2], grid[1::2], strict=True):
            mine = [r for r in rows if r["method"] == method and r["ratio"] is not None]
            _draw(upper, mine, surfaces, "ratio", RATIOS)
            upper.axhline(1.0, color=INK)
            upper.axhspan(0.0, POOLED_RATIO[method], color=SHADE, linewidth=0, zorder=0)
            upper.set(title=f"{method}: error", ylabel="error / bound")
            _draw(lower, mine, surfaces, "coverage", COVERAGES)
            lower.axhline(0.95, color=INK)
            lower.axhspan(0.90, 0.99, color=SHADE, linewidth=0, zorder=0)
            lower.set(title=f"{method}: coverage of 95 % regions", ylabel="coverage")
        legend(figure)


def _draw(axes: Axes, rows: Sequence[Row], surfaces: Sequence[str], key: str, limits: tuple[float, float]) -> None:
    for inside, colour in ((False, ORANGE), (True, BLUE)):
        for path, marker in (("weave", "o"), ("circle", "s")):
            mine = [r for r in rows if r["inside"] == inside and r["path"] == path]
            # smaller sizes to the left, more noise to the right
            places = [
                surfaces.index(r["surface"]) + 0.24 * float(np.log10(r["size_mm"]) - 1.85)
                + 0.04 * float(np.log2(r["sigma_point_um"] / 20.0))
                for r in mine
            ]  # fmt: skip
            axes.scatter(
                places, np.clip([r[key] for r in mine], *limits), s=22, marker=marker, linewidths=1.0,
                edgecolors=colour, facecolors=colour if inside else "none", clip_on=False, zorder=3,
                label=f"{path}, {'inside' if inside else 'outside'}",
            )  # fmt: skip
    axes.set_xticks(range(len(surfaces)), surfaces)
    axes.set(xlim=(-0.6, len(surfaces) - 0.4), ylim=(limits[0], limits[1] + 0.07 * (limits[1] - limits[0])))
    axes.grid(visible=False, axis="x")
