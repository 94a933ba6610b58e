"""Study `faults`: ten thousand short touches in lockstep, each with faults drawn from its seed, each scored.

A run is a press or a short scan over emulated nodes that drop, delay, double, corrupt and swap frames, become mute or
deaf, reboot, freeze, babble or send wrong data, at random times in bring-up, approach, scan, retreat and stop. It fails
where the true force stays above the limit for longer than the reaction may take, where anything moves or has power
after the stop, where it does not end, where the log is incomplete, or where it raises anything but an error of
canprobe. `canprobe study faults --seed N` carries out one run again and prints what happens in it.
"""

from __future__ import annotations

import tempfile
import traceback
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from random import Random
from types import MappingProxyType
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator

from canprobe.cell.master.controller import Measurement
from canprobe.cell.master.supervision import limits_of
from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.model import Plan
from canprobe.cell.results.picture import AMBER, BLUE, GREEN, GREY, ORANGE, legend, log_scale, parts, picture
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.cell.tasks.probing import Phase
from canprobe.errors import CanprobeError
from canprobe.fieldbus.node.faults import Fault, FaultKind, FaultyNode
from canprobe.lab.studies.fault_scores import (
    Peak,
    Witness,
    peak_of,
    run_to_end,
    score_force,
    score_log,
    score_rest,
    score_summary,
)
from canprobe.lab.studies.harness import Column, Row, Say, StudyResult, measuring_facts
from canprobe.lab.studies.sweep import Sweep

# The scenes: each as short as it can be with all its phases, planned once in a process.

FORCE_MAX_N = 3.0
_CLEARANCE_MM = 0.3


@dataclass(frozen=True, slots=True)
class Scenario:
    """One kind of run.

    Attributes:
        share: of the runs.
        scene: packaged scene that it is derived from.
        rate_hz: of SYNC and sensor.
        duration_s: of the task itself.
        mode: of the sensor; None where the scene has no sensor.
        speed_share: of the joints' speed limits, enough for the task: a drive refuses faster targets.
    """

    share: float
    scene: str
    rate_hz: float
    duration_s: float
    mode: str | None
    speed_share: float = 0.1


SCENARIOS: Mapping[str, Scenario] = MappingProxyType(
    {
        "listen": Scenario(0.1, "listen", 100.0, 0.2, "features"),
        "free": Scenario(0.15, "free", 100.0, 0.3, None),
        "press, features": Scenario(0.5, "press", 100.0, 0.1, "features"),
        "press, window": Scenario(0.1, "press", 200.0, 0.1, "window"),
        "cylinder": Scenario(0.15, "cylinder", 200.0, 0.2, "window", 0.35),
    }
)
"""A lower rate than 400 Hz makes a run cheaper and the reactions slower: their times are counted in cycles."""


@cache
def scenario_scene(name: str, timed: bool) -> Scene:
    """The scene of a scenario; `timed`: frames take time on the bus."""
    scenario = SCENARIOS[name]
    scene = load_scene(scenario.scene)
    task = replace(scene.task, duration_s=scenario.duration_s, clearance_mm=_CLEARANCE_MM)
    scene = replace(
        scene,
        task=task,
        bus=replace(scene.bus, timed=timed),
        cycle=replace(scene.cycle, rate_hz=scenario.rate_hz),
        limits=replace(scene.limits, force_max_n=FORCE_MAX_N, joint_speed_share=scenario.speed_share),
    )
    if scene.shape is not None:
        scene = replace(scene, shape=replace(scene.shape, also=()))
    if scene.sensor is not None:
        scene = replace(scene, sensor=replace(scene.sensor, rate_hz=scenario.rate_hz, mode=scenario.mode))  # type: ignore[arg-type]
    return scene


@cache
def scenario_plan(name: str, timed: bool) -> Plan:
    """The plan of a scenario, the same for all seeds."""
    return make_plan(resolve(scenario_scene(name, timed)))


def seeded_plan(name: str, timed: bool, seed: int) -> Plan:
    """The plan of one run."""
    plan = scenario_plan(name, timed)
    setup = plan.setup
    scene = replace(setup.scene, scene=replace(setup.scene.scene, seed=seed))
    return replace(plan, setup=replace(setup, scene=scene, seed=seed))


