"""The other half of study `workprec`: error of the whole cell against its computing time.

Each cell of the sweep is a scan of scene `cylinder` in lockstep: master, bus, emulated nodes and plant in one process.
Its cost is processor time per second of the scan; its errors are those of the estimated surface (curvature, normal) and
of the true force. What the plan refuses is a row with its reason, and is tried again with CAN FD for the taxels. The
drives use classical frames all the same: rates beyond a bus of 1 Mbit/s are scanned on a bus of 8 Mbit/s, which no CAN
has, for the effect of the rate alone.

The knee is the cheapest combination on a classical bus whose errors are all small enough (`ENOUGH`) and whose servo
holds the stiffest contact of the cell, 40 kN/m, in a scan of its own. Errors are means over scans with several seeds,
with their lowest and highest; the cost is that of the first, measured alone. The Cramér–Rao bound on the curvature is
that of 20 mm of path at the stated noise, for estimates without bias.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice, product
from time import process_time
from typing import Any

import numpy as np

from canprobe.api import run as run_scene
from canprobe.cell.planning.make import make_plan
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import PlantSettings, Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.tasks.probing import Phase
from canprobe.errors import PlanError, SafetyStop
from canprobe.lab.studies.no_bus import on_any_bitrate
from canprobe.lab.studies.result import Column, Row, StudyResult, measuring_facts
from canprobe.lab.studies.sweep import Sweep
from canprobe.lab.studies.workprec_cell_choice import (
    ENOUGH,
    FASTER,
    FD,
    FIDELITIES,
    MEASURES,
    REAL,
    default_of,
    good,
)
from canprobe.lab.studies.workprec_cell_figure import draw_cell
from canprobe.mechanics.touch.estimate.fit import METHODS

RATES_HZ = (100.0, 200.0, 400.0, 500.0, 1000.0, 2000.0)
MODES = ("features", "window", "image")
SENSOR_HZ = {500.0: 250.0}
"""Rate of the tactile frames where 200 Hz does not divide the servo's."""
SEEDS, QUICK_SEEDS = range(1, 6), range(1, 3)
FASTER_BITRATE = 8_000_000
STIFF_N_M3, STIFF_FORCE_PERCENT = 1.27e8 * (40.0 / 9.4) ** 2, 20.0
"""Layer of a contact of 40 kN/m at 2 N, and the force error that is small enough there."""
COLUMNS = (
    Column("rate_hz", "servo Hz", ".0f"),
    Column("mode", "sensor"),
    Column("bus", "bus"),
    Column("method", "estimator"),
    Column("fidelity", "plant"),
    Column("cost_ms_per_s", "ms a second", ".0f"),
    Column("curvature_percent", "curvature %", ".1f"),
    Column("curvature_percent_range", "of seeds"),
    Column("bound_percent", "bound %", ".1f"),
    Column("normal_deg", "normal deg", ".2f"),
    Column("normal_deg_range", "of seeds"),
    Column("force_percent", "force %", ".1f"),
    Column("force_percent_range", "of seeds"),
    Column("stiff", "40 kN/m"),
    Column("ended", "ended"),
    Column("reason", "why"),
)


@dataclass(frozen=True, slots=True)
class BusSetting:
    """Rate, mode of the sensor and bus."""

    rate_hz: float
    mode: str
    bus: str


@dataclass(frozen=True, slots=True)
class CellCase:
    """One scan."""

    setting: BusSetting
    method: str
    fidelity: str
    duration_s: float
    seed: int
    stiffness_n_m3: float | None = None


