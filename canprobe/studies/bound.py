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
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.studies.ground import FROBENIUS, PATHS, SURFACES, Array, Ground, make_ground
from canprobe.studies.study import Column, StudyResult
from canprobe.studies.study_files import SIGMA_COLUMNS, measuring_facts, sigma_values
from canprobe.studies.sweep import Sweep
from canprobe.studies.sweep_store import as_json
from canprobe.touch.bound import cramer_rao
from canprobe.touch.fit import fit_surface
from canprobe.touch.prior import Prior

SEEDS = 200
SIZES_M, LONGEST_M, SAMPLES = (0.005, 0.04, 1.0), 0.02, 160
NOISES = ((5e-6, 2e-4), (20e-6, 1e-3), (100e-6, 5e-3))
METHODS = ("ml", "recursive")
MODEL = ("touch", "studies/bound.py", "studies/ground.py")
CHI2_95_OF_3 = 7.815
# the region in which a local quadratic bound means something
LARGEST_BOUND, LEAST_SIZE, LARGEST_TILT, LARGEST_BIAS = 0.2, 50.0, 5e-3, 1.0 / 3.0
POOLED_RATIO, CASE_RATIO = {"ml": 1.1, "recursive": 1.25}, {"ml": 1.25, "recursive": 1.4}
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


@dataclass(frozen=True, slots=True)
class Case:
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


def all_cases() -> Iterator[Case]:
    """Weaves and circles over every surface and size with every noise, and weaves of 1.5 radii."""
    for surface in SURFACES:
        for size in SIZES_M[:2] if surface == "plane" else SIZES_M:
            for path, noise in product(PATHS, NOISES):
                yield Case(surface, path, size, min(size, LONGEST_M), *noise)
        if surface != "plane":
            for noise in NOISES[1:]:
                yield Case(surface, "weave", SIZES_M[0], 1.5 * SIZES_M[0], *noise)


def quick_cases() -> Iterator[Case]:
    """Every surface once, and sizes, paths and noises in turn."""
    for i, surface in enumerate(SURFACES):
        size = SIZES_M[i % 2]
        yield Case(surface, PATHS[i % 2], size, min(size, LONGEST_M), *NOISES[i % 3])


def run(*, quick: bool, sweep: Sweep) -> StudyResult:
    """Measure all cases."""
    seeds = 10 if quick else SEEDS
    cases = list(quick_cases() if quick else all_cases())
    sweep.say(f"{len(cases)} cases, {seeds} seeds each")
    rows = [row for rows in sweep.map(measure, [(case, seeds) for case in cases], model=MODEL) for row in rows]

    def draw(path: Path) -> None:
        from canprobe.studies.bound_figure import draw_bound

        draw_bound(rows, path)

    return StudyResult("bound", COLUMNS, rows, findings(rows), measuring_facts(quick, seeds, MODEL), draw)


def measure(cell: tuple[Case, int]) -> list[dict[str, Any]]:
    """One row for each method, of a case with so many seeds."""
    case, seeds = cell
    ground = case.ground
    prior = Prior.weak(float(np.linalg.norm(ground.points - ground.points[-1], axis=1).max()))
    C = cramer_rao(
        ground.points, ground.normals, ground.surface,
        sigma_point=case.sigma_point, sigma_normal=case.sigma_normal, prior=prior,
    )  # fmt: skip
    fit = partial(fit_surface, prior=prior, sigma_point=case.sigma_point, sigma_normal=case.sigma_normal)
    bound = math.sqrt(float(FROBENIUS @ np.diag(C)))
    exact = fit(ground.points, ground.normals, quadric=True)
    model_bias = _length(ground.error(exact.T_frame_contact, exact.K)) / bound
    why = reasons_outside(case, ground, C, model_bias)
    shared = {
        "surface": case.surface, "path": case.path, "size_mm": case.size * 1e3, "length_mm": case.length * 1e3,
        **sigma_values(case.sigma_point, case.sigma_normal),
        "bound_per_m": bound, "size_of_K_per_m": float(np.linalg.norm(ground.K)), "model_bias": model_bias,
        "inside": not why, "outside_for": ", ".join(why) or "–",
    }  # fmt: skip
    own = zlib.crc32(as_json(case).encode())
    generators = [np.random.default_rng([own, seed]) for seed in range(seeds)]
    felt = [ground.felt(case.sigma_point, case.sigma_normal, rng) for rng in generators]
    rows = [shared | {"method": m} | _score(ground, [fit(p, n, method=m) for p, n in felt], bound) for m in METHODS]
    for row in rows:
        row["verdict"] = verdict(row, seeds)
    return rows


