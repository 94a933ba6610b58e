"""Study `workprec`: what the dynamic plant's integrators cost and how wrong they are, over steps and stiffness.

Each cell integrates the same sliding contact (`workprec_trial`) and is compared with scipy's Radau at rtol 1e-10, at
which nothing is held. `held` cells keep mass matrix, bias and contact geometry over a cycle of 2.5 ms, as the plant
does; the others evaluate them in every call. Where both have the same error, holding costs nothing. Cost is processor
time a cycle, the best of several repeats, the first one apart. Errors are RMS over the cycles' ends:
force relative to the reference's RMS force, position of the probe's centre, pressure of a taxel in counts of 1/255 of
the full scale. Besides, each method and step must come to rest against a contact of 10 MN/m, the stiffest that the
project looks at: explicit steps that are not short enough rattle there.

The whole cell, of which the plant is a part, is measured by `workprec_cell`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from canprobe.emulator.plant.dynamic_arm import Stepping
from canprobe.scene_setup import Dynamics
from canprobe.studies.study import Column, StudyResult
from canprobe.studies.study_files import measuring_facts
from canprobe.studies.sweep import Sweep
from canprobe.studies.workprec_cell import run_cell
from canprobe.studies.workprec_trial import Array, integrated, observed, reference, stands

STIFFNESSES = (1.6e7, 1.27e8, 1.27e9, 1.27e11)
"""K/h of the layer, N/m³: foam, the default pad, steel, and a hundred times that. At 2 N: 3.3, 9.4, 30, 300 kN/m."""
METHODS = ("semi-implicit", "rk4", "implicit", "rosenbrock", "exponential", "adaptive")
STEPS_US = (2500.0, 1250.0, 625.0, 312.5, 156.25, 78.125)
FULL_SCALE_PA = 100e3
STIFFEST, REST_CYCLES = 1.4e14, 40
"""K/h at which 2 N make a contact of 10 MN/m, and how long the arm has to come to rest there."""
SPAN = STIFFNESSES[:3]
"""What the cell is made for: the default must be accurate enough there."""
LINEARLY_IMPLICIT = ("implicit", "rosenbrock")
FREE_METHODS, FREE_STEPS_US = ("rk4", "rosenbrock"), (1250.0, 312.5, 78.125)
"""Where the dynamics are not held: what tells the error of holding them."""
ENOUGH = {"force": 1.0, "position": 2.9, "taxels": 0.29}
"""Errors below which nothing is gained: 1 % of the force, and what encoders (10 µm) and ADC round off, RMS."""
MODEL = ("robot", "touch/objects.py", "touch/placed.py", "emulator/plant", "studies/workprec.py",
         "studies/workprec_trial.py")  # fmt: skip
COLUMNS = (
    Column("stiffness_n_m3", "K/h N/m³", ".3g"),
    Column("held", "held"),
    Column("method", "method"),
    Column("step_us", "step µs", ".0f"),
    Column("cost_us", "µs a cycle", ".0f"),
    Column("force_percent", "force %", ".2g"),
    Column("position_um", "position µm", ".2g"),
    Column("taxel_counts", "taxel counts", ".2g"),
    Column("stands", "stands"),
    Column("verdict", "verdict"),
)


@dataclass(frozen=True, slots=True)
class Case:
    """One integration; with `method` "radau" the reference, `step_us` then being its relative tolerance."""

    stiffness_n_m3: float
    method: str
    step_us: float
    held: bool
    cycles: int
    repeats: int


def cases(quick: bool) -> list[Case]:
    """All integrations."""
    stiffnesses = STIFFNESSES[1:3] if quick else STIFFNESSES
    steps = STEPS_US[1:3] if quick else STEPS_US
    cycles, repeats = (4, 1) if quick else (20, 2)
    held = [Case(k, m, step, True, cycles, repeats) for k, m, step in product(stiffnesses, METHODS, steps)]
    free_steps = [step for step in FREE_STEPS_US if step in steps]
    return held + [Case(k, m, h, False, cycles, repeats) for k, m, h in product(stiffnesses, FREE_METHODS, free_steps)]


def run(*, quick: bool, sweep: Sweep) -> StudyResult:
    """Integrate all cases, one at a time, and the references beside each other."""
    todo = cases(quick)
    stiffnesses, cycles = sorted({c.stiffness_n_m3 for c in todo}), todo[0].cycles
    sweep.say(f"{len(stiffnesses)} references")
    exact = [Case(k, "radau", rtol, False, cycles, 1) for k in stiffnesses for rtol in (1e-10, 1e-8)]
    found = [np.array(states) for states in sweep.map(solve, exact, model=MODEL)]
    truths = {k: observed(k, cycles, found[2 * i]) for i, k in enumerate(stiffnesses)}
    floors = {k: errors(truths[k], observed(k, cycles, found[2 * i + 1])) for i, k in enumerate(stiffnesses)}
    sweep.say(f"{len(todo)} integrations, timed one after another")
    standing = stand(todo, sweep)
    rows = []
    for case, answer in zip(todo, sweep.time(measure, todo, model=MODEL), strict=True):
        k = case.stiffness_n_m3
        row = {"stiffness_n_m3": k, "held": case.held, "method": case.method, "step_us": case.step_us}
        row |= {"cost_us": answer["cost_us"], "stands": standing[case.method, case.step_us]}
        broke = answer["states"] is None
        row |= dict.fromkeys(floors[k]) if broke else errors(truths[k], observed(k, cycles, np.array(answer["states"])))
        rows.append(row | {"verdict": verdict(row)})

    def draw(path: Path) -> None:
        from canprobe.studies.workprec_figure import draw_workprec

        draw_workprec(rows, floors, default_choice(), path)

    facts = measuring_facts(quick, 0, MODEL)
    whole = run_cell(quick=quick, sweep=sweep)
    return StudyResult("workprec", COLUMNS, rows, findings(rows, floors), facts, draw, (whole,))


def stand(todo: Sequence[Case], sweep: Sweep) -> dict[tuple[str, float], bool]:
    """Which methods and steps come to rest at the stiffest contact."""
    kinds = sorted({(case.method, case.step_us) for case in todo})
    cells = [Case(STIFFEST, method, step, True, REST_CYCLES, 1) for method, step in kinds]
    return dict(zip(kinds, sweep.map(rests, cells, model=MODEL), strict=True))


def rests(case: Case) -> bool:
    """Whether one integration comes to rest."""
    return stands(case.stiffness_n_m3, case.cycles, Stepping(case.method, round(1000.0 * case.step_us)))


def solve(case: Case) -> Any:
    """The reference's states."""
    return reference(case.stiffness_n_m3, case.cycles, case.step_us).tolist()


