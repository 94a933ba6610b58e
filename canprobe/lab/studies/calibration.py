"""Study `calibration`: how well forty touches calibrate an unknown array, and whether a foreign one is noticed.

Arrays are drawn at random: stiffness of the layer, full scale, blur, crosstalk, hysteresis, creep, gains. Three tables:

- `calibration`: each array is touched as `canprobe calibrate array` touches it (`array_presses`). Then quadrics with
  curvatures, forces, places and dwell times by chance are pressed on it, and its calibration says what they are.
- `calibration_forces`: quadrics are held for 8, 20 or 60 s with forces from 0.5 to 3 N, while the contact rolls over
  the pad; an array reads them in its order, as the cell does, each from rest. A second counts with its mean force,
  measured and true. Each array is read with its own calibration, and with that of another array drawn at random, which
  was made for a make (`--make`) and states the spread of one.
- `calibrations`: scenes of study `regions`, of every kind of surface but rough ones, are scanned. Half of the arrays
  have their own calibration, where each notice is a false alarm; the others have the packaged one. Some of these happen
  to be much like the array that it was made on, and do no harm unnoticed: arrays count apart whose blur or layer is off
  by more than a third.

Settings of calibration and force come from draw 0, limits of the check from draws 1 and 2; `DRAWS` were only looked at.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from canprobe.cell.results.picture import BLUE, INK, picture
from canprobe.cell.scene.calibrations import load_calibration
from canprobe.cell.scene.resolve import EMULATED_ARRAY
from canprobe.lab.studies.array_presses import WINDOW, Presses, calibrated, pad_of, random_array
from canprobe.lab.studies.figure import draw_points
from canprobe.lab.studies.random_scenes import FOREIGN, KINDS, SceneSeed, own_array
from canprobe.lab.studies.region_scores import ScoredScan, held_share
from canprobe.lab.studies.region_scores import measure as measure_scan
from canprobe.lab.studies.regions import MODEL as SCAN_MODEL
from canprobe.lab.studies.result import Row, StudyResult, measuring_facts
from canprobe.lab.studies.sweep import Sweep
from canprobe.mechanics.touch.array_calibration.parameter_fit import curvature_errors, moment_errors
from canprobe.mechanics.touch.array_calibration.touches import Dwell, what_is_shown
from canprobe.mechanics.touch.image.calibration import ArrayCalibration
from canprobe.mechanics.touch.image.force_errors import UPPER_SIGMAS
from canprobe.mechanics.touch.image.force_reading import ForceReading
from canprobe.mechanics.touch.image.image_model import make_image_model, make_patch_calibration
from canprobe.mechanics.touch.image.patch import PatchCalibration, compute_patch
from canprobe.mechanics.touch.linear_algebra import rms
from canprobe.mechanics.touch.pad import Pad
from canprobe.mechanics.types import Floats

DRAWS = {"arrays": 1, "scenes": 3}
"""Draws of the published figures."""
FIRST_ARRAY, ARRAYS, QUICK_ARRAYS = 100, 20, 2
"""Seed of the first array of draw 0, and number of arrays of a draw."""
OTHER_ARRAY_SEED_STEP = 10_000
"""Distance of the seed of the array whose calibration is taken for that of a make."""
PRESSES, HOLDS = 20, 6
SCANS, QUICK_SCANS = 24, 3
"""Number of scans with own calibrations, and with foreign ones."""
FAR_RATIO = 4.0 / 3.0
"""Ratio of blur or stiffness to the calibration's beyond which an array is unlike the one of its calibration."""
SMOOTH_KINDS = tuple(kind for kind in KINDS if kind not in (FOREIGN, "rough"))
GROUPS = ("own", "make")
SCAN_GROUPS = ("own", "foreign, alike", "foreign, unlike")
GOALS = {"force_percent": 2.0, "stiffness_percent": 3.0, "curvature_percent": 5.0}
MODEL = ("mechanics/touch", "cell/plant", "lab/studies/calibration.py", "lab/studies/array_presses.py")
COLUMNS = (
    "array", "full_scale_kpa", "stiffness_n_m3", "blur", "crosstalk", "left_out", "force_percent", "stiffness_percent",
    "by_depth_percent", "moments_percent", "curvature_percent",
)  # fmt: skip
FORCE_COLUMNS = (
    "array", "calibration", "creep_percent", "creep_found_percent", "seconds", "uncorrected_percent", "error_percent",
    "stated_percent", "within_percent", "bound_percent",
)  # fmt: skip