def reasons_outside(case: Case, ground: Ground, C: Array, model_bias: float) -> list[str]:
    """Why a local quadratic bound means little in a case; empty inside the region."""
    size = float(np.linalg.norm(ground.K))
    tightest = float(np.abs(np.linalg.eigvalsh(ground.K)).max())
    entry = math.sqrt(float(np.diag(C).max()))
    tests = {
        "path": case.surface != "plane" and case.length > case.size * (1.0 + 1e-9),
        "bound": not entry <= LARGEST_BOUND * max(size, LEAST_SIZE),
        "κσ": tightest * case.sigma_point > LARGEST_TILT * (1.0 + 1e-9),
        "cubic": not model_bias <= LARGEST_BIAS,
    }
    return [name for name, outside in tests.items() if outside]


def _score(ground: Ground, answers: Sequence[Any], bound: float) -> dict[str, Any]:
    seen = [a for a in answers if a.rank == 3]
    if not seen:
        return dict.fromkeys(("ratio", "claimed", "bias", "coverage")) | {"observed": 0.0}
    errors = np.array([ground.error(a.T_frame_contact, a.K) for a in seen])
    squares = [float(e @ np.linalg.solve(a.covariance, e)) for e, a in zip(errors, seen, strict=True)]
    mean, scatter = errors.mean(axis=0), float(errors.var(axis=0) @ FROBENIUS) / len(errors)  # the mean's own scatter
    claimed = float(np.median([FROBENIUS @ np.diag(a.covariance) for a in seen]))
    return {
        "ratio": math.sqrt(float(np.mean(errors**2 @ FROBENIUS))) / bound,
        "claimed": math.sqrt(claimed) / bound,
        "bias": math.sqrt(max(_length(mean) ** 2 - scatter, 0.0)) / bound,
        "coverage": float(np.mean(np.array(squares) < CHI2_95_OF_3)),
        "observed": len(seen) / len(answers),
    }


def _length(error: Array) -> float:
    return math.sqrt(float(FROBENIUS @ error**2))


def verdict(row: dict[str, Any], seeds: int) -> str:
    """What a row shows: `good`, or what is wrong with it.

    With few seeds the limits are wider by what that many leave open: three standard deviations of the coverage
    (where that is more than 5 %), one of the mean error and two of its size (1/√(6n): three entries, sum of squares).
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


def findings(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Pooled figures inside the region, what is wrong there, and what is outside."""
    said = []
    for method in METHODS:
        mine = [r for r in rows if r["method"] == method]
        inside = [r for r in mine if r["inside"] and r["ratio"] is not None]
        outside = [r for r in mine if not r["inside"]]
        pooled = math.sqrt(float(np.mean([r["ratio"] ** 2 for r in inside])))
        cover = float(np.mean([r["coverage"] for r in inside]))
        bad = [r for r in inside if r["verdict"] != "good"]
        honest = [r for r in outside if r["verdict"] == "good"]
        said.append(
            f"{method}: inside the region {len(inside)} cases, error pooled {pooled:.3f} × bound (asked for: at most "
            f"{POOLED_RATIO[method]}), 95 % regions cover {100 * cover:.1f} % pooled (asked for: 94–96 %), "
            f"{len(bad)} cases out of line; outside {len(outside)} cases, {len(honest)} with honest covariance."
        )
        said += [f"  out of line: {_named(r)}: {r['verdict']}" for r in bad]
    return said


def _named(row: dict[str, Any]) -> str:
    return (
        f"{row['surface']} {row['size_mm']:.0f} mm, {row['path']}, {row['sigma_point_um']:.0f} µm "
        f"(error {row['ratio']:.2f}, bias {row['bias']:.2f}, cover {row['coverage']:.3f})"
    )
