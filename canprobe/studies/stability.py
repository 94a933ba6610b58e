"""Study `stability`: where the force loop settles, predicted and carried out, and how every other case ends.

The map goes over contact stiffness × force gain (`servo.surface_height_hz`) for pairs of servo rate and bus delay. Two
servos are run on it: one that believes the stiffness it was told, as the linear loop of `stability_loop` does, and the
real one that feels it. Prediction: the largest eigenvalue over one period of the sensor; and the stiffness at which the
approach, still going on until the first sample of the touch is in, has gone over the force limit. Beside the map, one
line of cases each over the drives' bandwidth, poses near singular ones, radii of probe and object, and speed.

The stiffness is that of the contact at the wanted force, `dF/dδ = 2F/δ`; the layer that is really there is chosen to
have it. Cases go beyond what a scene file may say (1e5…1e12 N/m³): what is not refused there is run here.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.studies.stability_loop import spectral_radius
from canprobe.studies.stability_runs import HUNTING, Case, carry_out, loop_of, touch_in_posture
from canprobe.studies.study import Column, StudyResult
from canprobe.studies.study_files import measuring_facts
from canprobe.studies.sweep import Sweep

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
"""Of a scan: in the second half of it the curvature is known."""
_AT = (-120.0, -122.5, 374.0)
WIDE_PERCENT = 20.0
ENDS = ("stable", "stopped", "refused")
MODEL = ("bus", "cell", "emulator", "planning", "robot", "touch", "studies/stability_runs.py",
         "studies/late_node.py")  # fmt: skip
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


def cases(quick: bool) -> list[Case]:
    """All cells."""
    if quick:
        return _quick_cases()
    found = [_at(reach, speed) for reach, speed in product(REACHES_MM, (0.0, 25.0))]
    found += [_bent(wrist, speed) for wrist, speed in product(WRISTS_DEG, (0.0, 25.0))]
    found += [_round(probe, radius) for probe, radius in product(RADII_MM, RADII_MM)]
    found += [Case("speed", k, speed_mm_s=v, hold_s=SCAN_S) for v, k in product(SPEEDS_MM_S, (1e4, 4e4))]
    found += [Case("drives", k, bandwidth_hz=b, fidelity=f) for b, f, k in product(DRIVES_HZ, FIDELITIES, (1e4, 1e6))]
    grid = product(BUSES, GAINS_HZ, STIFFNESSES, (True, False))
    return found + [
        Case("felt" if feels else "told", k, rate_hz=rate, late_ms=late, height_hz=gain, feels=feels)
        for (rate, late), gain, k, feels in grid
        if rate <= 400.0 or (gain == 8.0 and k == 1e4)
    ]


def _quick_cases() -> list[Case]:
    """One of every way to end."""
    return [
        Case("told", 1e4, rate_hz=200.0, feels=False, hold_s=0.1),
        Case("told", 1e7, feels=False),
        Case("drives", 1e6, bandwidth_hz=3.0, fidelity="dynamic"),
        Case("felt", 1e4, late_ms=20.0),
        Case("felt", 1e4, rate_hz=1000.0),
        _round(10_000.0, 1.0),
        Case("speed", 1e4, speed_mm_s=250.0),
    ]


def _at(reach_mm: float, speed_mm_s: float) -> Case:
    """A touch that far from the first joint's axis, in the default direction."""
    share = reach_mm / math.hypot(*_AT[:2])
    at_mm = (_AT[0] * share, _AT[1] * share, _AT[2])
    return Case("pose", 1e4, at_mm=at_mm, speed_mm_s=speed_mm_s, hold_s=SCAN_S if speed_mm_s else 0.4)


def _bent(wrist_deg: float, speed_mm_s: float) -> Case:
    """A touch of a gently curved object in front of the arm, with the wrist bent by so much."""
    at_mm, normal, posture_deg = touch_in_posture((90.0, 65.0, 15.0, -360.0, wrist_deg, 0.0))
    return Case(
        "pose", 1e4, at_mm=at_mm, normal=normal, posture_deg=posture_deg, kind="sphere", radius_mm=300.0,
        speed_mm_s=speed_mm_s, hold_s=SCAN_S if speed_mm_s else 0.4,
    )  # fmt: skip


def _round(probe_mm: float, radius_mm: float) -> Case:
    return Case("radii", 1e4, probe_mm=probe_mm, kind="sphere", radius_mm=radius_mm)