COLOURS = {
    "completed": (GREEN, ""),
    "stopped for safety": (AMBER, "//"),
    "bus or node failure": (BLUE, "\\\\"),
    "bring-up refused": (GREY, "xx"),
}
"""Colour and hatch of each outcome; the others, `hang` and `crash`, are failures."""
BIN_N, FEW = 0.05, 20


def draw_faults(runs: Sequence[Mapping[str, Any]], path: Path) -> None:
    """How the runs with each kind of fault ended, and the true force over all runs."""
    failed = sum(bool(one["failures"]) for one in runs)
    title = (
        f"How {len(runs)} runs with random faults of nodes and links ended; in brackets: runs with the fault\n"
        f"{failed} failed: they hung or crashed, or force, motion, power or log were not as promised"
    )
    of_kind = {kind.value: [one["outcome"] for one in runs if kind.value in one["kinds"]] for kind in FaultKind}
    found = {f"{kind} ({len(ends)})": ends for kind, ends in of_kind.items() if ends}
    forces = [one["force_max_n"] for one in runs if one["force_bound_n"] is not None]
    with picture(path, title, 4.6) as figure:
        sides = parts(figure, 1, 2)
        left, right = (part.subplots() for part in sides)
        start = np.zeros(len(found))
        for outcome, (colour, hatch) in COLOURS.items():
            shares = np.array([ends.count(outcome) / len(ends) for ends in found.values()])
            if shares.any():
                left.barh(list(found), shares, left=start, color=colour, hatch=hatch, edgecolor="white", label=outcome)
            start += shares
        left.invert_yaxis()
        left.grid(visible=False, axis="y")
        left.set(xlabel="share of the runs with this fault", xlim=(0, 1))
        if forces:
            low, high = BIN_N * np.floor(min(forces) / BIN_N), max(*forces, FORCE_MAX_N) + BIN_N
            counts, *_ = right.hist(forces, np.arange(low, high + BIN_N, BIN_N).tolist(), color=BLUE)
            if np.max(counts) > FEW:
                log_scale(right, "y")
                right.set_ylim(bottom=0.8)
            else:
                right.yaxis.set_major_locator(MaxNLocator(integer=True))
        right.axvline(FORCE_MAX_N, color=ORANGE, label=f"limit {FORCE_MAX_N:g} N")
        right.set(xlabel="highest true force of a run that presses (N)", ylabel="runs")
        for part in sides:
            legend(part)


