"""Study `workprec`: error of the dynamic plant against its run time, by an explicit and a linearly implicit integrator.

Each cell integrates the same sliding contact (`trial`) and is compared with scipy's Radau at rtol 1e-10, which holds
nothing. `held` cells keep mass matrix, bias and contact geometry over a cycle of 2.5 ms, as the plant does; the others
evaluate them in every call. Cost is processor time per cycle, the best of several repeats without the first. Errors are
RMS over the ends of the cycles: force relative to the reference's RMS force, position of the probe's centre, pressure
of a taxel in counts of 1/255 of the full scale. Each method and step must also come to rest against a contact of
10 MN/m, the stiffest here: explicit steps that are too long rattle there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import product
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from scipy.integrate import solve_ivp

from canprobe.cell.plant.config import PlantConfig
from canprobe.cell.plant.contact import PlantState
from canprobe.cell.plant.dynamic_arm import DynamicArm
from canprobe.cell.plant.elastic_contact import depth_for_force
from canprobe.cell.plant.equations import ArmEquations
from canprobe.cell.plant.plant import Plant
from canprobe.cell.results.picture import BLUE, INK, ORANGE, SHADE, legend, log_scale, picture
from canprobe.cell.scene.arms import Bodies, arm_model
from canprobe.cell.scene.load import read_cell
from canprobe.cell.scene.setup import Dynamics
from canprobe.errors import UsageError
from canprobe.lab.studies.result import Row, StudyResult, measuring_facts
from canprobe.lab.studies.sweep import Sweep
from canprobe.mechanics.robot.denavit_hartenberg import tool_z_offset
from canprobe.mechanics.robot.dynamics import dynamics_problem
from canprobe.mechanics.robot.inverse import inverse_near
from canprobe.mechanics.robot.model import ArmModel, joints_to_units, units_per_motor, units_to_joints
from canprobe.mechanics.robot.probe_poses import probe_pose, start_posture
from canprobe.mechanics.touch.linear_algebra import rms
from canprobe.mechanics.touch.objects import make_object
from canprobe.mechanics.types import Floats

CYCLE_NS = 2_500_000
SPEED_M_S, FORCE_N = 0.025, 2.0
_POINT, _TOOL, _RADIUS = np.array((-0.120, -0.1225, 0.374)), tool_z_offset(80.0), 0.036
_NEAR = np.radians((90.0, 65.0, 15.0, 0.0, 100.0, 0.0))
STIFFNESSES = (1.6e7, 1.27e8, 1.27e9, 1.27e11)
"""K/h of the layer, N/m³: foam, the default pad, steel, and a hundred times that. At 2 N: 3.3, 9.4, 30, 300 kN/m."""
METHODS = ("rk4", "rosenbrock")
STEPS_US = (2500.0, 1250.0, 625.0, 312.5, 156.25, 78.125)
FREE_STEPS_US = (1250.0, 312.5, 78.125)
"""Steps of the cells in which the dynamics are not held."""
FULL_SCALE_PA = 100e3
STIFFEST, REST_CYCLES = 1.4e14, 40
"""K/h at which 2 N make a contact of 10 MN/m, and the cycles in which the arm must come to rest there."""
NUDGE_COUNTS, AT_REST_COUNTS_S = 5.0, 20.0
SPAN = STIFFNESSES[:3]
"""Stiffnesses at which the default must be accurate enough."""
ENOUGH = {"force_percent": 1.0, "position_um": 2.9, "taxel_counts": 0.29}
"""Small enough errors: 1 % of the force, and the rounding of encoders (10 µm) and ADC, RMS."""
MODEL = ("mechanics", "cell/plant", "lab/studies/workprec.py")
COLUMNS = (
    "stiffness_n_m3", "held", "method", "step_us", "cost_us", "force_percent", "position_um", "taxel_counts", "stands",
    "verdict",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class IntegrationCase:
    """One integration; method "radau" is the reference, and `step_us` then its relative tolerance."""

    stiffness_n_m3: float
    method: str
    step_us: float
    held: bool
    cycles: int
    repeats: int

    @property
    def dynamics(self) -> Dynamics:
        """Method and step, as the plant takes them."""
        return Dynamics(integrator=self.method, step_ns=round(1000.0 * self.step_us))


def cases(quick: bool) -> list[IntegrationCase]:
    """All integrations."""
    stiffnesses = STIFFNESSES[1:3] if quick else STIFFNESSES
    steps = STEPS_US[1:3] if quick else STEPS_US
    cycles, repeats = (4, 1) if quick else (20, 2)
    return [
        IntegrationCase(k, method, step, held, cycles, repeats)
        for held in (True, False)
        for k, method, step in product(stiffnesses, METHODS, steps)
        if held or step in FREE_STEPS_US
    ]


def run(*, quick: bool, sweep: Sweep) -> StudyResult:
    """Integrate all cases, one at a time, and the references beside each other.

    Raises:
        UsageError: MuJoCo is missing.
    """
    if (problem := dynamics_problem("puma260", _arm()[1])) is not None:
        raise UsageError(problem)
    todo = cases(quick)
    stiffnesses, cycles = sorted({c.stiffness_n_m3 for c in todo}), todo[0].cycles
    sweep.say(f"{len(stiffnesses)} references")
    exact = [IntegrationCase(k, "radau", rtol, False, cycles, 1) for k in stiffnesses for rtol in (1e-10, 1e-8)]
    found = [np.array(states) for states in sweep.map(solve, exact, model=MODEL)]
    truths = {k: observed(k, found[2 * i]) for i, k in enumerate(stiffnesses)}
    floors = {k: errors(truths[k], observed(k, found[2 * i + 1])) for i, k in enumerate(stiffnesses)}
    kinds = sorted({(case.method, case.step_us) for case in todo})
    resting = [IntegrationCase(STIFFEST, *kind, True, REST_CYCLES, 1) for kind in kinds]
    standing = dict(zip(kinds, sweep.map(stands, resting, model=MODEL), strict=True))
    sweep.say(f"{len(todo)} integrations, timed one after another")
    rows = []
    for case, answer in zip(todo, sweep.time(measure, todo, model=MODEL), strict=True):
        k, states = case.stiffness_n_m3, answer["states"]
        row = {"stiffness_n_m3": k, "held": case.held, "method": case.method, "step_us": case.step_us}
        row |= {"cost_us": answer["cost_us"], "stands": standing[case.method, case.step_us]}
        row |= dict.fromkeys(ENOUGH) if states is None else errors(truths[k], observed(k, np.array(states)))
        rows.append(row | {"verdict": verdict(row)})
    facts, draw = measuring_facts(quick, 0, MODEL), partial(draw_workprec, rows, floors)
    return StudyResult("workprec", rows, findings(rows, floors), facts, draw, COLUMNS)


@cache
def _arm() -> tuple[ArmModel, Bodies]:
    """The packaged PUMA 260, and the bodies of its links."""
    cell = read_cell("puma260")
    assert cell.arm is not None
    return arm_model(cell.cell.name, cell.arm, cell.joints)[:2]


@cache
def trial(stiffness_n_m3: float, cycles: int) -> tuple[PlantConfig, Floats]:
    """The plant with a layer of a stiffness, and its drives' targets: (cycles + 1, 6) counts, one row per 2.5 ms."""
    pose = np.eye(4)
    pose[:3, 3] = _POINT
    arm, bodies = _arm()
    shape = make_object("cylinder", T_base_object=pose, radius=_RADIUS)
    depth = depth_for_force(FORCE_N, (1.0 / _RADIUS, 0.0), 0.040, stiffness_n_m3)
    q = start_posture(arm, _POINT, (0, 0, 1), _NEAR, radius_m=0.040, T_flange_probe=_TOOL, clearance_m=-depth)
    targets = []
    for k in range(cycles + 1):
        turn = SPEED_M_S * k * CYCLE_NS * 1e-9 / _RADIUS
        normal = np.array((0.0, math.sin(turn), math.cos(turn)))
        point = _POINT + _RADIUS * (normal - (0.0, 0.0, 1.0))
        q = inverse_near(arm, probe_pose(point, normal, 0.040 - depth, (1, 0, 0)), _TOOL, q)
        targets.append(np.rint(joints_to_units(arm, q)))
    counts = np.array(targets)
    start = units_to_joints(arm, counts[0])  # a posture that the encoders can hold
    config = PlantConfig(arm, start, object=shape, stiffness_n_m3=stiffness_n_m3, fidelity="dynamic", bodies=bodies)
    return config, counts


