"""Study `stability`: where the force loop settles, predicted and carried out, and how every other case ends.

The map goes over contact stiffness × force gain (`servo.surface_height_hz`) for pairs of servo rate and bus delay. Two
servos run on it: one that uses the stated stiffness, as the linear loop of `stability_runs` does ("told"), and the real
one, which estimates it ("felt"). Prediction: the largest eigenvalue over one period of the sensor; and the stiffness at
which the approach exceeds the force limit before the first sample of the touch is received. Beside the map there is one
line of cases each over the drives' bandwidth, poses near singular ones, radii of probe and object, and speed.

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
from matplotlib.lines import Line2D

from canprobe.cell.results.picture import AMBER, BLUE, GREY, INK, ORANGE, PINK, SKY, legend, log_scale, parts, picture
from canprobe.lab.studies.linear_loop import ForceLoop, spectral_radius
from canprobe.lab.studies.result import Column, Row, StudyResult, measuring_facts
from canprobe.lab.studies.stability_extremes import run_extremes
from canprobe.lab.studies.stability_runs import HUNTING_SPREAD, LoopCase, bent_touch, carry_out, loop_of
from canprobe.lab.studies.sweep import Sweep
from canprobe.mechanics.types import Floats

STIFFNESSES = (1e2, 1e3, 1e4, 2e4, 4e4, 6e4, 1e5, 1e6, 1e7)
GAINS_HZ = (2.0, 8.0, 25.0)
BUSES = ((400.0, 0.0), (400.0, 6.0), (400.0, 20.0), (200.0, 0.0), (100.0, 0.0), (1000.0, 0.0))
"""Servo rate (Hz) and delay (ms)."""
DRIVES_HZ = (3.0, 10.0, 30.0, 100.0, 300.0)
FIDELITIES = ("ideal", "dynamic")
REACHES_MM = (120.0, 128.0, 135.0, 171.5, 300.0, 350.0, 358.0, 400.0)
"""Distance of the touch from the first joint's axis: at 127 mm the shoulder is singular, at 360 mm the elbow."""
WRISTS_DEG = (0.0, 3.0, 10.0)
"""Joint 5 at the touch: at 0 the wrist is singular, and a scan passes through that place."""
RADII_MM = (1.0, 5.0, 40.0, 10_000.0)
SPEEDS_MM_S = (25.0, 50.0, 100.0, 250.0)
SCAN_S = 1.5
"""Duration of a scan: the curvature is known in its second half."""
_AT = (-120.0, -122.5, 374.0)
WIDE_PERCENT = 20.0
SOUND_ENDS = ("stable", "stopped", "approach", "refused")
MODEL = ("fieldbus", "mechanics", "cell", "lab/studies/stability_runs.py", "lab/studies/linear_loop.py")
COLUMNS = (
    Column("view", "view"),
    Column("contact_n_m", "contact N/m", ".0e"),
    Column("rate_hz", "servo Hz", ".0f"),
    Column("late_ms", "late ms", ".0f"),
    Column("height_hz", "gain Hz", ".0f"),
    Column("what", "what"),
    Column("eigenvalue", "|λ|", ".2f"),
    Column("ended", "ended"),
    Column("force_max_n", "max N", ".3g"),
    Column("above_ms", "above ms", ".0f"),
    Column("error_percent", "error %", ".0f"),
    Column("spread_percent", "spread %", ".0f"),
    Column("reason", "reason"),
)


def cases(quick: bool) -> list[LoopCase]:
    """All cells."""
    if quick:
        return _quick_cases()
    found = [_at(reach, speed) for reach, speed in product(REACHES_MM, (0.0, 25.0))]
    found += [bent_touch(wrist, speed, SCAN_S if speed else 0.4) for wrist, speed in product(WRISTS_DEG, (0.0, 25.0))]
    found += [_round(probe, radius) for probe, radius in product(RADII_MM, RADII_MM)]
    found += [LoopCase("speed", k, speed_mm_s=v, hold_s=SCAN_S) for v, k in product(SPEEDS_MM_S, (1e4, 4e4))]
    found += [
        LoopCase("drives", k, bandwidth_hz=b, fidelity=f) for b, f, k in product(DRIVES_HZ, FIDELITIES, (1e4, 1e6))
    ]
    grid = product(BUSES, GAINS_HZ, STIFFNESSES, (True, False))
    return found + [
        LoopCase("felt" if feels else "told", k, rate_hz=rate, late_ms=late, height_hz=gain, feels=feels)
        for (rate, late), gain, k, feels in grid
        if rate <= 400.0 or (gain == 8.0 and k == 1e4)
    ]


def _quick_cases() -> list[LoopCase]:
    """A case for each way to end."""
    return [
        LoopCase("told", 1e4, rate_hz=200.0, feels=False, hold_s=0.1),
        LoopCase("told", 1e7, feels=False),
        LoopCase("drives", 1e6, bandwidth_hz=3.0, fidelity="dynamic"),
        LoopCase("felt", 1e4, late_ms=20.0),
        LoopCase("felt", 1e4, rate_hz=1000.0),
        _round(10_000.0, 1.0),
        LoopCase("speed", 1e4, speed_mm_s=250.0),
    ]


