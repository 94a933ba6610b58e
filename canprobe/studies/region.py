"""Study `region`: a pilot of `bound` that chooses a region in which a local quadratic bound means something.

The cases of `bound`, and more that go to the edges, with seeds of their own. For each limit of the region (path over
radius, bound over size, κσ_p, cubic terms over the bound, noise over spread) the cases that are inside by all the
others are sorted into levels of it. A level holds where both estimators have the error, bias and coverage asked for,
pooled, and all of K observed. The limit is the upper end of the last level before the first that does not hold, and
never beyond what `MEANT` says, from where on K is not what the bound is about.

What is in use stands in `bound_cases.REGION`; where the pilot chooses another limit, the table says why.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from canprobe.results.picture import INK, METHOD_COLOURS, SHADE, legend, log_scale, picture
from canprobe.studies.bound import (
    AT,
    CASE_RATIO,
    LARGEST_BIAS,
    LONGEST_M,
    METHODS,
    MODEL,
    NOISES,
    REGION,
    SIZES_M,
    SURFACES,
    Case,
    all_cases,
    measure_rows,
    quick_cases,
)
from canprobe.studies.harness import Column, StudyResult, measuring_facts
from canprobe.studies.sweep import Sweep

FIRST_SEED, SEEDS = 1_000_000, 20
"""`bound` has the seeds from 0 on."""
MEANT: Mapping[str, float] = MappingProxyType(
    {"path": 1.0, "bound": 0.2, "κσ": 5e-3, "cubic": 1.0 / 3.0, "spread": 0.25}
)
"""Beyond a radius of path no surface is like its quadric; a bound of a fifth of K is hardly a measurement; where a
point's noise turns the normal by 5 mrad it is no small noise; cubic terms of a third of the bound are a third of it;
where noise is a quarter of what the points are spread by, the rank decision (`rank.SPREAD`) begins to say no."""
LEVELS: Mapping[str, tuple[float, ...]] = MappingProxyType({
    "path": (0.05, 0.5, 1.0, 1.5, 2.0),
    "bound": (0.005, 0.02, 0.05, 0.2, 0.5),
    "κσ": (1e-4, 1e-3, 5e-3, 1e-2, 2.5e-2),
    "cubic": (0.05, 0.15, 1.0 / 3.0, 0.5, 1.0, 10.0),
    "spread": (0.01, 0.05, 0.25, 0.5),
})  # fmt: skip
COLUMNS = (
    Column("limit", "limit"),
    Column("above", "above", ".4g"),
    Column("up_to", "up to", ".4g"),
    Column("method", "method"),
    Column("cases", "cases"),
    Column("ratio", "error/bound", ".2f"),
    Column("bias", "bias/bound", ".2f"),
    Column("coverage", "cover", ".3f"),
    Column("observed", "observed", ".2f"),
    Column("holds", "holds"),
)


def run(*, quick: bool, sweep: Sweep) -> StudyResult:
    """Measure and choose."""
    cases = list(quick_cases()) if quick else pilot_cases()
    seeds = 5 if quick else SEEDS
    measured = measure_rows(cases, range(FIRST_SEED, FIRST_SEED + seeds), sweep)
    rows = [row for limit in LEVELS for row in levels_of(limit, measured)]

    def draw(path: Path) -> None:
        draw_region(measured, path)

    return StudyResult(
        "region", COLUMNS, rows, findings(rows), measuring_facts(quick, seeds, (*MODEL, "studies/region.py")), draw
    )


def pilot_cases() -> list[Case]:
    """Those of `bound`, and short, long and middling noisy ones."""
    small, middle = SIZES_M[:2]
    more = [
        case
        for surface in SURFACES
        if surface != "plane"
        for case in (
            *(Case(surface, "weave", middle, share * LONGEST_M, *NOISES[2]) for share in (0.125, 0.25, 0.5)),
            *(Case(surface, "weave", small, share * small, *NOISES[1]) for share in (0.5, 1.25, 2.0)),
            Case(surface, "circle", small, small, 50e-6, 2.5e-3),
        )
    ]
    return list(dict.fromkeys([*all_cases(), *more]))


def levels_of(limit: str, measured: Sequence[Mapping[str, Any]]) -> Iterator[dict[str, Any]]:
    """The rows of one limit."""
    others = [r for r in measured if all(r[AT + k] <= v * (1.0 + 1e-9) for k, v in MEANT.items() if k != limit)]
    above = -math.inf
    for up_to in LEVELS[limit]:
        here = [r for r in others if above < r[AT + limit] / (1.0 + 1e-9) <= up_to]
        for method in METHODS:
            mine = [r for r in here if r["method"] == method]
            if mine:
                yield {"limit": limit, "above": max(above, 0.0), "up_to": up_to, "method": method, **pooled(mine)}
        above = up_to


def pooled(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """A level's scores over its cases, and whether they are what is asked for."""
    seen = [r for r in rows if r["ratio"] is not None]
    observed = sum(r["observed"] for r in rows) / len(rows)
    if not seen:
        return {"cases": len(rows), "ratio": None, "bias": None, "coverage": None, "observed": observed, "holds": False}
    ratio, bias = (math.sqrt(sum(r[key] ** 2 for r in seen) / len(seen)) for key in ("ratio", "bias"))
    coverage = sum(r["coverage"] for r in seen) / len(seen)
    right = ratio <= CASE_RATIO[rows[0]["method"]] and bias <= LARGEST_BIAS and coverage >= 0.90
    return {
        "cases": len(rows), "ratio": ratio, "bias": bias, "coverage": coverage, "observed": observed,
        "holds": right and observed >= 0.99,
    }  # fmt: skip