def what_of(case: Case) -> str:
    """What is special about a case, in words."""
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

    def draw(path: Path) -> None:
        from canprobe.studies.stability_figure import draw_stability

        draw_stability(rows, path)

    return StudyResult("stability", COLUMNS, rows, findings(rows), measuring_facts(quick, 1, MODEL), draw)


def row_of(case: Case, answer: dict[str, Any]) -> dict[str, Any]:
    """The row of a cell: case, prediction, answer."""
    known = asdict(case)
    del known["at_mm"], known["normal"], known["posture_deg"]
    return {"what": what_of(case), **known, "eigenvalue": spectral_radius(loop_of(case)), **answer}


def approach_limit(row: dict[str, Any], approach_m_s: float = 4e-3, force_max: float = 5.0) -> float:
    """Contact stiffness (N/m) from which the approach goes over the force limit before it can be told to stop.

    The sample of the touch is taken, sent one frame later and taken in; a target takes two cycles and the drive's lag.
    """
    period, sample = 1.0 / row["rate_hz"], 1.0 / min(200.0, row["rate_hz"])
    late = 2.0 * math.floor(row["late_ms"] * 1e-3 / period + 1e-9) * period
    way = approach_m_s * (2.0 * sample + 3.0 * period + late)
    return float(2.0 * math.sqrt(force_max * row["force_n"]) / way)


def findings(rows: Sequence[dict[str, Any]]) -> list[str]:
    """How the cells end, whether the prediction holds, and every cell that ends in no way that it may."""
    ends = Counter(str(row["ended"]) for row in rows)
    said = [f"{len(rows)} touches: " + ", ".join(f"{number} {end}" for end, number in ends.most_common()) + "."]
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
            f"Servo that believes what it was told, from 1e+03 N/m up: of {len(settles)} touches whose eigenvalues lie "
            f"inside the unit circle {right} are stable, {unheard} heard no image in time, {over} went over the force "
            f"limit at the touch itself; of {len(not_settling)} outside {wrong} are not stable; {early} of "
            "these are beyond the approach's own limit, and tell nothing about the loop."
        )
    felt = [r for r in rows if r["view"] == "felt" and r["ended"] != "refused"]
    for name, group in (("believes what it was told", told), ("feels the stiffness", felt)):
        stable = [r["contact_n_m"] for r in group if r["ended"] == "stable"]
        if stable:
            said.append(f"The servo that {name} is stable from {min(stable):.0e} to {max(stable):.0e} N/m at best.")
    kept = [r["error_percent"] for r in rows if r["ended"] == "stable" and r["error_percent"] is not None]
    if kept:
        wide = sum(error > WIDE_PERCENT for error in kept)
        said.append(
            f"Stable touches err by {np.median(kept):.0f} % of the wanted force (median, RMS); {wide} of {len(kept)} "
            f"by more than {WIDE_PERCENT:.0f} %: stable says that the force settles within its limit, no more."
        )
    longest = max((r for r in rows if r["above_ms"] is not None), key=lambda r: r["above_ms"], default=None)
    if longest is not None:
        said.append(
            f"Longest time above the force limit: {longest['above_ms']:.0f} ms, allowed {longest['allowed_ms']:.0f} ms "
            f"(stated reaction, twice the delay, and 100 ms for the retreat)."
        )
    other = [r for r in rows if r["ended"] not in ENDS]
    said += [f"{_named(r)}: {r['ended']}{_because(r)}" for r in other]
    if not other:
        said.append("Every touch is stable within limits, stopped safely with the reason, or refused by the plan.")
    elif any(r["ended"] == "hunting" for r in other):
        said.append(f"Hunting: the force's standard deviation is above {100 * HUNTING:.0f} % of the target.")
    return said


def _named(row: dict[str, Any]) -> str:
    what = f", {row['what']}" if row["what"] else ""
    return (
        f"{row['view']}, {row['contact_n_m']:.0e} N/m, {row['rate_hz']:.0f} Hz, {row['late_ms']:g} ms late, "
        f"gain {row['height_hz']:g} Hz{what}"
    )


def _because(row: dict[str, Any]) -> str:
    if row["ended"] == "hunting":
        return f", spread {row['spread_percent']:.0f} %, |λ| {row['eigenvalue']:.2f}"
    return f", {row['reason']}"
