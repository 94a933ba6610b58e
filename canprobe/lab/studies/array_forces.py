"""Part of study `arrays`: whether the force of an array is within what it states, second by second.

Quadrics by chance are held for 8, 20 or 60 s with forces from 0.5 to 3 N, the contact rolling over the pad meanwhile;
an array reads them in its order, as the cell does, each from rest. A second counts with its mean force, measured and
true. Two groups: each array with its own calibration, and with that of another array drawn at random, which was made
for a make (`--make`) and states the spread of one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.cell.results.picture import BLUE, INK, ORANGE, legend, picture
from canprobe.lab.studies.result import Column, Row, StudyResult
from canprobe.mechanics.touch.linear_algebra import rms
from canprobe.mechanics.touch.pad import Pad
from canprobe.mechanics.touch.patch.array_calibration import ArrayCalibration
from canprobe.mechanics.touch.patch.array_models import make_patch_calibration
from canprobe.mechanics.touch.patch.force_errors import UPPER_SIGMAS
from canprobe.mechanics.touch.patch.force_reading import ForceReading
from canprobe.mechanics.touch.patch.image import compute_patch
from canprobe.mechanics.touch.patch.image_fit import Dwell
from canprobe.mechanics.types import Floats

HOLDS, HOLD_S = 6, (8.0, 20.0, 60.0)
GROUPS = ("own", "make")
COLUMNS = (
    Column("array", "array"),
    Column("calibration", "calibration"),
    Column("creep_percent", "creep % a decade", ".1f"),
    Column("creep_found_percent", "found", ".1f"),
    Column("seconds", "seconds"),
    Column("uncorrected_percent", "error with creep %", ".2f"),
    Column("error_percent", "error %", ".2f"),
    Column("stated_percent", "stated σ %", ".2f"),
    Column("within_percent", "within 2σ %", ".1f"),
    Column("bound_percent", "lower bound only %", ".1f"),
)


def score_holds(
    calibration: ArrayCalibration, pad: Pad, holds: Sequence[tuple[Dwell, Floats]]
) -> dict[str, float | int]:
    """Error of the force, and what was stated, over the seconds of some holds.

    Args:
        calibration: calibration to read them with.
        pad: taxels of the array.
        holds: touches, each with the (n,) true forces of its images, N.
    """
    patch = make_patch_calibration(calibration, pad)
    seconds: list[tuple[float, float, float]] = []
    bounds = 0
    for dwell, true in holds:
        reading, rows = ForceReading(patch), []
        assert dwell.windows is not None
        for t, image, window in zip(dwell.t_s.tolist(), dwell.images, dwell.windows, strict=True):
            shown = compute_patch(image, patch, window)
            found = reading.step(t, shown)
            rows.append((shown.force, found.force, found.sigma.total))
        each, number = np.array(rows), np.floor(dwell.t_s).astype(int)
        for k in range(number[-1]):
            shown_n, force, sigma = each[number == k].mean(axis=0).tolist()
            mean = float(true[number == k].mean())
            if math.isfinite(sigma):
                seconds.append((shown_n / mean - 1.0, force / mean - 1.0, sigma / mean))
            else:
                bounds += 1
    raw, error, stated = np.array(seconds).T
    return {
        "seconds": len(seconds),
        "uncorrected_percent": 100.0 * rms(raw),
        "error_percent": 100.0 * rms(error),
        "stated_percent": 100.0 * rms(stated),
        "within_percent": 100.0 * float(np.mean(np.abs(error) <= UPPER_SIGMAS * stated)),
        "bound_percent": 100.0 * bounds / (bounds + len(seconds)),
    }


def findings(rows: Sequence[Row]) -> list[str]:
    """Each group beside the goals: 95 % of seconds within 2σ, and σ at most twice the error."""
    lines = []
    for group in GROUPS:
        mine = [row for row in rows if row["calibration"] == group]
        n = np.array([row["seconds"] for row in mine], dtype=float)
        raw, error, stated = (
            math.sqrt(float(np.average([row[key] ** 2 for row in mine], weights=n)))
            for key in ("uncorrected_percent", "error_percent", "stated_percent")
        )
        within = float(np.average([row["within_percent"] for row in mine], weights=n))
        ratios = [row["stated_percent"] / row["error_percent"] for row in mine]
        mean = math.exp(float(np.mean(np.log(ratios))))
        of = "its own calibration" if group == "own" else "that of another array, for the make"
        lines.append(
            f"force with {of}: {within:.1f} % of {n.sum():.0f} seconds within 2σ, goal 95 %; error {error:.2f} % RMS"
            f" ({raw:.2f} % without the correction of creep), stated {stated:.2f} %; stated over error of an array:"
            f" {mean:.2f} (geometric mean), {min(ratios):.2f} to {max(ratios):.2f}, goal at most 2."
        )
    return lines


def result_of(rows: Sequence[Row], facts: dict[str, Any]) -> StudyResult:
    """The table of the forces, with its findings and picture."""
    return StudyResult("array-forces", COLUMNS, rows, findings(rows), facts, partial(draw_forces, rows))


def draw_forces(rows: Sequence[Row], path: Path) -> None:
    """Stated standard deviation against the error of each array."""
    title = "Force of emulated arrays drawn at random: stated standard deviation against the error of seconds, RMS"
    with picture(path, title, 3.6) as figure:
        axes = figure.subplots()
        for group, colour in zip(GROUPS, (BLUE, ORANGE), strict=True):
            mine = [row for row in rows if row["calibration"] == group]
            errors, stated = ([row[key] for row in mine] for key in ("error_percent", "stated_percent"))
            axes.scatter(errors, stated, s=14, color=colour, label=f"{group} calibration")
        most = max(max(row["error_percent"], row["stated_percent"]) for row in rows)
        axes.plot([0.0, most], [0.0, most], color=INK, linewidth=0.8, label="stated = error")
        axes.plot(
            [0.0, 0.5 * most], [0.0, most], color=INK, linewidth=0.8, linestyle=":", label="goal: twice the error"
        )
        axes.set(xlabel="error, %", ylabel="stated, %")
        legend(figure)
