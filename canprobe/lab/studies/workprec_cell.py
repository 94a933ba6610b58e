"""Part of study `workprec`: error of the whole cell against its computing time.

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

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice, product
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from canprobe.api import run as run_scene
from canprobe.cell.planning.make import make_plan
from canprobe.cell.results.picture import FAINT, INK, METHOD_COLOURS, legend, log_scale, picture
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import PlantSettings, Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.tasks.probing import Phase
from canprobe.errors import PlanError, SafetyStop
from canprobe.lab.studies.no_bus import on_any_bitrate
from canprobe.lab.studies.result import Column, Row, StudyResult, measuring_facts
from canprobe.lab.studies.sweep import Sweep
from canprobe.mechanics.touch.estimate.fit import METHODS

RATES_HZ = (100.0, 200.0, 400.0, 500.0, 1000.0, 2000.0)
MODES = ("features", "window", "image")
SENSOR_HZ = {500.0: 250.0}
"""Rate of the tactile frames where 200 Hz does not divide the servo's."""
FIDELITIES = ("ideal", "dynamic")
CLASSICAL, FD, FASTER = "classical", "FD", "8 Mbit/s"
REAL, FASTER_BITRATE = (CLASSICAL, FD), 8_000_000
SEEDS, QUICK_SEEDS = range(1, 6), range(1, 3)
ENOUGH = {"curvature_percent": 2.0, "normal_deg": 0.2, "force_percent": 6.0}
"""Small enough errors: the goal of the servo's force at 25 mm/s; shape and normal assumed."""
MEASURES = tuple(ENOUGH)
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
    Column("bound_percent", "bound %", ".1f"),
    Column("normal_deg", "normal deg", ".2f"),
    Column("force_percent", "force %", ".1f"),
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

    def row(self) -> Row:
        """Its columns."""
        return {"rate_hz": self.rate_hz, "mode": self.mode, "bus": self.bus}


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
    duration, seeds = (1.0, QUICK_SEEDS) if quick else (2.0, SEEDS)
    todo = [
        CellCase(s, method, fidelity, duration, seeds[0])
        for s, method, fidelity in product(fits, methods, FIDELITIES)
        if s.bus in REAL or method == "recursive"
    ]
    sweep.say(f"{len(todo)} scans, timed one after another; {len(why) - len(fits)} settings are refused by the plan")
    timed = sweep.time(measure, todo)
    others = iter(sweep.map(measure, [replace(case, seed=seed) for case in todo for seed in seeds[1:]]))
    stiff = [CellCase(s, "recursive", "ideal", duration, seeds[0], STIFF_N_M3) for s in fits]
    held = {case.setting: holds(answer) for case, answer in zip(stiff, sweep.map(measure, stiff), strict=True)}
    rows = [
        case.setting.row()
        | {"method": case.method, "fidelity": case.fidelity, "stiff": held[case.setting], "reason": ""}
        | over_seeds([answer, *islice(others, len(seeds) - 1)])
        for case, answer in zip(todo, timed, strict=True)
    ]
    rows += [
        setting.row() | {"method": "any", "fidelity": "any", "ended": "refused", "reason": reason}
        for setting, reason in why.items()
        if reason is not None
    ]
    facts = measuring_facts(quick, len(seeds))
    return StudyResult("workprec_cell", COLUMNS, rows, findings(rows), facts, partial(draw_cell, rows))


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
    plant = replace(
        scene.plant or PlantSettings(),
        fidelity=case.fidelity,  # type: ignore[arg-type]
        stiffness_n_m3=case.stiffness_n_m3,
    )
    scene = replace(
        scene,
        scene=replace(scene.scene, seed=case.seed),
        task=replace(scene.task, duration_s=case.duration_s),
        shape=replace(scene.shape, method=case.method),
        plant=plant,
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
    curvature, ratio = shape["kappa_rms_error_percent"], shape["cramer_rao_ratio"]
    return {
        "ended": "done",
        "cost_ms_per_s": 1e3 * (spent[scan[-1]] - spent[scan[0]]) / seconds,
        "curvature_percent": curvature,
        "bound_percent": curvature / ratio if ratio else None,
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
        known = [one[key] for one in answers if one.get(key) is not None]
        whole = len(known) == len(answers)
        found = (float(np.mean(known)), min(known), max(known)) if whole else (None, None, None)
        row |= dict(zip((key, f"{key}_low", f"{key}_high"), found, strict=True))
    return row


def holds(answer: Row) -> str:
    """Whether a scan of the stiffest contact keeps its force, in words."""
    if answer["ended"] != "done":
        return "stopped"
    error = answer["force_percent"]
    return "holds" if error <= STIFF_FORCE_PERCENT else f"force {error:.0f} %"


def good(rows: Iterable[Row], fidelity: str) -> list[Row]:
    """The rows of a fidelity on a classical bus that are good enough, the cheapest first."""
    found = [
        r
        for r in rows
        if r["fidelity"] == fidelity and r["bus"] == CLASSICAL and r["stiff"] == "holds"
        and all(r.get(m) is not None and r[m] <= most for m, most in ENOUGH.items())
    ]  # fmt: skip
    return sorted(found, key=lambda r: float(r["cost_ms_per_s"]))


def default_of(rows: Iterable[Row], fidelity: str) -> Row | None:
    """The row of the defaults of scene `cylinder`, on a plant of a fidelity."""
    scene = load_scene("cylinder")
    assert scene.sensor is not None and scene.shape is not None
    mine = scene.cycle.rate_hz, scene.sensor.mode, scene.shape.method, fidelity
    return next((r for r in rows if (r["rate_hz"], r["mode"], r["method"], r["fidelity"]) == mine), None)


def findings(rows: Sequence[Row]) -> list[str]:
    """The knee of each fidelity and the default beside it, the effect of rate and fidelity, and what was stopped."""
    limits = f"{ENOUGH['curvature_percent']:g} %, {ENOUGH['normal_deg']:g}° and {ENOUGH['force_percent']:g} %"
    said: list[str] = []
    for fidelity in FIDELITIES:
        best, mine = next(iter(good(rows, fidelity)), None), default_of(rows, fidelity)
        said.append(
            f"Plant {fidelity}: cheapest on classical CAN within {limits} of curvature, normal and force whose servo"
            f" also holds a contact of 40 kN/m: {'none' if best is None else _text_of(best)}."
        )
        if mine is not None:
            said.append("  It is the default." if mine is best else f"  The default: {_text_of(mine)}.")
    of_rate = [
        f"{r['rate_hz']:.0f} Hz{'' if r['bus'] in REAL else ' (8 Mbit/s)'} {r['cost_ms_per_s']:.0f} ms a second, force "
        f"{r['force_percent']:.1f} %, curvature {r['curvature_percent']:.1f} %, 40 kN/m: {r['stiff']}"
        for r in rows
        if (r["mode"], r["method"], r["fidelity"], r["ended"]) == ("window", "recursive", "ideal", "done")
    ]
    if of_rate:
        said.append(f"Servo rate, window and recursive, ideal plant: {'; '.join(of_rate)}.")
    ended = {how: sum(r["ended"] == how for r in rows) for how in ("stopped", "refused")}
    said.append(
        f"{ended['stopped']} scans were stopped for safety, {ended['refused']} settings refused by the plan; the table"
        " has the reasons."
    )
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


MARKS = {"features": "^", "window": "o", "image": "s"}
MARK_AREAS = dict(zip(RATES_HZ, (14.0, 34.0, 72.0, 90.0, 140.0, 210.0), strict=True))
LABELS = ("curvature error (%)", "normal error (deg)", "force error (%)")


def draw_cell(rows: Sequence[Row], path: Path) -> None:
    """Error against cost: a row of panels for each measure, a column for each fidelity."""
    refused, stopped = (sum(r["ended"] == how for r in rows) for how in ("refused", "stopped"))
    title = (
        "Whole cell, all in one process: error over the processor time that a second of a scan takes; best lower left\n"
        "a mark: rate, what the array sends, estimator and bus; ring: the default; star: cheapest that is good enough\n"
        "bars: lowest to highest of the seeds; short lines: Cramér–Rao bound, which only the curvature has\n"
        f"not drawn: {refused} settings that the plan refuses, {stopped} scans that were stopped for safety"
    )
    with picture(path, title, 9.6) as figure:
        grid = figure.subplots(len(MEASURES), len(FIDELITIES), squeeze=False, sharex=True, sharey="row")
        for key, label, line in zip(MEASURES, LABELS, grid, strict=True):
            for fidelity, axes in zip(FIDELITIES, line, strict=True):
                _draw(axes, rows, key, fidelity)
            line[0].set_ylabel(label)
        for fidelity, top, bottom in zip(FIDELITIES, grid[0], grid[-1], strict=True):
            top.set_title(f"{fidelity} plant")
            bottom.set_xlabel("processor time a second (ms)")
        legend(figure, _keys([r for r in rows if r["ended"] == "done"]))


def _draw(axes: Axes, rows: Sequence[Row], key: str, fidelity: str) -> None:
    for r in (r for r in rows if r["fidelity"] == fidelity and r.get(key) is not None):
        x, colour = r["cost_ms_per_s"], METHOD_COLOURS[r["method"]]
        filled = {CLASSICAL: colour, FASTER: FAINT}.get(r["bus"], "none")
        axes.scatter(
            x, r[key], s=MARK_AREAS[r["rate_hz"]], marker=MARKS[r["mode"]], facecolor=filled, edgecolor=colour,
            linewidth=1.2, zorder=3,
        )  # fmt: skip
        axes.vlines(x, r[f"{key}_low"], r[f"{key}_high"], color=colour, linewidth=0.9)
        if key == "curvature_percent" and r["bound_percent"] is not None:
            axes.scatter(x, r["bound_percent"], marker="_", s=30.0, color=INK, linewidth=0.9)
    chosen = ((default_of(rows, fidelity), "o", 260.0), (next(iter(good(rows, fidelity)), None), "*", 420.0))
    for row, mark, size in chosen:
        if row is not None and row.get(key) is not None:
            place = row["cost_ms_per_s"], row[key]
            axes.scatter(*place, s=size, marker=mark, facecolor="none", edgecolor=INK, linewidth=1.4)
    axes.margins(0.12)
    log_scale(axes, "xy")


def _keys(done: Sequence[Row]) -> list[Line2D]:
    """Colours, marks and sizes that occur."""

    def dot(label: str, colour: str = INK, mark: str = "o", size: float = 7.0, face: str | None = None) -> Line2D:
        return Line2D(
            [], [], linestyle="none", marker=mark, color=colour, markerfacecolor=face or colour, markersize=size,
            label=label,
        )  # fmt: skip

    seen = {key: {r.get(key) for r in done} for key in ("method", "mode", "rate_hz", "bus")}
    return [
        *(dot(method, colour) for method, colour in METHOD_COLOURS.items() if method in seen["method"]),
        *(dot(mode, mark=mark) for mode, mark in MARKS.items() if mode in seen["mode"]),
        *(dot(f"{rate:.0f} Hz", size=area**0.5) for rate, area in MARK_AREAS.items() if rate in seen["rate_hz"]),
        dot("Cramér–Rao bound", mark="_"),
        *(dot("CAN FD", face="white") for _ in seen["bus"] & {FD}),
        *(dot("8 Mbit/s, no CAN", face=FAINT) for _ in seen["bus"] & {FASTER}),
    ]