def run_cell(*, quick: bool, sweep: Sweep) -> StudyResult:
    """Plan every setting, and scan with those that fit, one scan at a time."""
    rates, modes = ((200.0, 500.0), MODES[1:2]) if quick else (RATES_HZ, MODES)
    methods = ("recursive",) if quick else METHODS
    why: dict[BusSetting, str | None] = {}
    for bus in (*REAL, FASTER):
        asked = [
            BusSetting(rate, mode, bus)
            for rate, mode in product(rates, modes)
            if all(why.get(BusSetting(rate, mode, other), "not asked") is not None for other in REAL)
            and (bus in REAL or mode != "image")
        ]
        why |= dict(zip(asked, sweep.map(refusal, asked), strict=True))
    fits = [s for s, reason in why.items() if reason is None]
    duration = 1.0 if quick else 2.0
    todo = [
        CellCase(s, method, fidelity, duration, 1)
        for s, method, fidelity in product(fits, methods, FIDELITIES)
        if s.bus in REAL or method == "recursive"
    ]
    sweep.say(f"{len(todo)} scans, timed one after another; {len(why) - len(fits)} settings are refused by the plan")
    timed = dict(zip(todo, sweep.time(measure, todo), strict=True))
    seeds = QUICK_SEEDS if quick else SEEDS
    others = [replace(case, seed=seed) for case in todo for seed in seeds[1:]]
    repeated = iter(sweep.map(measure, others))
    answers = {case: over_seeds([answer, *islice(repeated, len(seeds) - 1)]) for case, answer in timed.items()}
    stiff = [CellCase(s, "recursive", "ideal", duration, 1, STIFF_N_M3) for s in fits]
    held = {case.setting: holds(answer) for case, answer in zip(stiff, sweep.map(measure, stiff), strict=True)}
    rows = [
        _named(case.setting)
        | {"method": case.method, "fidelity": case.fidelity, "reason": ""}
        | answer
        | {"stiff": held[case.setting]}
        for case, answer in answers.items()
    ]
    rows += [
        {**_named(s), "method": "any", "fidelity": "any", "ended": "refused", "reason": reason}
        for s, reason in why.items()
        if reason is not None
    ]

    return StudyResult(
        "workprec_cell", COLUMNS, rows, findings(rows), measuring_facts(quick, len(seeds)), partial(draw_cell, rows)
    )


def scene_of(setting: BusSetting) -> Scene:
    """The scene with the default estimator and plant."""
    scene = load_scene("cylinder")
    assert scene.sensor is not None and scene.shape is not None
    rate = setting.rate_hz
    eds = "tactile_array_fd.eds" if setting.bus == FD else scene.sensor.eds
    sensor = replace(scene.sensor, mode=setting.mode, rate_hz=SENSOR_HZ.get(rate, min(rate, 200.0)), eds=eds)  # type: ignore[arg-type]
    scene = replace(
        scene,
        cycle=replace(scene.cycle, rate_hz=rate),
        sensor=sensor,
        bus=replace(scene.bus, fd=setting.bus == FD),
        shape=replace(scene.shape, also=()),
        task=replace(scene.task, clearance_mm=0.5),
    )
    return on_any_bitrate(scene, FASTER_BITRATE) if setting.bus == FASTER else scene


def refusal(setting: BusSetting) -> str | None:
    """The plan's reason to refuse a setting; None where it fits."""
    try:
        make_plan(resolve(scene_of(setting)))
    except PlanError as error:
        return str(error).splitlines()[0]
    return None