def draw_ends(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """How long the master took to end, by what happened on vcan0."""
    kinds = list(dict.fromkeys(row["fault"] for row in rows))
    title = (
        "How long the master took to end after processes were killed or stopped, or the link failed, on vcan0\n"
        "failed: it hung, or nodes moved or were enabled afterwards"
    )
    with picture(path, title, 1.8 + 0.25 * len(kinds)) as figure:
        axes = figure.subplots()
        for colour, mark, label, failed in ((BLUE, "o", "no failure", False), (ORANGE, "X", "failed", True)):
            some = [row for row in rows if bool(row["failures"]) == failed]
            places = [kinds.index(row["fault"]) for row in some]
            axes.plot([row["ended_s"] for row in some], places, mark, color=colour, label=label)
        axes.set_yticks(range(len(kinds)), kinds)
        axes.set(xlabel="from the fault to the end of the master (s)", xlim=(0, None), ylim=(len(kinds) - 0.5, -0.5))
        legend(figure)


# The case of a seed: a scenario, and one to three faults at random times in its phases.

PHASES = ("bring-up", "approach", "scan", "retreat", "stop")
"""`listen` has no approach and no retreat, `free` no retreat; the approach of `free` is the enabling."""
FILES_EVERY = 8
"""One run in so many writes its log, and is scored on that."""
SENSOR_SHARE = 0.3
Windows = Mapping[str, tuple[int, int]]
"""Phase → when it begins and ends in a run without faults, ns."""
_KINDS = tuple(FaultKind)
_BOTH_WAYS = (FaultKind.DROP, FaultKind.DELAY, FaultKind.DUPLICATE, FaultKind.CORRUPT)
"""A frame that the wire corrupts is dropped for its CRC-15, all but one in 10¹⁰; a frame that is corrupted here stands
for errors behind it: in a controller's memory, a driver, a gateway."""
_NEED_TIME = (FaultKind.BABBLE, FaultKind.DELAY, FaultKind.REORDER)
"""Kinds that act by the time that frames take on the bus, or by their order."""


@dataclass(frozen=True, slots=True)
class FaultCase:
    """One run.

    Attributes:
        seed: of everything random in the run.
        scenario: one of `SCENARIOS`.
        phase: in which the first fault begins.
        faults: what happens.
        timed: frames take time on the bus.
        files: the run writes its log.
    """

    seed: int
    scenario: str
    phase: str
    faults: tuple[Fault, ...]
    timed: bool = False
    files: bool = True


def _draw_fault(rng: Random, kind: FaultKind, nodes: tuple[int, ...], window: tuple[int, int]) -> Fault:
    amount = rng.uniform(2e5, 2e6) if kind is FaultKind.BABBLE else 10 ** rng.uniform(5.0, 7.5)
    return Fault(
        kind,
        node_id=nodes[-1] if rng.random() < SENSOR_SHARE else rng.choice(nodes),
        start_ns=rng.randrange(*window),
        duration_ns=int(10 ** rng.uniform(6.0, 8.7)),
        share=rng.choice((1.0, 1.0, 0.5, 0.1)),
        incoming=kind is FaultKind.DEAF or (kind in _BOTH_WAYS and rng.random() < 0.4),
        amount_ns=int(amount),
        seed=rng.randrange(2**32),
    )


# One run: drawn from a seed, carried out in lockstep, watched by a witness, and scored.

AFTER_S = 0.3
"""Time after the end of the run, and of its last fault, in which nothing may move."""
SETTLED_S = 0.1
"""Time after which everything must be at rest."""
LOOK_NS = 5_000_000
BRING_UP_NS = 100_000_000
"""Before the first SYNC: reset, configuration and start; before that the master only listens."""
STOP_NS = 20_000_000
"""Faults may begin for so long after the end too: an untimed bus stops all nodes at one instant."""


@cache
def phase_windows(scenario: str, timed: bool) -> Windows:
    """When each phase of a scenario begins and ends in a run without faults, ns."""
    run = _Run(FaultCase(0, scenario, "", (), timed, files=False))
    cycle, begun = run.session.cell.cycle, run.begun
    assert cycle is not None
    first, task = cycle.t_first_ns, begun.get(Phase.SETTLE, begun[Phase.SCAN])
    marks: dict[str, int | None] = {
        "bring-up": first - BRING_UP_NS,
        "approach": first if task - first > 2 * run.plan.sync.period_ns else None,
        "scan": task,
        "retreat": begun.get(Phase.RETREAT),
        "stop": begun[Phase.DONE],
    }
    there = [(name, t_ns) for name in PHASES if (t_ns := marks[name]) is not None]
    ends = [t_ns for _, t_ns in there[1:]] + [run.end_ns + STOP_NS]
    return {name: (t_ns, end_ns) for (name, t_ns), end_ns in zip(there, ends, strict=True)}


@cache
def peak(scenario: str) -> Peak | None:
    """How deep the probe of a scenario can sink in until the cell reacts; None where nothing presses."""
    return peak_of(_Run(FaultCase(0, scenario, "", (), timed=False, files=False)).session)


def draw_case(seed: int) -> FaultCase:
    """The case of a seed."""
    rng = Random(f"fault campaign {seed}")
    (scenario,) = rng.choices(tuple(SCENARIOS), [scenario.share for scenario in SCENARIOS.values()])
    number = rng.choice((1, 1, 1, 1, 1, 1, 2, 2, 3))
    known = tuple(phase_windows(scenario, True))
    phases = [rng.choice(known) for _ in range(number)]
    kinds = [rng.choice(_KINDS) for _ in range(number)]
    # an untimed bus configures all nodes at one instant: no fault could begin within it
    timed = "bring-up" in phases or any(kind in _NEED_TIME for kind in kinds) or rng.random() < 0.1
    windows = phase_windows(scenario, timed)
    nodes = scenario_plan(scenario, timed).node_ids
    drawn = zip(kinds, phases, strict=True)
    faults = tuple(_draw_fault(rng, kind, nodes, windows[phase]) for kind, phase in drawn)
    return FaultCase(seed, scenario, phases[0], faults, timed, seed % FILES_EVERY == 0)


def run_seed(seed: int) -> dict[str, Any]:
    """Draw, carry out and score the case of a seed."""
    case = draw_case(seed)
    return {
        "seed": seed,
        "scenario": case.scenario,
        "timed": case.timed,
        "phase": case.phase,
        "kinds": sorted({fault.kind.value for fault in case.faults}),
        "faults": [str(fault) for fault in case.faults],
        **carry_out(case),
    }


def carry_out(case: FaultCase) -> dict[str, Any]:
    """Run a case to its end and a while beyond it; its outcome, its figures, and every failure in words."""
    reach = peak(case.scenario)
    wrong = any(fault.incoming and fault.kind is FaultKind.CORRUPT for fault in case.faults)
    bound = reach.force(len(case.faults), wrong) if reach is not None else None
    if not case.files:
        return _Run(case).result(bound)
    with tempfile.TemporaryDirectory(prefix="canprobe-faults-") as folder:
        return _Run(case, Path(folder)).result(bound)


class _Run:
    """One case, carried out.

    Attributes:
        begun: when each phase of the task began, ns.
        end_ns: when the session was closed.
    """

    def __init__(self, case: FaultCase, folder: Path | None = None) -> None:
        self.case = case
        self.plan = seeded_plan(case.scenario, case.timed, case.seed)
        self.session = Session(self.plan, folder)
        self.task = make_task(self.plan)
        self.begun: dict[Phase, int] = {}
        self.steps = self.stepped_ns = 0
        world, sensor = self.session.world, self.plan.scene.sensor
        self.witness = Witness(world.plant, LOOK_NS)
        self.faulty: dict[int, FaultyNode] = {}
        for node in world.nodes:
            if all(fault.node_id != node.node_id for fault in case.faults):
                continue
            of_sensor = sensor is not None and node.node_id == sensor.node_id
            ids = [pdo.cob_id for pdo in self.plan.pdos_of(node.node_id, "tpdo")] if of_sensor else ()
            self.faulty[node.node_id] = FaultyNode(node, case.faults, ids)
        # the witness sees what the recorder of the truth would, and more
        world.participants[:] = [self.witness, *(self.faulty.get(node.node_id, node) for node in world.nodes)]
        self.outcome, self.error = run_to_end(self.session, self.task, self._count)
        assert self.session.lockstep is not None
        self.clock = self.session.lockstep.clock
        self.end_ns = self.clock.now_ns()
        if self.outcome == "completed":
            self.begun.setdefault(Phase.DONE, self.stepped_ns)

    def _count(self, _: Measurement) -> None:
        assert self.session.lockstep is not None
        self.steps += 1
        self.stepped_ns = self.session.lockstep.clock.now_ns()
        self.begun.setdefault(getattr(self.task, "phase", Phase.SCAN), self.stepped_ns)

    def result(self, bound_n: float | None) -> dict[str, Any]:
        """The score; without a bound (N) the force is not judged."""
        session, reason, failures = self.session, str(self.error or ""), []
        assert session.lockstep is not None
        session.lockstep.recorder = None  # the log is closed
        if self.outcome == "hang":
            failures.append(f"hang: {reason}")
        elif self.outcome == "crash":
            assert self.error is not None
            place = traceback.extract_tb(self.error.__traceback__)[-1]
            where = f"{Path(place.filename).name}:{place.lineno}"
            failures.append(f"crash: {type(self.error).__name__}: {self.error} ({where})")
        failures += score_log(session, self.steps) + score_summary(session, self.task, reason)
        moved = 0.0
        if self.outcome != "hang" and session.scene.arm is not None:
            moved, found = self._rest()
            failures += found
        force_max, above_ns, found = score_force(self.witness.rows, limits_of(self.plan), bound_n)
        return {
            "hits": sum(node.hits for node in self.faulty.values()),
            "outcome": self.outcome,
            "reason": reason,
            "force_max_n": force_max,
            "force_bound_n": bound_n,
            "above_ms": above_ns * 1e-6,
            "moved_rad": moved,
            "end_s": self.end_ns * 1e-9,
            "failures": failures + found,
        }

    def _rest(self) -> tuple[float, list[str]]:
        """Let time pass without a master: how far a joint moves (rad) once all must be at rest, and failures."""
        plant, nodes = self.session.world.plant, self.session.world.nodes
        over_ns = max(self.end_ns, *(fault.end_ns for fault in self.case.faults), 0)
        try:
            self.clock.sleep_until_ns(self.end_ns + int(SETTLED_S * 1e9))
            before = np.array(plant.truth()["q"])
            self.clock.sleep_until_ns(over_ns + int(AFTER_S * 1e9))
        except CanprobeError as error:
            return 0.0, [f"crash after the end: {error}"]
        moved = float(np.abs(plant.truth()["q"] - before).max())
        return moved, score_rest(moved, nodes)


# The campaign, its table and its findings.

RUNS, QUICK_RUNS, SEEDS_A_CELL = 10_000, 8, 20
COLUMNS = (
    Column("fault", "fault"),
    Column("runs", "runs", "d"),
    *(Column(phase, phase, "d") for phase in PHASES),
    *(Column(outcome, outcome, "d") for outcome in COLOURS),
    Column("force_max_n", "highest force N", ".2f"),
    Column("above_ms", "longest above limit ms", ".0f"),
    Column("failures", "failures", "d"),
)


@dataclass(frozen=True, slots=True)
class Seeds:
    """One cell of the sweep: some runs in a row, so that a process does not load everything for a single one."""

    first: int
    count: int


def measure(seeds: Seeds) -> list[dict[str, Any]]:
    """The runs of some seeds."""
    return [run_seed(seed) for seed in range(seeds.first, seeds.first + seeds.count)]


def run(*, quick: bool, sweep: Sweep) -> StudyResult:
    """Carry out the campaign."""
    total = QUICK_RUNS if quick else RUNS
    size = min(total, SEEDS_A_CELL)
    cells = [Seeds(first, min(size, total - first)) for first in range(0, total, size)]
    runs = [one for answer in sweep.map(measure, cells) for one in answer]
    facts = measuring_facts(quick, total)
    return StudyResult("faults", COLUMNS, table_rows(runs), findings(runs), facts, partial(draw_faults, runs))


def table_rows(runs: Sequence[Mapping[str, Any]]) -> list[Row]:
    """A row for each kind of fault (a run with two kinds is in both), and one for all."""
    kinds = [(kind.value, [r for r in runs if kind.value in r["kinds"]]) for kind in FaultKind]
    return [_row(name, some) for name, some in [*kinds, ("all", list(runs))]]


def _row(name: str, runs: Sequence[Mapping[str, Any]]) -> Row:
    phases = Counter(one["phase"] for one in runs)
    pressing = pressing_runs(runs)
    outcomes = Counter(one["outcome"] for one in runs)
    return {
        "fault": name,
        "runs": len(runs),
        **{phase: phases[phase] for phase in PHASES},
        **{outcome: outcomes[outcome] for outcome in COLOURS},
        "force_max_n": max((one["force_max_n"] for one in pressing), default=0.0),
        "above_ms": max((one["above_ms"] for one in pressing), default=0.0),
        "failures": sum(bool(one["failures"]) for one in runs),
    }


def pressing_runs(runs: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Runs in which the cell presses and its force is judged: in `listen` somebody else presses."""
    return [one for one in runs if one["force_bound_n"] is not None]


def findings(runs: Sequence[Mapping[str, Any]]) -> list[str]:
    """The figures of the campaign, and every failure with the command that runs it again."""
    failed = [one for one in runs if one["failures"]]
    hit = sum(one["hits"] > 0 for one in runs)
    pressing = pressing_runs(runs)
    above = [one["above_ms"] for one in pressing if one["above_ms"] > 0]
    lines = [
        f"{len(runs)} runs, {hit} of them with at least one frame or node hit; {len(failed)} failed.",
        f"The cell presses in {len(pressing)} runs: true force above the scene's limit of {FORCE_MAX_N:g} N in"
        f" {len(above)}, for {max(above, default=0):.0f} ms at most, highest"
        f" {max((one['force_max_n'] for one in pressing), default=0.0):.2f} N.",
    ]
    lines += [
        f"seed {one['seed']}: {'; '.join(one['failures'])} (canprobe study faults --seed {one['seed']})"
        for one in failed[:20]
    ]
    return lines if len(failed) <= 20 else [*lines, f"… and {len(failed) - 20} more failures"]


def replay(seed: int, say: Say) -> dict[str, Any]:
    """Carry out the run of one seed again and report what happens in it."""
    case = draw_case(seed)
    say(f"seed {seed}: {case.scenario}")
    for fault in case.faults:
        say(f"  {fault}")
    outcome = run_seed(seed)
    say(f"  {outcome['hits']} hits; {outcome['outcome']} at {outcome['end_s']:.3f} s {outcome['reason']}")
    say(f"  highest force {outcome['force_max_n']:.2f} N, above the limit for {outcome['above_ms']:.0f} ms")
    for failure in outcome["failures"]:
        say(f"  FAILURE: {failure}")
    return outcome
