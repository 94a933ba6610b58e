"""Study `stability`: where the force loop settles, predicted and carried out; and how extreme cases end.

The map goes over contact stiffness × force gain (`servo.surface_height_hz`) for pairs of servo rate and bus delay. Two
servos run on it: one that uses the stated stiffness, as the linear loop of `stability_runs` does, and the real one,
which estimates it. Prediction: the largest eigenvalue over one period of the sensor; and the stiffness at
which the approach exceeds the force limit before the first sample of the touch is received. A second table has
extreme cases (`stability_extremes`).

The stiffness is that of the contact at the wanted force, `dF/dδ = 2F/δ`; the true layer is chosen for it. Cases go
beyond the limits of a scene file (1e5…1e12 N/m³).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from canprobe.cell.results.picture import AMBER, BLUE, GREY, INK, ORANGE, PINK, SKY, legend, log_scale, parts, picture
from canprobe.lab.studies.linear_loop import ForceLoop, spectral_radius
from canprobe.lab.studies.result import Row, StudyResult, measuring_facts
from canprobe.lab.studies.stability_extremes import end_marks, run_extremes
from canprobe.lab.studies.stability_runs import FORCE_N, HUNTING_SPREAD, LoopCase, carry_out, loop_of
from canprobe.lab.studies.sweep import Sweep
from canprobe.mechanics.types import Floats

STIFFNESSES = (1e2, 1e3, 1e4, 2e4, 4e4, 6e4, 1e5, 1e6, 1e7)
GAINS_HZ = (2.0, 8.0, 25.0)
BUSES = ((400.0, 0.0), (400.0, 6.0), (400.0, 20.0), (200.0, 0.0), (100.0, 0.0), (1000.0, 0.0))
"""Servo rate (Hz) and delay (ms)."""
SERVOS = {"stated": "servo with the stated stiffness", "estimated": "servo that estimates the stiffness"}
WIDE_PERCENT = 20.0
SOUND_ENDS = ("stable", "stopped", "approach", "refused")
MODEL = ("fieldbus", "mechanics", "cell", "lab/studies/stability_runs.py", "lab/studies/linear_loop.py")
COLUMNS = (
    "servo", "contact_n_m", "rate_hz", "late_ms", "height_hz", "eigenvalue", "ended", "force_max_n", "above_ms",
    "error_percent", "spread_percent", "reason",
)  # fmt: skip


def cases(quick: bool) -> list[LoopCase]:
    """All cells; quick: a case for each way to end."""
    if quick:
        return [
            LoopCase(1e4, "stated", rate_hz=200.0, hold_s=0.1),
            LoopCase(1e7, "stated"),
            LoopCase(1e4, late_ms=20.0),
            LoopCase(1e4, rate_hz=1000.0),
        ]
    grid = product(BUSES, GAINS_HZ, STIFFNESSES, reversed(SERVOS))
    return [
        LoopCase(k, servo, rate, late, gain)
        for (rate, late), gain, k, servo in grid
        if rate <= 400.0 or (gain == 8.0 and k == 1e4)
    ]


def run(*, quick: bool, sweep: Sweep) -> StudyResult:
    """Carry out all cells beside each other, and predict them."""
    todo = cases(quick)
    sweep.say(f"{len(todo)} touches")
    rows = [row_of(case, answer) for case, answer in zip(todo, sweep.map(carry_out, todo, model=MODEL), strict=True)]
    facts = measuring_facts(quick, 1, MODEL)
    more = (run_extremes(quick=quick, sweep=sweep),)
    return StudyResult("stability", rows, findings(rows), facts, partial(draw_stability, rows), COLUMNS, more)


def row_of(case: LoopCase, answer: Row) -> Row:
    """The row of a cell: case, prediction, answer."""
    row = {**asdict(case), "eigenvalue": spectral_radius(loop_of(case)), **answer}
    over = row["ended"] == "stopped" and "above the limit" in row["reason"]
    return row | {"ended": "approach"} if over and row["contact_n_m"] > approach_limit(row) else row


def approach_limit(row: Row, approach_m_s: float = 4e-3, force_max: float = 5.0) -> float:
    """Contact stiffness (N/m) from which the approach exceeds the force limit before it can be stopped.

    The sample of the touch is sent one frame later; a target takes two cycles and the drive's lag.
    """
    period, sample = 1.0 / row["rate_hz"], 1.0 / min(200.0, row["rate_hz"])
    late = 2.0 * math.floor(row["late_ms"] * 1e-3 / period + 1e-9) * period
    way = approach_m_s * (2.0 * sample + 3.0 * period + late)
    return float(2.0 * math.sqrt(force_max * FORCE_N) / way)


def findings(rows: Sequence[Row]) -> list[str]:
    """Numbers of the ends, whether the prediction holds, and every cell that hunts or fails."""
    ends = Counter(str(row["ended"]) for row in rows)
    counted = ", ".join(f"{number} {END_MARKS[end][2]}" for end, number in ends.most_common())
    said = [f"{len(rows)} touches: {counted}."]
    stated = [r for r in rows if r["servo"] == "stated" and r["ended"] != "refused" and r["contact_n_m"] >= 1e3]
    if stated:
        settles = [r for r in stated if r["eigenvalue"] < 1.0]
        right = sum(r["ended"] == "stable" for r in settles)
        not_settling = [r for r in stated if r["eigenvalue"] >= 1.0]
        unheard = sum("no tactile frame" in r["reason"] for r in settles)
        over = sum("above the limit" in r["reason"] for r in settles)
        wrong = sum(r["ended"] != "stable" for r in not_settling)
        early = sum(r["ended"] != "stable" and r["contact_n_m"] > approach_limit(r) for r in not_settling)
        said.append(
            f"Servo with the stated stiffness, from 1e+03 N/m up: of {len(settles)} touches whose eigenvalues lie "
            f"inside the unit circle {right} are stable, {unheard} received no image in time, {over} exceeded the "
            f"force limit at the touch itself; of {len(not_settling)} outside {wrong} are not stable; {early} of "
            "these are beyond the limit of the approach, and say nothing about the loop."
        )
    estimated = [r for r in rows if r["servo"] == "estimated" and r["ended"] != "refused"]
    for name, group in (("stated", stated), ("estimated", estimated)):
        stable = [r["contact_n_m"] for r in group if r["ended"] == "stable"]
        if stable:
            span = f"{min(stable):.0e} to {max(stable):.0e} N/m"
            said.append(f"The servo with the {name} stiffness is stable from {span} at best.")
    kept = [r["error_percent"] for r in rows if r["ended"] == "stable" and r["error_percent"] is not None]
    if kept:
        wide = sum(error > WIDE_PERCENT for error in kept)
        said.append(
            f"Stable touches err by {np.median(kept):.0f} % of the wanted force (median, RMS); {wide} of {len(kept)} "
            f"by more than {WIDE_PERCENT:.0f} %: stable means only that the force settles within its limit."
        )
    longest = max((r for r in rows if r["above_ms"] is not None), key=lambda r: r["above_ms"], default=None)
    if longest is not None:
        said.append(
            f"Longest time above the force limit: {longest['above_ms']:.0f} ms, allowed {longest['allowed_ms']:.0f} ms "
            f"(stated reaction, twice the delay, and 100 ms for the retreat)."
        )
    other = [r for r in rows if r["ended"] not in SOUND_ENDS]
    for r in other:
        hunts = f"spread {r['spread_percent']:.0f} %, |λ| {r['eigenvalue']:.2f}" if r["ended"] == "hunting" else ""
        said.append(
            f"{r['servo']}, {r['contact_n_m']:.0e} N/m, {r['rate_hz']:.0f} Hz, {r['late_ms']:g} ms late, gain"
            f" {r['height_hz']:g} Hz: {r['ended']}, {hunts or r['reason']}"
        )
    if not other:
        said.append("Every touch is stable within limits, stopped safely with the reason, or refused by the plan.")
    elif any(r["ended"] == "hunting" for r in other):
        said.append(f"Hunting: the force's standard deviation is above {100 * HUNTING_SPREAD:.0f} % of the target.")
    return said


END_MARKS = {
    "stable": (BLUE, "o", "stable within limits"),
    "stopped": (AMBER, "s", "stopped safely"),
    "approach": (SKY, "s", "stopped at the touch, beyond the limit of the approach"),
    "refused": (GREY, "X", "refused by the plan"),
    "hunting": (PINK, "D", "force not settled"),
    "failed": (ORANGE, "v", "failed"),
}
"""Colour, marker and words for each end of a touch."""
PANELS_IN_A_ROW = 3


def draw_stability(rows: Sequence[Row], path: Path) -> None:
    """The map: a panel for each servo and bus."""
    buses = list(dict.fromkeys((r["rate_hz"], r["late_ms"]) for r in rows))
    title = (
        "Where the force loop settles: predicted by its largest eigenvalue over one period of the sensor (shade;\n"
        "black line: 1, unstable to the right), and how touches ended that were carried out in lockstep (marks)\n"
        "dotted: from here on the approach at 4 mm/s exceeds the force limit before its first sample can stop it"
    )
    lines = -(-len(buses) // PANELS_IN_A_ROW)
    with picture(path, title, 1.3 + 1.75 * lines * len(SERVOS)) as figure:
        stiffness = np.geomspace(70.0, 1.5e7, 40)
        for part, (servo, words) in zip(parts(figure, len(SERVOS), 1), SERVOS.items(), strict=True):
            part.suptitle(words, x=0.01, ha="left", fontsize="medium", fontweight="bold")
            ratios = [loop_of(LoopCase(float(k), servo)).depth_ratio for k in stiffness]
            grid = part.subplots(lines, min(PANELS_IN_A_ROW, len(buses)), squeeze=False, sharex=True, sharey=True)
            for axes in grid.flat[len(buses) :]:
                axes.set_visible(False)
            for axes, (rate, late) in zip(grid.flat, buses, strict=False):
                mine = [r for r in rows if (r["servo"], r["rate_hz"], r["late_ms"]) == (servo, rate, late)]
                _draw_map(axes, stiffness, ratios, loop_of(LoopCase(1e4, rate_hz=rate, late_ms=late)), mine)
                axes.set_title(f"cycle of {rate:g} Hz" + (f", frames {late:g} ms late" if late else ""))
                axes.set(xlabel="contact stiffness (N/m)", ylabel="force gain (Hz)")
                axes.label_outer()
        legend(part, end_marks(END_MARKS))


def _draw_map(axes: Axes, stiffness: Floats, ratios: Sequence[float], bus: ForceLoop, rows: Sequence[Row]) -> None:
    """One panel of the map."""
    gains = np.geomspace(1.5, 70.0, 20)
    radius = [
        [spectral_radius(replace(bus, depth_ratio=ratio, height_hz=float(gain))) for ratio in ratios] for gain in gains
    ]
    axes.contourf(stiffness, gains, radius, levels=np.linspace(0.0, 2.0, 11), cmap="Greys", alpha=0.35, extend="both")
    axes.contour(stiffness, gains, radius, levels=[1.0], colors=INK, linewidths=1.6)
    if rows:
        axes.axvline(approach_limit(rows[0]), color=INK, linestyle=":", linewidth=1.2)
    for row in rows:
        colour, marker, _ = END_MARKS[row["ended"]]
        place = row["contact_n_m"], row["height_hz"]
        axes.plot(*place, marker, color=colour, markersize=6, markeredgecolor="white", markeredgewidth=0.5)
    log_scale(axes, "xy")
    axes.set_yticks([2.0, 8.0, 25.0])
    axes.grid(visible=False)