def _at(reach_mm: float, speed_mm_s: float) -> LoopCase:
    """A touch at a distance from the first joint's axis, in the default direction."""
    share = reach_mm / math.hypot(*_AT[:2])
    at_mm = (_AT[0] * share, _AT[1] * share, _AT[2])
    return LoopCase("pose", 1e4, at_mm=at_mm, speed_mm_s=speed_mm_s, hold_s=SCAN_S if speed_mm_s else 0.4)


def _round(probe_mm: float, radius_mm: float) -> LoopCase:
    return LoopCase("radii", 1e4, probe_mm=probe_mm, kind="sphere", radius_mm=radius_mm)


def what_of(case: LoopCase) -> str:
    """The special parameters of a case, in words."""
    scan = " scan" if case.speed_mm_s else ""
    pose = f"{math.hypot(*case.at_mm[:2]):.0f} mm from axis 1" + scan
    if case.normal[2] != 1.0:
        wrist = min(WRISTS_DEG, key=lambda angle: abs(angle - case.posture_deg[4]))  # that is 1 deg above the touch
        pose = f"joint 5 at {wrist:g} deg{scan}"
    return {
        "drives": f"{case.bandwidth_hz:g} Hz {case.fidelity}",
        "pose": pose,
        "radii": f"probe {case.probe_mm:g} mm, object {case.radius_mm:g} mm",
        "speed": f"{case.speed_mm_s:g} mm/s",
    }.get(case.view, "")


def run(*, quick: bool, sweep: Sweep) -> StudyResult:
    """Carry out all cells beside each other, and predict them."""
    todo = cases(quick)
    sweep.say(f"{len(todo)} touches")
    rows = [row_of(case, answer) for case, answer in zip(todo, sweep.map(carry_out, todo, model=MODEL), strict=True)]
    facts = measuring_facts(quick, 1, MODEL)
    more = (run_extremes(quick=quick, sweep=sweep),)
    return StudyResult("stability", COLUMNS, rows, findings(rows), facts, partial(draw_stability, rows), more)


def row_of(case: LoopCase, answer: Row) -> Row:
    """The row of a cell: case, prediction, answer."""
    known = asdict(case)
    del known["at_mm"], known["normal"], known["posture_deg"]
    row = {"what": what_of(case), **known, "eigenvalue": spectral_radius(loop_of(case)), **answer}
    over = row["ended"] == "stopped" and "above the limit" in row["reason"]
    return row | {"ended": "approach"} if over and row["contact_n_m"] > approach_limit(row) else row


def approach_limit(row: Row, approach_m_s: float = 4e-3, force_max: float = 5.0) -> float:
    """Contact stiffness (N/m) from which the approach exceeds the force limit before it can be stopped.

    The sample of the touch is sent one frame later; a target takes two cycles and the drive's lag.
    """
    period, sample = 1.0 / row["rate_hz"], 1.0 / min(200.0, row["rate_hz"])
    late = 2.0 * math.floor(row["late_ms"] * 1e-3 / period + 1e-9) * period
    way = approach_m_s * (2.0 * sample + 3.0 * period + late)
    return float(2.0 * math.sqrt(force_max * row["force_n"]) / way)


def findings(rows: Sequence[Row]) -> list[str]:
    """Numbers of the ends, whether the prediction holds, and every cell that hunts or fails."""
    ends = Counter(str(row["ended"]) for row in rows)
    counted = ", ".join(f"{number} {END_MARKS[end][2]}" for end, number in ends.most_common())
    said = [f"{len(rows)} touches: {counted}."]
    told = [r for r in rows if r["view"] == "told" and r["ended"] != "refused" and r["contact_n_m"] >= 1e3]
    if told:
        settles = [r for r in told if r["eigenvalue"] < 1.0]
        right = sum(r["ended"] == "stable" for r in settles)
        not_settling = [r for r in told if r["eigenvalue"] >= 1.0]
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
    felt = [r for r in rows if r["view"] == "felt" and r["ended"] != "refused"]
    for name, group in (("stated", told), ("estimated", felt)):
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
    said += [f"{_named(r)}: {r['ended']}{_because(r)}" for r in other]
    if not other:
        said.append("Every touch is stable within limits, stopped safely with the reason, or refused by the plan.")
    elif any(r["ended"] == "hunting" for r in other):
        said.append(f"Hunting: the force's standard deviation is above {100 * HUNTING_SPREAD:.0f} % of the target.")
    return said


def _named(row: Row) -> str:
    what = f", {row['what']}" if row["what"] else ""
    return (
        f"{row['view']}, {row['contact_n_m']:.0e} N/m, {row['rate_hz']:.0f} Hz, {row['late_ms']:g} ms late, "
        f"gain {row['height_hz']:g} Hz{what}"
    )


def _because(row: Row) -> str:
    if row["ended"] == "hunting":
        return f", spread {row['spread_percent']:.0f} %, |λ| {row['eigenvalue']:.2f}"
    return f", {row['reason']}"