def measure(case: Case) -> dict[str, Any]:
    """States of one integration, None where it broke down, and its cost in µs a cycle."""
    stepping = Stepping(case.method, round(1000.0 * case.step_us))
    costs: list[float] = []
    states: Array | None = None
    for _ in range(1 + case.repeats):
        begun = process_time()
        states = integrated(case.stiffness_n_m3, case.cycles, stepping, case.held)
        costs.append(1e6 * (process_time() - begun) / case.cycles)
    return {"states": None if states is None else states.tolist(), "cost_us": min(costs[1:])}


def errors(truth: dict[str, Array], seen: dict[str, Array]) -> dict[str, float]:
    """RMS errors of an integration."""
    taxels = (seen["taxels"] - truth["taxels"])[:, np.any(truth["taxels"] > 0.0, axis=0)]
    return {
        "force_percent": 100.0 * _rms(seen["force"] - truth["force"]) / _rms(truth["force"]),
        "position_um": 1e6 * _rms(np.linalg.norm(seen["centre"] - truth["centre"], axis=1)),
        "taxel_counts": 255.0 / FULL_SCALE_PA * _rms(taxels),
    }


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def verdict(row: dict[str, Any]) -> str:
    """`enough`, `coarse`, or `broke down`."""
    if row["force_percent"] is None or not row["force_percent"] <= 100.0:
        return "broke down"
    small = (row["force_percent"], row["position_um"], row["taxel_counts"])
    return "enough" if all(e <= ENOUGH[name] for e, name in zip(small, ENOUGH, strict=True)) else "coarse"


def default_choice() -> dict[str, Any]:
    """What the dynamic plant does by default."""
    settings = Dynamics()
    return {"held": True, "method": settings.integrator, "step_us": settings.step_ns / 1000.0}


def knee(rows: Sequence[dict[str, Any]], stiffness: float) -> dict[str, Any] | None:
    """The cheapest integration that is accurate enough, of one stiffness."""
    good = [r for r in rows if r["stiffness_n_m3"] == stiffness and r["verdict"] == "enough"]
    return min(good, key=lambda r: float(r["cost_us"]), default=None)


