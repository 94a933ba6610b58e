"""One run of the fault campaign: drawn from a seed, carried out in lockstep, watched by a witness, and scored."""

from __future__ import annotations

import tempfile
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from canprobe.bus.candump import read_candump
from canprobe.bus.clock import VirtualClock
from canprobe.cell.build import make_task
from canprobe.cell.conditions import BY_KEY
from canprobe.cell.limits import limits_of
from canprobe.cell.tasks.touch import Phase
from canprobe.emulator.faults import Fault, FaultKind
from canprobe.emulator.faulty_node import FaultyNode
from canprobe.emulator.node import SlaveNode
from canprobe.emulator.plant.world import Plant
from canprobe.errors import CanprobeError, SafetyStop
from canprobe.protocol.cia402 import POWERED_STATES, state_of
from canprobe.protocol.frames import Frame
from canprobe.scene import Scene
from canprobe.scene_loader import load_scene
from canprobe.session import Session, resolve_scene

SCENARIOS = {"press, features": 0.7, "press, window": 0.15, "scan": 0.15}
"""Scenario → its share of the runs."""
PHASES = ("bring-up", "approach", "scan", "retreat", "stop")
SENSOR = 16
NODES = (1, 2, 3, 4, 5, 6, SENSOR)
FORCE_MAX_N = 3.0
AFTER_S = 0.4
"""Time after the end for which nothing may move."""
LOOK_NS = 10_000_000
LONGEST_S = 15.0
"""Virtual time after which a run hangs: nominal runs take two seconds, every time-out in them less than ten."""
RELEASE_NS = 100_000_000
"""Time that the retreat has, from its command, to bring the force below the limit."""
AT_REST_RAD = 2e-4
_KINDS = tuple(FaultKind)
_BOTH_WAYS = (FaultKind.DROP, FaultKind.DELAY, FaultKind.DUPLICATE, FaultKind.CORRUPT)


class HangError(Exception):
    """The run did not come to its end."""


class Witness:
    """A silent participant that looks at the plant every so often, also where the master sends no SYNC any more.

    Args:
        plant: of the run.
        period_ns: between two looks.

    Attributes:
        rows: (t_ns, force in N) of each look.
    """

    name = "witness"
    listens: frozenset[int] = frozenset()

    def __init__(self, plant: Plant, period_ns: int) -> None:
        self.rows: list[tuple[int, float]] = []
        self.next_deadline_ns = period_ns
        self._plant, self._period_ns = plant, period_ns

    def start(self, t_ns: int) -> Sequence[Frame]:
        """Nothing to say."""
        return ()

    def receive(self, can_id: int, data: bytes, t_ns: int) -> Sequence[Frame]:
        """Nothing to hear."""
        return ()

    def advance(self, t_ns: int) -> Sequence[Frame]:
        """Look."""
        self.next_deadline_ns = t_ns + self._period_ns
        self._plant.advance(t_ns)
        self.rows.append((t_ns, float(self._plant.truth()["force"])))
        if t_ns > LONGEST_S * 1e9:
            raise HangError(f"not at its end after {LONGEST_S:g} s")
        return ()


class _Silent:
    """In the place of a participant that is not needed."""

    next_deadline_ns = None
    listens: frozenset[int] = frozenset()

    def start(self, t_ns: int) -> Sequence[Frame]:
        return ()

    def receive(self, can_id: int, data: bytes, t_ns: int) -> Sequence[Frame]:
        return ()

    def advance(self, t_ns: int) -> Sequence[Frame]:
        return ()


@dataclass(frozen=True, slots=True)
class FaultCase:
    """What a seed stands for.

    Attributes:
        seed: of everything random in the run.
        scenario: one of `SCENARIOS`.
        phase: in which the first fault begins.
        faults: what happens.
    """

    seed: int
    scenario: str
    phase: str
    faults: tuple[Fault, ...]


@cache
def scenario_scene(name: str) -> Scene:
    """A touch that is short enough to be run ten thousand times."""
    scene = load_scene("plane" if name == "scan" else "press")
    scene = resolve_scene(scene, duration_s=0.2)
    scene = replace(
        scene,
        task=replace(scene.task, clearance_mm=0.5),
        limits=replace(scene.limits, force_max_n=FORCE_MAX_N),
        shape=replace(scene.shape, also=()) if scene.shape is not None else None,
    )
    if name != "press, features" or scene.sensor is None:
        return scene
    return replace(
        scene,
        cycle=replace(scene.cycle, rate_hz=100.0),
        sensor=replace(scene.sensor, rate_hz=100.0, mode="features"),
    )


