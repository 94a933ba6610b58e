"""Study `estimators`: error against run time for every estimator, window, lag and noise; and, in `bound`, the bound.

A probe moves along a weave at 25 mm/s, 200 tactile frames a second; after 60 mm the answer is scored at the last
contact. Costs are measured apart from errors: all estimators take turns at eight frames and an answer (40 ms of the
loop), garbage collector off, medians over the turns without the first. They are processor times: other work of the
machine has little influence.
"""

from __future__ import annotations

import gc
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from time import process_time

import numpy as np
from matplotlib.axes import Axes

from canprobe.cell.results.picture import INK, METHOD_COLOURS, SHADE, legend, log_scale, picture
from canprobe.lab.studies.bound import run_bound
from canprobe.lab.studies.ground import Ground, make_ground
from canprobe.lab.studies.result import FROBENIUS, Row, StudyResult, mean_and_interval, measuring_facts, sigma_values
from canprobe.lab.studies.sweep import Sweep
from canprobe.mechanics.touch import ContactSample, Estimator, cramer_rao, make_estimator
from canprobe.mechanics.touch.tangent_frames import homogeneous, tangent_rotation
from canprobe.mechanics.types import Floats

STEP_M, FRAME_US, SHARE = 0.125e-3, 5000.0, 8
"""Path between two frames, time between them, frames between two answers of the loop."""
SAMPLES, PROBE_M = 480, 0.040
WINDOWS, LAGS = (40, 80, 160, 320), (1, 5, 10, 20)
NOISES = ((5e-6, 2e-4), (20e-6, 1e-3), (50e-6, 3e-3))
GROUNDS = (("ellipsoid", 0.05), ("cylinder", 0.036))
WAVES = 5
"""Waves of the weave on the whole path: one on 12 mm of it."""
Noise = tuple[float, float]
Place = tuple[str, float]
REFERENCE = ("chen1996", 160, 10)
MODEL = ("mechanics/touch", "lab/studies/estimators.py", "lab/studies/ground.py")
COLUMNS = (
    "surface", "method", "window_samples", "lag_samples", "sigma_point_um", "sigma_normal_mrad", "error_percent",
    "error_low_percent", "error_high_percent", "bound_percent", "observed", "add_us", "answer_us", "sample_us",
    "ratio_to_chen1996", "in_budget",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class EstimatorSetting:
    """One estimator of the study; the window of `recursive` is its memory."""

    method: str
    window: int
    lag: int | None = None

    def make(self, sigma_point: float, sigma_normal: float) -> Estimator:
        """Make the estimator."""
        return make_estimator(
            self.method, sigma_point=sigma_point, sigma_normal=sigma_normal, memory_m=self.window * STEP_M,
            window=self.window, lag=self.lag or 10,
        )  # fmt: skip


def settings(quick: bool = False) -> list[EstimatorSetting]:
    """Settings of every method and window, with lags below half a window."""
    windows, lags = ((40, 160), (10,)) if quick else (WINDOWS, LAGS)
    found = [EstimatorSetting(m, w) for m in ("chord", "ml", "recursive") for w in windows]
    return [EstimatorSetting("chen1996", w, lag) for w in windows for lag in lags if 2 * lag < w] + found


def run(*, quick: bool, sweep: Sweep) -> StudyResult:
    """Measure costs, then errors, then errors over the bound."""
    seeds, turns = (3, 4) if quick else (24, 20)
    grounds = GROUNDS[:1] if quick else GROUNDS
    sweep.say(f"costs of {len(settings(quick))} settings at {len(NOISES)} noises, one after another")
    costs = sweep.time(measure_costs, [(noise, quick, turns) for noise in NOISES], model=MODEL)
    sweep.say(f"errors on {len(grounds)} surface{'s' * (len(grounds) != 1)}, {seeds} seeds each")
    cells = [(place, noise, quick, seed) for noise in NOISES for place in grounds for seed in range(seeds)]
    errors = iter(sweep.map(measure_errors, cells, model=MODEL))
    rows = []
    for noise, times in zip(NOISES, costs, strict=True):
        for name, size in grounds:
            ground, by_seed = on_the_move(name, size), [next(errors) for _ in range(seeds)]
            found = zip(settings(quick), times, zip(*by_seed, strict=True), strict=True)
            rows += [_row(name, ground, noise, *one) for one in found]
    facts = measuring_facts(quick, seeds, MODEL) | {"turns": turns}
    said, more = findings(rows), (run_bound(quick=quick, sweep=sweep),)
    return StudyResult("estimators", rows, said, facts, partial(draw_estimators, rows), COLUMNS, more)


def on_the_move(surface: str, size: float) -> Ground:
    """The weave of the study over a surface."""
    return make_ground(surface, size, "weave", SAMPLES * STEP_M, SAMPLES, waves=WAVES)


def contacts(points: Floats, normals: Floats, first: int = 0) -> list[ContactSample]:
    """Contacts of a probe whose pole follows the normal."""
    pole = np.array([0.0, 0.0, PROBE_M])
    return [
        ContactSample(0.005 * i, p, n, homogeneous(tangent_rotation(-n), p + PROBE_M * n), pole, 1.0)
        for i, (p, n) in enumerate(zip(points, normals, strict=True), first)
    ]


def measure_errors(cell: tuple[Place, Noise, bool, int]) -> list[Floats | None]:
    """Error (3,) of K of each setting, of one seed; None where not all of K was observed."""
    (name, size), noise, quick, seed = cell
    ground = on_the_move(name, size)
    samples = contacts(*ground.measured(*noise, np.random.default_rng([seed, round(noise[0] * 1e9)])))
    errors: list[Floats | None] = []
    for setting in settings(quick):
        estimator = setting.make(*noise)
        for sample in samples if setting.method == "recursive" else samples[-setting.window :]:
            estimator.add(sample)
        answer = estimator.estimate()
        seen = answer is not None and answer.rank == 3
        errors.append(ground.error(answer.T_frame_contact, answer.K) if answer is not None and seen else None)
    return errors


def measure_costs(cell: tuple[Noise, bool, int]) -> list[list[tuple[float, float]]]:
    """Times of one `add` and of one answer by setting and turn, µs; the settings take turns."""
    noise, quick, turns = cell
    ground = on_the_move(*GROUNDS[0])
    estimators = [s.make(*noise) for s in settings(quick)]
    samples = contacts(*ground.measured(*noise, np.random.default_rng(99)))
    for estimator in estimators:
        for sample in samples:
            estimator.add(sample)
    times: list[list[tuple[float, float]]] = [[] for _ in estimators]
    points, normals = ground.measured(*noise, np.random.default_rng(100))  # the path again, back from its end
    back = -2 - np.arange(SHARE * (turns + 1)) % (SAMPLES - 2)
    more = contacts(points[back], normals[back], first=SAMPLES)
    gc.collect()
    gc.disable()
    try:
        for turn in range(turns + 1):
            block = more[SHARE * turn : SHARE * (turn + 1)]
            for mine, estimator in zip(times, estimators, strict=True):
                mine.append(_timed(estimator, block))
    finally:
        gc.enable()
    return [mine[1:] for mine in times]


def _timed(estimator: Estimator, block: Sequence[ContactSample]) -> tuple[float, float]:
    start = process_time()
    for sample in block:
        estimator.add(sample)
    added = process_time()
    estimator.estimate()
    return (added - start) / len(block) * 1e6, (process_time() - added) * 1e6


def _row(  # noqa: PLR0917 - one row of a table
    surface: str,
    ground: Ground,
    noise: Noise,
    setting: EstimatorSetting,
    times: Sequence[tuple[float, float]],
    errors: Sequence[Floats | None],
) -> Row:
    size = float(np.linalg.norm(ground.K))
    # the filter's memory fades, it has no window: its bound is that of all samples
    last = slice(None if setting.method == "recursive" else -setting.window, None)
    C = cramer_rao(
        ground.points[last], ground.normals[last], ground.surface, sigma_point=noise[0], sigma_normal=noise[1]
    )
    squares = np.array([np.square(e) @ FROBENIUS for e in errors if e is not None])
    add, answer = (median(column) for column in zip(*times, strict=True))
    per_sample = [t[0] + t[1] / SHARE for t in times]
    return {
        "surface": surface,
        "method": setting.method,
        "window_samples": setting.window,
        "lag_samples": setting.lag,
        **sigma_values(*noise),
        **{f"{key}_percent": 100.0 * math.sqrt(v) / size for key, v in mean_and_interval("error", squares).items()},
        "bound_percent": 100.0 * math.sqrt(float(FROBENIUS @ np.diag(C))) / size,
        "observed": len(squares) / len(errors),
        "add_us": add,
        "answer_us": answer,
        "sample_us": median(per_sample),
        "spread_us": float(np.subtract(*np.percentile(per_sample, [75, 25]))),
        "in_budget": add + answer <= FRAME_US,
    }


def findings(rows: Sequence[Row]) -> list[str]:
    """Ratios to `chen1996`, written into the rows, and the sentences that follow from the table."""
    by = {(r["surface"], r["sigma_point_um"], r["method"], r["window_samples"], r["lag_samples"]): r for r in rows}
    for r in rows:
        reference = by[r["surface"], r["sigma_point_um"], *REFERENCE]
        r["ratio_to_chen1996"] = r["sample_us"] / reference["sample_us"]
    said = [
        "the bound is that of the nine-parameter model and the window; of recursive, whose memory fades, of all 480 "
        "samples. chord and chen1996 take |∇f| for constant: on a cylinder that is true and worth information.",
        "chen1996 of the ratios: 160 samples, lag 10; error: RMS of ‖K − K_true‖ over ‖K_true‖.",
    ]
    for sigma_point, sigma_normal in NOISES:
        key = (GROUNDS[0][0], sigma_point * 1e6)
        ml, filtered = by[*key, "ml", 160, None], by[*key, "recursive", 160, None]
        said.append(
            f"at {sigma_point * 1e6:.0f} µm, {sigma_normal * 1e3:.1f} mrad: recursive {filtered['sample_us']:.0f} µs a "
            f"sample = 1/{ml['answer_us'] / filtered['sample_us']:.0f} of an answer of ml over 160 samples "
            f"({ml['answer_us']:.0f} µs), its error {filtered['error_percent'] / ml['error_percent']:.2f} × that of ml."
        )
    return said


BUDGET_MS = 5.0
LAG_STYLES: Mapping[int | None, str] = {1: ":", 5: "-.", 10: "--", 20: "-"}


def draw_estimators(rows: Sequence[Row], path: Path) -> None:
    """Error over the time of a frame with an answer: a row of panels for each surface, a column for each noise."""
    surfaces = list(dict.fromkeys(r["surface"] for r in rows))
    noises = list(dict.fromkeys((r["sigma_point_um"], r["sigma_normal_mrad"]) for r in rows))
    title = (
        "Error of local curvature against the time of one tactile frame with an answer; lower left is better\n"
        "bars: 95 % of the draws of seeds anew; where two do not overlap, the difference is real\n"
        "marker size: window of 40, 80, 160, 320 samples (5–40 mm of path); no marker: not observed\n"
        "dotted: Cramér–Rao bound of each window, and of all 480 samples (the memory of recursive fades)\n"
        "lag: samples between the two of a difference"
    )
    with picture(path, title, 1.3 + 2.9 * len(surfaces)) as figure:
        grid = figure.subplots(len(surfaces), len(noises), squeeze=False, sharex=True, sharey=True)
        for surface, line in zip(surfaces, grid, strict=True):
            of_surface = [r for r in rows if r["surface"] == surface]
            for (point, normal), axes in zip(noises, line, strict=True):
                _draw_panel(axes, [r for r in of_surface if r["sigma_point_um"] == point])
                axes.set(title=f"{surface}, σ {point:.0f} µm, {normal:.1f} mrad", ylabel="RMS error of K (%)")
                axes.set_xlabel("time of a frame with an answer (ms)")
                axes.label_outer()
        legend(figure)


def _draw_panel(axes: Axes, rows: Sequence[Row]) -> None:
    for method, lag in dict.fromkeys((r["method"], r["lag_samples"]) for r in rows):
        line = [r for r in rows if r["method"] == method and r["lag_samples"] == lag]
        colour = METHOD_COLOURS[method]
        x = [(r["add_us"] + r["answer_us"]) * 1e-3 for r in line]
        y, low, high = (np.array([r[f"error{end}_percent"] for r in line]) for end in ("", "_low", "_high"))
        label = method if lag is None else f"{method}, lag {lag}"
        axes.plot(x, y, LAG_STYLES.get(lag, "-"), color=colour, alpha=0.8, label=label)
        axes.errorbar(x, y, yerr=(y - low, high - y), fmt="none", ecolor=colour, elinewidth=0.9)
        axes.scatter(x, y, s=[12.0 * r["window_samples"] / 40 for r in line], color=colour, zorder=3, linewidths=0)
    for r in rows:
        if r["method"] == "ml":
            _draw_bound(axes, r["bound_percent"], str(r["window_samples"]))
    _draw_bound(axes, next(r["bound_percent"] for r in rows if r["method"] == "recursive"), "all 480")
    axes.axvspan(BUDGET_MS, 1e3, color=SHADE, linewidth=0, zorder=0)
    axes.axvline(BUDGET_MS, color=INK, label="budget of a tactile frame, 5 ms")
    log_scale(axes, "xy")
    axes.set_xlim(0.2, 200.0)


def _draw_bound(axes: Axes, percent: float, text: str) -> None:
    axes.axhline(percent, color=INK, linewidth=0.8, linestyle=":", label="Cramér–Rao bound")
    axes.annotate(
        text, (0.0, percent), xycoords=("axes fraction", "data"), textcoords="offset points", xytext=(3, 2),
        fontsize="small",
    )  # fmt: skip