def choice(
    rows: Sequence[dict[str, Any]], methods: Sequence[str] = LINEARLY_IMPLICIT
) -> tuple[tuple[str, float], float] | None:
    """Method and step that a default may have: accurate enough over the whole span, at rest at the stiffest contact.

    Args:
        rows: of the study.
        methods: that may be it.

    Returns:
        The one that costs least over the span, and that cost.
    """
    cost: dict[tuple[str, float], float] = {}
    for kind in {(r["method"], r["step_us"]) for r in rows if r["held"] and r["method"] in methods}:
        mine = [r for r in rows if r["held"] and (r["method"], r["step_us"]) == kind and r["stiffness_n_m3"] in SPAN]
        if mine and all(r["verdict"] == "enough" and r["stands"] for r in mine):
            cost[kind] = sum(float(r["cost_us"]) for r in mine)
    return min(cost.items(), key=lambda item: item[1], default=None)


def is_default(row: dict[str, Any]) -> bool:
    """Whether a row is the plant's default."""
    return all(row[name] == value for name, value in default_choice().items())


def findings(rows: Sequence[dict[str, Any]], floors: dict[float, dict[str, float]]) -> list[str]:
    """The knee of every stiffness, the default beside it, what holding costs, and how good the reference is."""
    said = [_chosen(rows)]
    for k, floor in floors.items():
        best = knee(rows, k)
        mine = next((r for r in rows if is_default(r) and r["stiffness_n_m3"] == k), None)
        said.append(f"K/h {k:.3g} N/m³: cheapest that is accurate enough {_named(best)}.")
        if mine is not None and best is not None:
            share = mine["cost_us"] / best["cost_us"]
            said.append(f"  the default, {_named(mine)}: {mine['verdict']}, {share:.1f} × that cost.")
        said += _holding(rows, k)
        said.append(
            f"  the reference's own error (rtol 1e-8 against 1e-10): force {floor['force_percent']:.1g} %, "
            f"position {floor['position_um']:.1g} µm, taxels {floor['taxel_counts']:.1g} counts."
        )
    return said


def _chosen(rows: Sequence[dict[str, Any]]) -> str:
    """Whether the default is the knee of those that may be it."""
    found, any_found, mine = choice(rows), choice(rows, METHODS), default_choice()
    default = f"{mine['method']} at {mine['step_us']:.0f} µs"
    if found is None or any_found is None:
        return f"No linearly implicit step here is accurate enough over the span and stands; the default is {default}."
    (method, step), cost = found
    said = (
        f"Of the linearly implicit steps that are accurate enough over the span (K/h {SPAN[0]:.3g} to {SPAN[-1]:.3g} "
        f"N/m³) and stand at 10 MN/m the cheapest is {method} at {step:.0f} µs: "
        + (
            "the knee, and the default."
            if found[0] == (mine["method"], mine["step_us"])
            else f"not the default, {default}."
        )
    )
    if any_found[0] == found[0]:
        return said
    (method, step), least = any_found
    return f"{said} Of all steps that do so {method} at {step:.0f} µs costs least, {least / cost:.2f} × as much."


def _holding(rows: Sequence[dict[str, Any]], stiffness: float) -> list[str]:
    """What holding mass matrix, bias and geometry over a cycle costs: the error at the finest step of rosenbrock."""
    fine = [r for r in rows if r["stiffness_n_m3"] == stiffness and r["method"] == "rosenbrock"]
    step = min((r["step_us"] for r in fine if not r["held"]), default=0.0)
    held, free = (next((r for r in fine if r["step_us"] == step and r["held"] is h), None) for h in (True, False))
    if held is None or free is None:
        return []
    if held["force_percent"] is None or free["force_percent"] is None:
        return []
    return [
        f"  held over a cycle, step {step:.0f} µs: force {held['force_percent']:.2g} %, position "
        f"{held['position_um']:.2g} µm; evaluated in every call: {free['force_percent']:.2g} %, "
        f"{free['position_um']:.2g} µm, at {free['cost_us'] / held['cost_us']:.1f} × the cost."
    ]


def _named(row: dict[str, Any] | None) -> str:
    if row is None:
        return "none is accurate enough"
    how = "held" if row["held"] else "not held"
    wrong = (
        ""
        if row["force_percent"] is None
        else (
            f" (force {row['force_percent']:.2g} %, position {row['position_um']:.2g} µm, "
            f"taxels {row['taxel_counts']:.2g} counts)"
        )
    )
    return f"{row['method']} at {row['step_us']:.0f} µs, {how}, {row['cost_us']:.0f} µs a cycle{wrong}"
