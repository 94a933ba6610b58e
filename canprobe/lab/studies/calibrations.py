"""Study `calibrations`: does the cell notice that its array has the calibration of another one?

Scenes of study `regions` are scanned, of every kind of surface but rough ones, each with an array of its own: blur,
gains, hysteresis, creep, crosstalk, full scale and layer drawn at random. Half of the arrays have their own
calibration, where each notice is a false alarm; the others have the packaged one. Some of these happen to be much like
the array that it was made on, and do no harm unnoticed: arrays count apart whose blur or layer is off by more than a
third.

Limits of the check come from draws 1 and 2; draw 3 is for tests and the default.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.cell.results.picture import BLUE, INK, ORANGE, legend, picture
from canprobe.cell.scene.calibrations import load_calibration
from canprobe.cell.scene.resolve import EMULATED_ARRAY
from canprobe.lab.studies.random_scenes import FOREIGN, KINDS, SceneSeed, own_array
from canprobe.lab.studies.region_scores import ScoredScan, measure
from canprobe.lab.studies.regions import MODEL
from canprobe.lab.studies.result import CHI2_95_OF_3, Column, Row, StudyResult, measuring_facts
from canprobe.lab.studies.sweep import Sweep
from canprobe.mechanics.touch.pad import Pad

TEST_DRAW = 3
SCANS, QUICK_SCANS = 24, 3
"""Number of scans of each group."""
FAR_RATIO = 4.0 / 3.0
"""Ratio of blur or stiffness to the calibration's beyond which an array is unlike the one of its calibration."""
SMOOTH_KINDS = tuple(kind for kind in KINDS if kind not in (FOREIGN, "rough"))
GROUPS = ("own", "foreign, alike", "foreign, unlike")
COLUMNS = (
    Column("calibration", "calibration"),
    Column("scans", "scans"),
    Column("noticed", "noticed"),
    Column("coverage", "regions that hold the truth", ".3f"),
    Column("coverage_noticed", "where noticed", ".3f"),
)


def run(*, quick: bool, sweep: Sweep, draw: int = TEST_DRAW) -> StudyResult:
    """Scan the scenes of a draw."""
    number = QUICK_SCANS if quick else SCANS
    own = [
        SceneSeed(draw, SMOOTH_KINDS[i % len(SMOOTH_KINDS)], 1 + 3 * (i // len(SMOOTH_KINDS))) for i in range(number)
    ]
    foreign = [SceneSeed(draw, FOREIGN, i) for i in range(number)]
    seeds = [seed.value() for seed in (*own, *foreign)]
    sweep.say(f"{len(seeds)} scans, draw {draw}")
    answers = [ScoredScan.of(answer) for answer in sweep.map(measure, seeds, model=MODEL)]
    scans = [scan for scan in answers if not scan.ended.startswith("refused")]
    rows = [row_of(group, [scan for scan in scans if group_of(scan) == group]) for group in GROUPS]
    facts = measuring_facts(quick, len(scans), MODEL) | {"draw": draw}
    return StudyResult("calibrations", COLUMNS, rows, findings(rows), facts, partial(draw_calibrations, scans))


def differences(seed: int) -> tuple[float, float]:
    """Blur and stiffness of a scene's own array over those of the packaged calibration."""
    config, stiffness, _ = own_array(seed)
    image = load_calibration(EMULATED_ARRAY).image
    # the taxels, a pitch wide, add the variance of their width to the cover's blur
    blur = math.hypot(config.blur_pitch, math.sqrt(1.0 / 12.0)) * Pad().pitch_m
    return blur / image.blur, stiffness / image.stiffness


def group_of(scan: ScoredScan) -> str:
    """Group of a scan."""
    if scan.array != FOREIGN:
        return "own"
    off = max(abs(math.log(ratio)) for ratio in differences(scan.seed))
    return "foreign, unlike" if off > math.log(FAR_RATIO) else "foreign, alike"


def row_of(group: str, scans: Sequence[ScoredScan]) -> Row:
    """One row of the table."""
    return {
        "calibration": group,
        "scans": len(scans),
        "noticed": sum(scan.noticed for scan in scans),
        "coverage": _coverage(scans),
        "coverage_noticed": _coverage([scan for scan in scans if scan.noticed]),
    }


def _coverage(scans: Sequence[ScoredScan]) -> float | None:
    """Share of the regions that hold the truth; None without any."""
    squares = [scan.scores[:, 3] for scan in scans if len(scan.scores)]
    return float(np.mean(np.concatenate(squares) < CHI2_95_OF_3)) if squares else None


def findings(rows: Sequence[Row]) -> list[str]:
    """False alarms and detections."""
    own, alike, unlike = rows
    return [
        f"an array's own calibration is doubted in {own['noticed']} of {own['scans']} scans.",
        f"a foreign one is noticed in {unlike['noticed']} of {unlike['scans']} scans where blur or stiffness is off by"
        f" more than a third, and in {alike['noticed']} of {alike['scans']} where the array is more alike.",
    ]


def draw_calibrations(scans: Sequence[ScoredScan], path: Path) -> None:
    """Blur and stiffness of the foreign arrays over the calibration's, by whether it was noticed."""
    title = "Arrays with the packaged calibration, which another array made: which of them the cell notices"
    foreign = [(differences(scan.seed), scan.noticed) for scan in scans if scan.array == FOREIGN]
    with picture(path, title, 3.6) as figure:
        axes: Any = figure.subplots()
        for noticed, colour, name in ((True, BLUE, "noticed"), (False, ORANGE, "not noticed")):
            points = np.array([ratios for ratios, found in foreign if found == noticed]).reshape(-1, 2)
            axes.scatter(*points.T, s=18, color=colour, label=name, marker="o" if noticed else "^")
        axes.axhline(1.0, color=INK, linewidth=0.8)
        axes.axvline(1.0, color=INK, linewidth=0.8)
        axes.set(xlabel="blur over the calibration's", ylabel="stiffness over the calibration's")
        legend(figure)