def measure(case: CellCase) -> dict[str, Any]:
    """Errors of a scan, and its cost in ms of processor time per second."""
    scene = scene_of(case.setting)
    assert scene.shape is not None
    scene = replace(
        scene,
        scene=replace(scene.scene, seed=case.seed),
        task=replace(scene.task, duration_s=case.duration_s),
        shape=replace(scene.shape, method=case.method),
        plant=replace(
            scene.plant or PlantSettings(),
            fidelity=case.fidelity,  # type: ignore[arg-type]
            stiffness_n_m3=case.stiffness_n_m3,
        ),
    )
    spent: list[float] = []
    try:
        result = run_scene(
            scene, files=False,
            observers=[lambda seen: spent.append(process_time()) if seen.measurement is not None else None],
        )  # fmt: skip
    except SafetyStop as stop:
        return {"ended": "stopped", "reason": stop.reason}
    scan = np.flatnonzero(result.log["phase"] == Phase.SCAN)
    seconds = float(result.log["t_s"][scan[-1]] - result.log["t_s"][scan[0]])
    shape, contact = result.summary["shape"], result.summary["contact"]
    return {
        "ended": "done",
        "cost_ms_per_s": 1e3 * (spent[scan[-1]] - spent[scan[0]]) / seconds,
        "curvature_percent": shape["kappa_rms_error_percent"],
        "bound_percent": shape["kappa_rms_error_percent"] / shape["cramer_rao_ratio"]
        if shape["cramer_rao_ratio"]
        else None,
        "normal_deg": shape["normal_rms_deg"],
        "force_percent": 100.0 * contact["force_rms_error_n"] / contact["force_target_n"],
    }


def over_seeds(answers: Sequence[Row]) -> Row:
    """One row of several scans: the first, with means of the errors, and their lowest and highest.

    A measure is None where one of the scans has none, for example because it was stopped.
    """
    row = {**answers[0], "seeds": len(answers)}
    if (stopped := [one for one in answers if one["ended"] != "done"]) and row["ended"] == "done":
        row["reason"] = f"{len(stopped)} of {len(answers)} seeds stopped: {stopped[0]['reason']}"
    for key in (*MEASURES, "bound_percent"):
        values = [one.get(key) for one in answers]
        known = None not in values
        row[key] = float(np.mean(values)) if known else None  # type: ignore[arg-type]
        row[f"{key}_low"], row[f"{key}_high"] = (min(values), max(values)) if known else (None, None)  # type: ignore[type-var]
        row[f"{key}_range"] = f"{row[f'{key}_low']:.2g}–{row[f'{key}_high']:.2g}" if known else ""
    return row


def holds(answer: Row) -> str:
    """Whether a scan of the stiffest contact keeps its force, in words."""
    if answer["ended"] != "done":
        return "stopped"
    error = answer["force_percent"]
    return "holds" if error <= STIFF_FORCE_PERCENT else f"force {error:.0f} %"


def _named(setting: BusSetting) -> Row:
    return {"rate_hz": setting.rate_hz, "mode": setting.mode, "bus": setting.bus}


def findings(rows: Sequence[Row]) -> list[str]:
    """The knee of each fidelity and the default beside it, the effect of rate and fidelity, stopped and refused."""
    said: list[str] = []
    for fidelity in FIDELITIES:
        best, mine = next(iter(good(rows, fidelity)), None), default_of(rows, fidelity)
        said.append(f"Plant {fidelity}: {_knee(best)}.")
        if mine is not None and mine is best:
            said.append("  It is the default.")
        elif mine is not None:
            times = f": {mine['cost_ms_per_s'] / best['cost_ms_per_s']:.1f} × that cost" if best else ""
            said.append(f"  It is not the default, {_text_of(mine)}{times if mine['ended'] == 'done' else ''}.")
            if best is not None and mine["ended"] == "done":
                real = " and ".join(_differ(best, mine)) or "none of the errors"
                said.append(f"  Beyond the spread of the seeds they differ in {real}.")
    return [*said, *_of_the_rate(rows), *_of_the_plant(rows), *_not_done(rows)]


def _knee(best: Row | None) -> str:
    limits = f"{ENOUGH['curvature_percent']:g} %, {ENOUGH['normal_deg']:g}° and {ENOUGH['force_percent']:g} %"
    if best is None:
        return f"no combination is within {limits} of curvature, normal and force and holds 40 kN/m"
    return (
        f"the knee, the cheapest on classical CAN within {limits} of curvature, normal and force whose servo also "
        f"holds a contact of 40 kN/m, is {_text_of(best)}"
    )


