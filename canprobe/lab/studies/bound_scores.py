"""The scores of study `bound`: error, bias and coverage over the bound, verdicts and findings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from canprobe.lab.studies.ground import Ground
from canprobe.lab.studies.result import CHI2_95_OF_3, FROBENIUS, Row
from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate
from canprobe.mechanics.types import Floats

METHODS = ("ml", "recursive")
POOLED_RATIO, CASE_RATIO = {"ml": 1.1, "recursive": 1.25}, {"ml": 1.25, "recursive": 1.4}
LARGEST_BIAS = 1.0 / 3.0
"""Largest bias of K over the bound."""
Answer = list[float] | None
"""Error of K11, K12, K22, its squared length in standard deviations, and the stated ‖·‖²; None where not observed."""


def answer_of(ground: Ground, estimate: SurfaceEstimate) -> Answer:
    """The scored figures of an estimate."""
    if estimate.rank < 3:
        return None
    e, C = ground.error(estimate.T_frame_contact, estimate.K), estimate.covariance
    return [*e.tolist(), float(e @ np.linalg.solve(C, e)), float(FROBENIUS @ np.diag(C))]


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
        "bias": math.sqrt(max(length(mean) ** 2 - scatter, 0.0)) / bound,
        "coverage": float(np.mean(seen[:, 3] < CHI2_95_OF_3)),
        "observed": len(seen) / len(answers),
    }


def length(error: Floats) -> float:
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
        honest = [r for r in outside if r["verdict"] == "good"]
        said.append(
            f"{method}: inside the region {len(inside)} cases, error pooled {pooled:.3f} × bound (asked for: at most "
            f"{POOLED_RATIO[method]}), 95 % regions cover {100 * cover:.1f} % pooled (asked for: 94–96 %), "
            f"{len(bad)} cases out of line; outside {len(outside)} cases, {len(honest)} with honest covariance."
        )
        said += [f"  out of line: {_named(r)}: {r['verdict']}" for r in bad]
    return said


def _named(row: Row) -> str:
    return (
        f"{row['surface']} {row['size_mm']:.0f} mm, {row['path']}, {row['sigma_point_um']:.0f} µm "
        f"(error {row['ratio']:.2f}, bias {row['bias']:.2f}, cover {row['coverage']:.3f})"
    )