def run(*, quick: bool, sweep: Sweep, draw: int | None = None) -> StudyResult:
    """Calibrate arrays, press on them and hold them; then scan with arrays that have foreign calibrations."""
    first = FIRST_ARRAY + ARRAYS * (DRAWS["arrays"] if draw is None else draw)
    seeds = list(range(first, first + (QUICK_ARRAYS if quick else ARRAYS)))
    sweep.say(f"{len(seeds)} arrays: seeds {seeds[0]} to {seeds[-1]}")
    rows: list[Row] = list(sweep.map(measure, seeds, model=MODEL))
    forces = [row for each in sweep.map(measure_forces, seeds, model=MODEL) for row in each]
    facts = measuring_facts(quick, len(seeds), MODEL)
    drawn = partial(
        draw_points, forces, ("error_percent", "error, %"), ("stated_percent", "stated, %"), by="calibration",
        title="Force of emulated arrays drawn at random: stated standard deviation against the error of seconds, RMS",
        lines=((1.0, "stated = error"), (2.0, "goal: twice the error")),
    )  # fmt: skip
    more = (
        StudyResult("calibration_forces", forces, force_findings(forces), facts, drawn, FORCE_COLUMNS),
        run_scans(quick=quick, sweep=sweep, draw=DRAWS["scenes"] if draw is None else draw),
    )
    return StudyResult("calibration", rows, findings(rows), facts, partial(draw_arrays, rows), COLUMNS, more)


def measure(seed: int) -> Row:
    """Calibrate one array and press on it."""
    presses = Presses(*random_array(seed))
    config, stiffness, pad = presses.config, presses.stiffness, pad_of(presses.config)
    fit = calibrated(presses, f"emulated, seed {seed}")
    found = fit.calibration
    patch = make_patch_calibration(found, pad)
    model = make_image_model(found, patch, seen=WINDOW)
    plain = PatchCalibration(pad, gains=found.gains)
    forces, curvatures, moments = [], [], []
    for _ in range(PRESSES):
        dwell = presses.by_chance()
        shown = what_is_shown(dwell, plain)
        force = patch.force_gain * shown.total + patch.edge_gain * math.sqrt(shown.total)
        assert dwell.force is not None
        if not shown.usable or model.trust((dwell.kappa[0], 0.0, dwell.kappa[1]), force) < 1.0:
            continue
        forces.append(force / dwell.force - 1.0)
        curvatures.append(curvature_errors(model, [shown], [force])[0])
        moments.append(moment_errors(model, [shown], [force])[0, :2])
    return {
        "array": seed,
        "full_scale_kpa": 1e-3 * config.full_scale_pa,
        "stiffness_n_m3": stiffness,
        "blur": config.blur_pitch,
        "crosstalk": config.crosstalk,
        "left_out": fit.left_out,
        "force_percent": 100.0 * rms(np.array(forces)),
        "stiffness_percent": 100.0 * (found.stiffness.moments / stiffness - 1.0),
        "by_depth_percent": 100.0 * (found.stiffness.depth / stiffness - 1.0),
        "moments_percent": 100.0 * rms(np.array(moments)),
        "curvature_percent": 100.0 * rms(np.array(curvatures)),
    }


def measure_forces(seed: int) -> list[Row]:
    """Hold quadrics on one array, and read their forces with its own calibration and with another one: two rows."""
    presses, other = (Presses(*random_array(number)) for number in (seed, seed + OTHER_ARRAY_SEED_STEP))
    fits = calibrated(presses, f"emulated, seed {seed}"), calibrated(other, "make", own_gains=False)
    holds = [presses.held() for _ in range(HOLDS)]
    return [
        {
            "array": seed,
            "calibration": group,
            "creep_percent": 100.0 * presses.config.creep_per_decade,
            "creep_found_percent": 100.0 * fit.calibration.force.creep,
            **score_holds(fit.calibration, pad_of(presses.config), holds),
        }
        for group, fit in zip(GROUPS, fits, strict=True)
    ]


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
    """RMS over the arrays, beside the goals."""
    return [
        f"{key.removesuffix('_percent')}: RMS {rms(errors):.1f} % over {len(rows)} arrays, worst"
        f" {np.abs(errors).max():.1f} %, goal {goal:g} %."
        for key, goal in GOALS.items()
        for errors in [np.array([row[key] for row in rows])]
    ]