def _of_the_rate(rows: Sequence[Row]) -> list[str]:
    """Cost and errors over the servo's rate, for window and recursive on the ideal plant, on any bus."""
    told = []
    for rate in RATES_HZ:
        mine = [r for r in rows if (r["rate_hz"], r["mode"], r["method"], r["fidelity"])
                == (rate, "window", "recursive", "ideal") and r["ended"] == "done"]  # fmt: skip
        told += [
            f"{rate:.0f} Hz{'' if r['bus'] in REAL else ' (8 Mbit/s)'} {r['cost_ms_per_s']:.0f} ms a second, force "
            f"{r['force_percent']:.1f} %, curvature {r['curvature_percent']:.1f} %, 40 kN/m: {r['stiff']}"
            for r in mine
        ]
    if not told:
        return []
    return [f"Servo rate, window and recursive, ideal plant: {'; '.join(told)}."]


def _of_the_plant(rows: Sequence[Row]) -> list[str]:
    """Cost and errors with the dynamic plant over those with the ideal one."""
    key: Callable[[Row], tuple[Any, ...]] = lambda r: (r["rate_hz"], r["mode"], r["method"])  # noqa: E731
    done = {(*key(r), r["fidelity"]): r for r in rows if r["ended"] == "done"}
    pairs = [(r, done[*k[:3], "ideal"]) for k, r in done.items() if k[3] == "dynamic" and (*k[:3], "ideal") in done]
    if not pairs:
        return []
    shares = {m: [a[m] / b[m] for a, b in pairs if a[m] is not None and b[m]] for m in ("cost_ms_per_s", *MEASURES)}
    middle = {m: float(np.median(values)) for m, values in shares.items() if values}
    names = dict(zip(("cost_ms_per_s", *MEASURES), ("cost", "curvature", "normal", "force"), strict=True))
    told = ", ".join(f"{names[m]} {value:.2f} ×" for m, value in middle.items())
    return [f"The dynamic plant over the ideal one, median of {len(pairs)} pairs: {told}."]


def _not_done(rows: Sequence[Row]) -> list[str]:
    """The scans that were stopped and the settings that were refused; the reasons are in the table."""
    said = []
    stopped = [r for r in rows if r["ended"] == "stopped"]
    for fidelity in FIDELITIES:
        mine = sorted({(r["mode"], r["method"]) for r in stopped if r["fidelity"] == fidelity})
        count = sum(r["fidelity"] == fidelity for r in stopped)
        if mine:
            said.append(f"Stopped for safety, plant {fidelity}, {count} scans: {', '.join(map(' '.join, mine))}.")
    for bus in (*REAL, FASTER):
        refused = [f"{r['rate_hz']:.0f} Hz {r['mode']}" for r in rows if r["ended"] == "refused" and r["bus"] == bus]
        if refused:
            said.append(f"Refused by the plan, bus {bus}: {', '.join(refused)}.")
    return said


def _text_of(row: Row) -> str:
    what = f"{row['rate_hz']:.0f} Hz, {row['mode']}, {row['bus']}, {row['method']}"
    if row["ended"] != "done":
        return f"{what}, {row['ended']}: {row['reason']}"
    if any(row[m] is None for m in MEASURES):
        return f"{what}, {row['cost_ms_per_s']:.0f} ms a second, without an answer on the shape"
    return (
        f"{what}: {row['cost_ms_per_s']:.0f} ms a second for {row['curvature_percent']:.1f} % of curvature, "
        f"{row['normal_deg']:.2f}° of normal, {row['force_percent']:.1f} % of force"
    )


def _differ(one: Row, other: Row) -> list[str]:
    """The measures in which two rows differ by more than their seeds: the ranges do not overlap."""
    found = []
    for name in MEASURES:
        ends = [row.get(f"{name}_{end}") for row in (one, other) for end in ("low", "high")]
        if None not in ends:
            low, high, other_low, other_high = (float(end) for end in ends if end is not None)
            if high < other_low or other_high < low:
                found.append(name.split("_")[0])
    return found