END_MARKS = {
    "stable": (BLUE, "o", "stable within limits"),
    "stopped": (AMBER, "s", "stopped safely"),
    "approach": (SKY, "s", "stopped at the touch, beyond the limit of the approach"),
    "refused": (GREY, "X", "refused by the plan"),
    "hunting": (PINK, "D", "force not settled"),
    "failed": (ORANGE, "v", "failed"),
}
"""Colour, marker and words for each end of a touch."""
VIEWS = {"told": "servo with the stated stiffness", "felt": "servo that estimates the stiffness"}
SIDES = {"drives": "bandwidth of the drives", "pose": "pose", "radii": "radii", "speed": "speed of a scan"}
PANELS_IN_A_ROW = 3


def draw_stability(rows: Sequence[Row], path: Path) -> None:
    """The map: a panel for each servo and bus; below, how the other cases end."""
    buses = list(dict.fromkeys((r["rate_hz"], r["late_ms"]) for r in rows if r["view"] in VIEWS))
    title = (
        "Where the force loop settles: predicted by its largest eigenvalue over one period of the sensor (shade;\n"
        "black line: 1, unstable to the right), and how touches ended that were carried out in lockstep (marks)\n"
        "dotted: from here on the approach at 4 mm/s exceeds the force limit before its first sample can stop it"
    )
    lines = -(-len(buses) // PANELS_IN_A_ROW)
    with picture(path, title, 4.3 + 1.75 * lines * len(VIEWS)) as figure:
        *maps, lower = parts(figure, len(VIEWS) + 1, 1, height_ratios=(*[1.75 * lines] * len(VIEWS), 3.2))
        stiffness = np.geomspace(70.0, 1.5e7, 40)
        for part, (view, words) in zip(maps, VIEWS.items(), strict=True):
            part.suptitle(words, x=0.01, ha="left", fontsize="medium", fontweight="bold")
            ratios = [loop_of(LoopCase(view, float(k), feels=view == "felt")).depth_ratio for k in stiffness]
            grid = part.subplots(lines, min(PANELS_IN_A_ROW, len(buses)), squeeze=False, sharex=True, sharey=True)
            for axes in grid.flat[len(buses) :]:
                axes.set_visible(False)
            for axes, (rate, late) in zip(grid.flat, buses, strict=False):
                mine = [r for r in rows if r["view"] == view and (r["rate_hz"], r["late_ms"]) == (rate, late)]
                _draw_map(axes, stiffness, ratios, loop_of(LoopCase(view, 1e4, rate_hz=rate, late_ms=late)), mine)
                axes.set_title(f"cycle of {rate:g} Hz" + (f", frames {late:g} ms late" if late else ""))
            for axes in grid[-1]:
                axes.set_xlabel("contact stiffness (N/m)")
            for line in grid:
                line[0].set_ylabel("force gain (Hz)")
        sides = {view: [r for r in rows if r["view"] == view] for view in SIDES}
        panels = lower.subplots(1, len(sides), squeeze=False)[0]
        for axes, (view, mine) in zip(panels, sides.items(), strict=True):
            _draw_side(axes, SIDES[view], mine)
        marks = [Line2D([], [], color=c, marker=m, linestyle="", label=words) for c, m, words in END_MARKS.values()]
        legend(lower, marks)


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
        _mark(axes, row, row["contact_n_m"], row["height_hz"])
    log_scale(axes, "xy")
    axes.set_yticks([2.0, 8.0, 25.0])
    axes.grid(visible=False)


def _mark(axes: Axes, row: Row, x: float, y: float) -> None:
    colour, marker, _ = END_MARKS[row["ended"]]
    axes.plot(x, y, marker, color=colour, markersize=6, markeredgecolor="white", markeredgewidth=0.5)


def _draw_side(axes: Axes, title: str, rows: Sequence[Row]) -> None:
    """Draw the ends of the cases of one line: a table with a mark for each."""
    places = [_place(r) for r in rows]
    lines, columns = (list(dict.fromkeys(names)) for names in zip(*places, strict=True)) if places else ([], [])
    for row, (line, column) in zip(rows, places, strict=True):
        _mark(axes, row, columns.index(column), lines.index(line))
    axes.set_yticks(range(len(lines)), lines)
    axes.set_xticks(range(len(columns)), columns, rotation=45, ha="right", rotation_mode="anchor")
    axes.set(title=title, xlim=(-0.6, len(columns) - 0.4), ylim=(max(len(lines), 1) - 0.5, -0.5))
    axes.spines["bottom"].set_visible(False)


def _place(row: Row) -> tuple[str, str]:
    """Line and column of a case in its table."""
    stiff = f"{row['contact_n_m']:.0e} N/m".replace("e+0", "e")
    return {
        "drives": (f"{row['bandwidth_hz']:g} Hz", f"{row['fidelity']}, {stiff}"),
        "pose": (row["what"].removesuffix(" scan"), "scan" if row["speed_mm_s"] else "press"),
        "radii": (f"probe {row['probe_mm']:g} mm", f"object {row['radius_mm']:g} mm"),
        "speed": (f"{row['speed_mm_s']:g} mm/s", stiff),
    }[row["view"]]  # fmt: skip