def force_findings(rows: Sequence[Row]) -> list[str]:
    """Each group beside the goals: 95 % of seconds within 2σ, and σ at most twice the error."""
    lines = []
    for group, of in zip(GROUPS, ("its own calibration", "that of another array, for the make"), strict=True):
        mine = [row for row in rows if row["calibration"] == group]
        n = np.array([row["seconds"] for row in mine], dtype=float)
        raw, error, stated = (
            math.sqrt(float(np.average([row[key] ** 2 for row in mine], weights=n)))
            for key in ("uncorrected_percent", "error_percent", "stated_percent")
        )
        within = float(np.average([row["within_percent"] for row in mine], weights=n))
        ratios = [row["stated_percent"] / row["error_percent"] for row in mine]
        mean = math.exp(float(np.mean(np.log(ratios))))
        lines.append(
            f"force with {of}: {within:.1f} % of {n.sum():.0f} seconds within 2σ, goal 95 %; error {error:.2f} % RMS"
            f" ({raw:.2f} % without the correction of creep), stated {stated:.2f} %; stated over error of an array:"
            f" {mean:.2f} (geometric mean), {min(ratios):.2f} to {max(ratios):.2f}, goal at most 2."
        )
    return lines


def draw_arrays(rows: Sequence[Row], path: Path) -> None:
    """The three errors of each array beside their goals."""
    title = (
        "What a calibration by forty touches leaves: error of each of some emulated arrays, drawn at random; line: goal"
    )
    with picture(path, title, 3.6) as figure:
        for axes, (key, goal) in zip(figure.subplots(1, 3), GOALS.items(), strict=True):
            axes.bar([str(row["array"]) for row in rows], [abs(row[key]) for row in rows], color=BLUE)
            axes.axhline(goal, color=INK, linewidth=0.8)
            axes.set(title=key.removesuffix("_percent"), ylabel="%", xlabel="array")
            axes.tick_params(axis="x", rotation=90)
            axes.grid(visible=False, axis="x")


def run_scans(*, quick: bool, sweep: Sweep, draw: int) -> StudyResult:
    """Scan scenes of a draw, and count those whose cell doubts the calibration."""
    number = QUICK_SCANS if quick else SCANS
    kinds = len(SMOOTH_KINDS)
    seeds = [SceneSeed(draw, SMOOTH_KINDS[i % kinds], 1 + 3 * (i // kinds)).value() for i in range(number)]
    seeds += [SceneSeed(draw, FOREIGN, i).value() for i in range(number)]
    sweep.say(f"{len(seeds)} scans, draw {draw}")
    scans = [ScoredScan.of(answer) for answer in sweep.map(measure_scan, seeds, model=SCAN_MODEL)]
    scans = [scan for scan in scans if not scan.ended.startswith("refused")]
    rows = [scan_row(group, [scan for scan in scans if group_of(scan) == group]) for group in SCAN_GROUPS]
    facts = measuring_facts(quick, len(scans), SCAN_MODEL) | {"draw": draw}
    marks = [
        dict(zip(("blur", "stiffness"), differences(scan.seed), strict=True))
        | {"noticed": "noticed" if scan.noticed else "not noticed"}
        for scan in scans
        if scan.array == FOREIGN
    ]
    drawn = partial(
        draw_points, marks, ("blur", "blur over the calibration's"), ("stiffness", "stiffness over the calibration's"),
        by="noticed", title="Arrays with the packaged calibration, which another one made: which of them are noticed",
    )  # fmt: skip
    return StudyResult("calibrations", rows, scan_findings(rows), facts, drawn)


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


def scan_row(group: str, scans: Sequence[ScoredScan]) -> Row:
    """One row of the table of scans."""
    noticed = [scan for scan in scans if scan.noticed]
    return {
        "calibration": group,
        "scans": len(scans),
        "noticed": len(noticed),
        "coverage": held_share(scans),
        "coverage_noticed": held_share(noticed),
    }


def scan_findings(rows: Sequence[Row]) -> list[str]:
    """False alarms and detections."""
    own, alike, unlike = rows
    return [
        f"an array's own calibration is doubted in {own['noticed']} of {own['scans']} scans.",
        f"a foreign one is noticed in {unlike['noticed']} of {unlike['scans']} scans where blur or stiffness is off by"
        f" more than a third, and in {alike['noticed']} of {alike['scans']} where the array is more alike.",
    ]