def chosen(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """The region's limits."""
    found = {}
    for limit, most in MEANT.items():
        mine = [r for r in rows if r["limit"] == limit]
        first_bad = min((r["above"] for r in mine if not r["holds"]), default=math.inf)
        found[limit] = min(most, first_bad, max((r["up_to"] for r in mine), default=most))
    return found


def findings(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """What is chosen, and whether that is what stands in the code."""
    return [
        f"{limit}: {value:.4g}"
        + (" (as in use)" if math.isclose(value, REGION[limit]) else f"; in use is {REGION[limit]:.4g}")
        for limit, value in chosen(rows).items()
    ]


# The picture of study `region`.

NAMES = {
    "path": "path / radius",
    "bound": "bound / size of K",
    "κσ": "κσₚ (rad)",
    "cubic": "cubic terms / bound",
    "spread": "noise / spread",
}
CLIP = 3.0


def draw_region(measured: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Error over bound and coverage of every case against each limit: a column of panels a limit."""
    title = (
        "How far out the Cramér–Rao bound means something: each case against each limit; line: the limit chosen\n"
        f"shade: as it should be; an error above {CLIP:g} bounds: at the edge"
    )
    with picture(path, title, 5.2) as figure:
        grid = figure.subplots(2, len(NAMES), sharey="row", sharex="col")
        for column, (limit, name) in zip(grid.T, NAMES.items(), strict=True):
            shown = ((column[0], "ratio", (0.0, 1.25), CLIP), (column[1], "coverage", (0.90, 1.0), 1.0))
            for axes, key, band, top in shown:
                axes.axhspan(*band, color=SHADE, linewidth=0, zorder=0)
                axes.axvline(REGION[limit], color=INK, linewidth=0.9)
                for method, marker in (("ml", "o"), ("recursive", "x")):
                    mine = [r for r in measured if r["method"] == method and r[key] is not None]
                    axes.scatter(
                        [max(r[AT + limit], 1e-4) for r in mine], [min(r[key], top) for r in mine],
                        s=16, marker=marker, color=METHOD_COLOURS[method], alpha=0.7, linewidths=1.0, label=method,
                        zorder=3,
                    )  # fmt: skip
                log_scale(axes, "x")
            column[1].set_xlabel(name)
        grid[0][0].set_ylabel("error / bound")
        grid[1][0].set_ylabel("coverage of 95 % regions")
        legend(figure)