@cache
def phase_windows(scenario: str) -> dict[str, tuple[int, int]]:
    """When each phase begins and ends in a run without faults, ns."""
    run = carry_out(FaultCase(0, scenario, "", ()))
    t_first_ns, period_ns = run["first_sync_ns"], run["period_ns"]
    rows = {phase: t_first_ns + row * period_ns for phase, row in run["phase_rows"].items()}
    settle, retreat, done = rows[Phase.SETTLE], rows[Phase.RETREAT], rows[Phase.DONE]
    edges = (t_first_ns - 100_000_000, t_first_ns, settle, retreat, done, run["end_ns"])
    return {name: (edges[i], edges[i + 1]) for i, name in enumerate(PHASES)}


def draw_case(seed: int) -> FaultCase:
    """The case of a seed: scenario, phase, one to three faults."""
    rng = Random(f"fault campaign {seed}")
    (scenario,) = rng.choices(tuple(SCENARIOS), tuple(SCENARIOS.values()))
    windows = phase_windows(scenario)
    phases = [rng.choice(PHASES) for _ in range(rng.choice((1, 1, 1, 1, 1, 1, 2, 2, 3)))]
    return FaultCase(seed, scenario, phases[0], tuple(_draw_fault(rng, windows[phase]) for phase in phases))


def _draw_fault(rng: Random, window: tuple[int, int]) -> Fault:
    kind = rng.choice(_KINDS)
    amount = rng.uniform(2e5, 2e6) if kind is FaultKind.BABBLE else 10 ** rng.uniform(5.0, 7.5)
    return Fault(
        kind,
        node_id=SENSOR if rng.random() < 0.3 else rng.choice(NODES),
        start_ns=rng.randrange(*window),
        duration_ns=int(10 ** rng.uniform(6.0, 8.7)),
        share=rng.choice((1.0, 1.0, 0.5, 0.1)),
        incoming=kind is FaultKind.DEAF or (kind in _BOTH_WAYS and rng.random() < 0.4),
        amount_ns=int(amount),
        seed=rng.randrange(2**32),
    )


def run_seed(seed: int) -> dict[str, Any]:
    """Draw, carry out and score the case of a seed."""
    case = draw_case(seed)
    run = carry_out(case)
    return {
        "seed": seed,
        "scenario": case.scenario,
        "phase": case.phase,
        "kinds": sorted({fault.kind.value for fault in case.faults}),
        "faults": [str(fault) for fault in case.faults],
        "hits": run["hits"],
        "outcome": run["outcome"],
        "reason": run["reason"],
        "force_max_n": run["force_max_n"],
        "above_ms": run["above_ns"] * 1e-6,
        "moved_rad": run["moved_rad"],
        "end_s": run["end_ns"] * 1e-9,
        "failures": run["failures"],
    }


def carry_out(case: FaultCase) -> dict[str, Any]:
    """Run a case to its end and a while beyond it; what came of it, with every failure in words."""
    with tempfile.TemporaryDirectory(prefix="canprobe-faults-") as folder:
        return _Run(case, Path(folder)).result()