def integrated(stiffness_n_m3: float, targets: Floats, dynamics: Dynamics, *, held: bool = True) -> Floats | None:
    """Motor counts and rates at the ends of the cycles between targets (cycles, 12); None where it broke down."""
    config, _ = trial(stiffness_n_m3, 1)
    arm = DynamicArm(replace(config, dynamics=dynamics), held=held)
    seen: list[Any] = []
    with np.errstate(all="ignore"):
        for k, (begin, end) in enumerate(zip(targets[:-1].tolist(), targets[1:].tolist(), strict=True)):
            for i in range(6):
                arm.set_ramp(i, begin[i], end[i], k * CYCLE_NS, (k + 1) * CYCLE_NS)
            arm.advance((k + 1) * CYCLE_NS)
            try:
                seen.append([x for part in arm.motors() for x in part])
            except (ArithmeticError, ValueError, np.linalg.LinAlgError):
                return None
    found = np.array(seen)
    return found if np.all(np.isfinite(found)) and np.abs(found).max() < 1e9 else None


def measure(case: IntegrationCase) -> dict[str, Any]:
    """States of one integration, None where it broke down, and its cost in µs a cycle."""
    targets = trial(case.stiffness_n_m3, case.cycles)[1]
    costs: list[float] = []
    states: Floats | None = None
    for _ in range(1 + case.repeats):
        begun = process_time()
        states = integrated(case.stiffness_n_m3, targets, case.dynamics, held=case.held)
        costs.append(1e6 * (process_time() - begun) / case.cycles)
    return {"states": None if states is None else states.tolist(), "cost_us": min(costs[1:])}