class _Run:
    """One case being carried out."""

    def __init__(self, case: FaultCase, folder: Path) -> None:
        scene = scenario_scene(case.scenario)
        self.case = case
        self.session = Session(replace(scene, scene=replace(scene.scene, seed=case.seed)), folder)
        self.session.joins = self._join
        self.task = make_task(self.session.plan)
        self.limits = limits_of(self.session.plan)
        self.emulated: list[SlaveNode] = []
        self.nodes: list[FaultyNode] = []
        self.witness: Witness | None = None
        self.failures: list[str] = []
        self.steps = 0

    def _join(self, participant: Any) -> Any:
        if not hasattr(participant, "node_id"):
            return _Silent()  # the witness sees what the recorder of the truth would, and more
        self.emulated.append(participant)
        if self.witness is None:
            self._watch()
        if all(fault.node_id != participant.node_id for fault in self.case.faults):
            return participant
        sensor = self.session.scene.sensor
        ids: Sequence[int] = ()
        if sensor is not None and participant.node_id == sensor.node_id:
            ids = [pdo.cob_id for pdo in self.session.plan.pdos_of(sensor.node_id, "tpdo")]
        node = FaultyNode(participant, self.case.faults, ids)
        self.nodes.append(node)
        return node

    def _watch(self) -> None:
        assert self.session.world is not None and self.session.lockstep is not None
        self.witness = Witness(self.session.world.plant, LOOK_NS)
        self.session.lockstep.attach(self.witness)

    def result(self) -> dict[str, Any]:
        outcome, reason = self._drive()
        session = self.session
        assert session.world is not None and session.lockstep is not None and self.witness is not None
        clock = session.lockstep.clock
        end_ns = clock.now_ns()
        session.lockstep.recorder = None  # the log is closed
        self._score_log()
        moved = self._rest(clock, end_ns) if outcome != "hang" else 0.0
        force_max, above_ns = self._score_force()
        return {
            "outcome": outcome,
            "reason": reason,
            "hits": sum(node.hits for node in self.nodes),
            "force_max_n": force_max,
            "above_ns": above_ns,
            "moved_rad": moved,
            "end_ns": end_ns,
            "failures": self.failures,
            "period_ns": self.limits.period_ns,
            **self._phase_rows(),
        }

    def _drive(self) -> tuple[str, str]:
        try:
            with self.session:
                self.session.run(self.task, progress=self._count)
        except SafetyStop as stop:
            return "stopped for safety", str(stop)
        except CanprobeError as error:
            return ("bus or node failure" if self.session.opened else "bring-up refused"), str(error)
        except HangError as hang:
            self.failures.append(f"hang: {hang}")
            return "hang", str(hang)
        except Exception as error:  # whatever else it is, it is a failure of ours, and the campaign goes on
            place = traceback.extract_tb(error.__traceback__)[-1]
            self.failures.append(f"crash: {type(error).__name__}: {error} ({Path(place.filename).name}:{place.lineno})")
            return "crash", str(error)
        return "completed", ""

    def _count(self, _: object) -> None:
        self.steps += 1

    def _rest(self, clock: VirtualClock, end_ns: int) -> float:
        """Let time go on without a master; how far a joint moves once everything must be at rest (rad)."""
        assert self.session.world is not None
        plant = self.session.world.plant
        try:
            clock.sleep_until_ns(end_ns + int(AFTER_S * 0.25e9))
            before = np.array(plant.truth()["q"])
            clock.sleep_until_ns(
                max(end_ns + int(AFTER_S * 1e9), *(f.end_ns + int(AFTER_S * 0.5e9) for f in self.case.faults), 0)
            )
        except CanprobeError as error:
            self.failures.append(f"crash after the end: {error}")
            return 0.0
        moved = float(np.abs(plant.truth()["q"] - before).max())
        if moved > AT_REST_RAD:
            self.failures.append(f"motion after the stop: {moved:.5f} rad")
        for node in self.emulated:
            if node.node_id != SENSOR and (state := state_of(node.dictionary.number(0x6041))) in POWERED_STATES:
                self.failures.append(f"{node.name} is {state.name} after the stop")
        return moved

    def _score_force(self) -> tuple[float, int]:
        """Highest force, N; longest time above the limit, ns."""
        assert self.witness is not None
        longest = 0
        since: int | None = None
        for t_ns, force in self.witness.rows:
            if force <= FORCE_MAX_N:
                since = None
                continue
            since = t_ns if since is None else since
            longest = max(longest, t_ns - since)
        within = BY_KEY["force"].within
        assert within is not None
        allowed = within(self.limits) + RELEASE_NS
        highest = max((force for _, force in self.witness.rows), default=0.0)
        if longest > allowed:
            self.failures.append(f"force above the limit for {longest * 1e-6:.0f} ms, up to {highest:.2f} N")
        return highest, longest

    def _score_log(self) -> None:
        """Every frame that was on the bus until the end is in the log, and every cycle has its row."""
        session = self.session
        assert session.out is not None
        try:
            lines = sum(1 for _ in read_candump(session.out / "bus.log"))
        except CanprobeError as error:
            self.failures.append(f"log: {error}")
            return
        frames = sum(counter.frames for counter in session.traffic.values())
        if lines != frames:
            self.failures.append(f"log: {lines} lines of {frames} frames")
        if session.opened and (rows := len(session.cell.log)) < self.steps:
            self.failures.append(f"log: {rows} rows of {self.steps} cycles")

    def _phase_rows(self) -> dict[str, Any]:
        session = self.session
        if not session.opened or session.cell.cycle is None:
            return {}
        columns = session.cell.log.arrays()
        phases = columns.get("phase", np.empty(0))
        rows = {p: int(np.flatnonzero(phases == p)[0]) for p in Phase if (phases == p).any()}
        return {"phase_rows": rows, "first_sync_ns": session.cell.cycle.t_first_ns}