def stands(case: IntegrationCase) -> bool:
    """Whether the arm comes to rest in contact after a nudge of one motor, as a real one does."""
    targets = np.repeat(trial(case.stiffness_n_m3, 1)[1][:1], case.cycles + 1, axis=0)
    targets[1:, 0] += NUDGE_COUNTS
    found = integrated(case.stiffness_n_m3, targets, case.dynamics)
    return found is not None and bool(np.abs(found[-case.cycles // 4 :, 6:]).max() < AT_REST_COUNTS_S)


def solve(case: IntegrationCase) -> Any:
    """Motor counts and rates by scipy's Radau, cycle by cycle, nothing held."""
    config, targets = trial(case.stiffness_n_m3, case.cycles)
    equations, scale = ArmEquations(config, held=False), units_per_motor(_arm()[0])
    h, seen, rtol = CYCLE_NS * 1e-9, [], case.step_us
    y = equations.resting(targets[0] / scale)
    for k in range(case.cycles):
        slope = (targets[k + 1] - targets[k]) / scale / h
        equations.loops.set_reference(k * h, targets[k] / scale, slope)
        solved = solve_ivp(
            equations.rate, (k * h, (k + 1) * h), y, "Radau", rtol=rtol, atol=1e-2 * rtol, jac=equations.jacobian
        )
        y = solved.y[:, -1]
        seen.append(np.concatenate((y[:6] * scale, y[6:12] * scale)).tolist())
    return seen


def observed(stiffness_n_m3: float, states: Floats) -> dict[str, Floats]:
    """Force (n,) N, probe centre (n, 3) m and taxel pressures (n, 256) Pa of states (n, 12), counts and rates."""
    plant = Plant(trial(stiffness_n_m3, len(states))[0])
    at = [PlantState(0, tuple(row[:6].tolist()), tuple(row[6:].tolist())) for row in states]
    truths = plant.truths(at)
    return {
        "force": truths["force"],
        "centre": truths["probe_centre"],
        "taxels": np.array([plant.pressure(state).ravel() for state in at]),
    }


def errors(truth: dict[str, Floats], seen: dict[str, Floats]) -> dict[str, float]:
    """RMS errors of an integration."""
    taxels = (seen["taxels"] - truth["taxels"])[:, np.any(truth["taxels"] > 0.0, axis=0)]
    return {
        "force_percent": 100.0 * rms(seen["force"] - truth["force"]) / rms(truth["force"]),
        "position_um": 1e6 * rms(np.linalg.norm(seen["centre"] - truth["centre"], axis=1)),
        "taxel_counts": 255.0 / FULL_SCALE_PA * rms(taxels),
    }


def verdict(row: Row) -> str:
    """`enough`, `coarse`, or `broke down`."""
    if row["force_percent"] is None or not row["force_percent"] <= 100.0:
        return "broke down"
    return "enough" if all(row[name] <= most for name, most in ENOUGH.items()) else "coarse"


def knee(rows: Sequence[Row], stiffness: float) -> Row | None:
    """The cheapest integration that is accurate enough, of one stiffness."""
    good = [r for r in rows if r["stiffness_n_m3"] == stiffness and r["verdict"] == "enough"]
    return min(good, key=lambda r: float(r["cost_us"]), default=None)


def choice(rows: Sequence[Row]) -> tuple[str, float] | None:
    """The cheapest method and step that is accurate enough over the span and stands, everything held."""
    cost: dict[tuple[str, float], float] = {}
    for kind in {(r["method"], r["step_us"]) for r in rows if r["held"]}:
        mine = [r for r in rows if r["held"] and (r["method"], r["step_us"]) == kind and r["stiffness_n_m3"] in SPAN]
        if mine and all(r["verdict"] == "enough" and r["stands"] for r in mine):
            cost[kind] = sum(float(r["cost_us"]) for r in mine)
    return min(cost, key=lambda kind: cost[kind], default=None)


DEFAULT = {"held": True, "method": Dynamics().integrator, "step_us": Dynamics().step_ns / 1000.0}
"""The default of the dynamic plant, as a row has it."""


def findings(rows: Sequence[Row], floors: Mapping[float, Mapping[str, float]]) -> list[str]:
    """The choice, and of every stiffness the knee, the default beside it, and the errors of holding and reference."""
    found = choice(rows)
    default = f"{DEFAULT['method']} at {DEFAULT['step_us']:.0f} µs"
    said = [
        f"The cheapest step that is accurate enough over the span (K/h {SPAN[0]:.3g} to {SPAN[-1]:.3g} N/m³) and stands"
        f" at 10 MN/m is {'none' if found is None else f'{found[0]} at {found[1]:.0f} µs'}; the default is {default}."
    ]
    for k, floor in floors.items():
        best, mine = knee(rows, k), next((r for r in rows if r | DEFAULT | {"stiffness_n_m3": k} == r), None)
        said.append(f"K/h {k:.3g} N/m³: cheapest that is accurate enough {_named(best)}.")
        if mine is not None and best is not None:
            share = mine["cost_us"] / best["cost_us"]
            said.append(f"  the default, {_named(mine)}: {mine['verdict']}, {share:.1f} × that cost.")
        fine = [r for r in rows if r["stiffness_n_m3"] == k and r["method"] == "rosenbrock"]
        step = min((r["step_us"] for r in fine if not r["held"]), default=0.0)
        said += [f"  {_named(r)}." for r in fine if r["step_us"] == step]
        said.append(
            f"  the reference's own error (rtol 1e-8 against 1e-10): force {floor['force_percent']:.1g} %, "
            f"position {floor['position_um']:.1g} µm, taxels {floor['taxel_counts']:.1g} counts."
        )
    return said


def _named(row: Row | None) -> str:
    if row is None:
        return "none is accurate enough"
    how = "held" if row["held"] else "not held"
    text = f"{row['method']} at {row['step_us']:.0f} µs, {how}, {row['cost_us']:.0f} µs a cycle"
    if row["force_percent"] is None:
        return text
    error = f"force {row['force_percent']:.2g} %, position {row['position_um']:.2g} µm"
    return f"{text} ({error}, taxels {row['taxel_counts']:.2g} counts)"


LABELS = ("force error (%)", "position error (µm)", "taxel error (counts)")


def draw_workprec(rows: Sequence[Row], floors: Mapping[float, Mapping[str, float]], path: Path) -> None:
    """Error against cost: a row of panels for each measure, a column for each stiffness."""
    title = (
        "Integrators of the dynamic plant: error over the processor time of a cycle of 2.5 ms; a dot: one step size\n"
        "columns: stiffness K/h of the layer in contact\n"
        "solid: mass matrix, bias and contact geometry held over a cycle; dotted: evaluated in every call\n"
        "ring: the default; open: rattles against a contact of 10 MN/m; shade: accurate enough"
    )
    with picture(path, title, 8.2) as figure:
        grid = figure.subplots(len(ENOUGH), len(floors), squeeze=False, sharex=True, sharey="row")
        for line, (key, enough), label in zip(grid, ENOUGH.items(), LABELS, strict=True):
            known = [r for r in rows if r[key] is not None]
            for axes, (stiffness, floor) in zip(line, floors.items(), strict=True):
                _draw(axes, [r for r in known if r["stiffness_n_m3"] == stiffness], key, floor[key])
                axes.axhspan(1e-12, enough, color=SHADE, linewidth=0, zorder=0)
                log_scale(axes, "xy")
                axes.set(xlabel="processor time a cycle (µs)", ylabel=label)
                axes.label_outer()
            seen = [enough, *(max(r[key], floors[r["stiffness_n_m3"]][key]) for r in known)]
            line[0].set_ylim(max(0.3 * min(seen), 1e-7), min(3.0 * max(seen), 1e3))
        for axes, stiffness in zip(grid[0], floors, strict=True):
            axes.set_title(f"K/h {stiffness:.3g} N/m³")
        legend(figure)


def _draw(axes: Axes, rows: Sequence[Row], key: str, floor: float) -> None:
    """One panel; nothing below the reference's own error."""

    def plot(some: Sequence[Row], style: str, **how: Any) -> None:
        axes.plot([r["cost_us"] for r in some], [max(r[key], floor) for r in some], style, **how)

    for method, colour in zip(METHODS, (ORANGE, BLUE), strict=True):
        for held, line in ((True, "-"), (False, ":")):
            mine = [r for r in rows if r["method"] == method and r["held"] is held]
            plot(mine, line, color=colour, label=method if held else None)
            for stands, face in ((True, colour), (False, "white")):
                dots = [r for r in mine if r["stands"] is stands]
                plot(dots, "o", color=colour, markersize=4.5, markerfacecolor=face)
    chosen = [r for r in rows if r | DEFAULT == r]
    plot(chosen, "o", markersize=12, markerfacecolor="none", markeredgecolor=INK, markeredgewidth=1.4)
