"""One run of the fault campaign: drawn from a seed, carried out in lockstep, watched by a witness, and scored."""

from __future__ import annotations

import tempfile
import traceback
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.bus.clock import VirtualClock
from canprobe.cell.build import make_task
from canprobe.cell.limits import limits_of
from canprobe.cell.measurement import Measurement
from canprobe.cell.tasks.probing import Phase
from canprobe.emulator.faults import FaultKind
from canprobe.emulator.faulty_node import FaultyNode
from canprobe.emulator.node import SlaveNode
from canprobe.errors import CanprobeError, SafetyStop
from canprobe.session import Session
from canprobe.studies import fault_cases
from canprobe.studies.fault_cases import PHASES, FaultCase, Windows
from canprobe.studies.fault_scenes import seeded_plan
from canprobe.studies.fault_scores import Peak, peak_of, score_force, score_log, score_rest, score_summary
from canprobe.studies.fault_witness import HangError, Silent, Witness

AFTER_S = 0.3
"""Time after the end of the run, and of its last fault, for which nothing may move."""
SETTLED_S = 0.1
"""Time after which everything must be at rest."""
LOOK_NS = 5_000_000
BRING_UP_NS = 100_000_000
"""Before the first SYNC: reset, configuration and start; before that the master only listens."""
STOP_NS = 20_000_000
"""Faults may begin for so long after the end too: on an untimed bus the nodes are let go at once."""


@cache
def phase_windows(scenario: str, timed: bool) -> Windows:
    """When each phase that a scenario has begins and ends in a run without faults, ns."""
    run = _Run(FaultCase(0, scenario, "", (), timed, files=False)).result(None)
    first, begun, end = run["first_sync_ns"], run["begun"], run["end_ns"]
    task = begun.get(Phase.SETTLE, begun[Phase.SCAN])
    marks: dict[str, int | None] = {
        "bring-up": first - BRING_UP_NS,
        "approach": first if task - first > 2 * run["period_ns"] else None,
        "scan": task,
        "retreat": begun.get(Phase.RETREAT),
        "stop": begun[Phase.DONE],
    }
    there = [(name, t_ns) for name in PHASES if (t_ns := marks[name]) is not None]
    ends = [t_ns for _, t_ns in there[1:]] + [end + STOP_NS]
    return {name: (t_ns, end_ns) for (name, t_ns), end_ns in zip(there, ends, strict=True)}


@cache
def peak(scenario: str) -> Peak | None:
    """What the probe of a scenario can reach until the cell reacts; None where nothing presses."""
    run = _Run(FaultCase(0, scenario, "", (), timed=False, files=False))
    run.result(None)
    return peak_of(run.session)


def draw_case(seed: int) -> FaultCase:
    """The case of a seed."""
    return fault_cases.draw_case(seed, phase_windows)


def run_seed(seed: int) -> dict[str, Any]:
    """Draw, carry out and score the case of a seed."""
    case = draw_case(seed)
    run = carry_out(case)
    return {
        "seed": seed,
        "scenario": case.scenario,
        "timed": case.timed,
        "phase": case.phase,
        "kinds": sorted({fault.kind.value for fault in case.faults}),
        "faults": [str(fault) for fault in case.faults],
        "hits": run["hits"],
        "outcome": run["outcome"],
        "reason": run["reason"],
        "force_max_n": run["force_max_n"],
        "force_bound_n": run["force_bound_n"],
        "above_ms": run["above_ns"] * 1e-6,
        "moved_rad": run["moved_rad"],
        "end_s": run["end_ns"] * 1e-9,
        "failures": run["failures"],
    }


def carry_out(case: FaultCase) -> dict[str, Any]:
    """Run a case to its end and a while beyond it; what came of it, with every failure in words."""
    reach = peak(case.scenario)
    wrong = any(fault.incoming and fault.kind is FaultKind.CORRUPT for fault in case.faults)
    bound = reach.force(len(case.faults), wrong) if reach is not None else None
    if not case.files:
        return _Run(case).result(bound)
    with tempfile.TemporaryDirectory(prefix="canprobe-faults-") as folder:
        return _Run(case, Path(folder)).result(bound)


class _Run:
    """One case being carried out."""

    def __init__(self, case: FaultCase, folder: Path | None = None) -> None:
        self.case = case
        self.plan = seeded_plan(case.scenario, case.timed, case.seed)
        self.session = Session(self.plan, folder)
        self.session.joins = self._join
        self.task = make_task(self.plan)
        self.limits = limits_of(self.plan)
        self.emulated: list[SlaveNode] = []
        self.nodes: list[FaultyNode] = []
        self.witness: Witness | None = None
        self.failures: list[str] = []
        self.steps = self.stepped_ns = 0
        self.begun: dict[Phase, int] = {}

    def _join(self, participant: Any) -> Any:
        if not hasattr(participant, "node_id"):
            return Silent()  # the witness sees what the recorder of the truth would, and more
        self.emulated.append(participant)
        if self.witness is None:
            self._watch()
        if all(fault.node_id != participant.node_id for fault in self.case.faults):
            return participant
        sensor = self.session.scene.sensor
        ids: Sequence[int] = ()
        if sensor is not None and participant.node_id == sensor.node_id:
            ids = [pdo.cob_id for pdo in self.plan.pdos_of(sensor.node_id, "tpdo")]
        node = FaultyNode(participant, self.case.faults, ids)
        self.nodes.append(node)
        return node

    def _watch(self) -> None:
        session = self.session
        assert session.world is not None and session.lockstep is not None
        self.witness = Witness(session.world.plant, LOOK_NS)
        session.lockstep.attach(self.witness)
        if session.out is None:
            session.lockstep.recorder = None  # nothing is counted that nobody looks at

    def result(self, bound_n: float | None) -> dict[str, Any]:
        """Carry it out; without a bound (N) the force is not scored."""
        outcome, reason = self._drive()
        session = self.session
        assert session.world is not None and session.lockstep is not None and self.witness is not None
        clock = session.lockstep.clock
        end_ns = clock.now_ns()
        session.lockstep.recorder = None  # the log is closed
        self.failures += score_log(session, self.steps) + score_summary(session, self.task, reason)
        moved = self._rest(clock, end_ns) if outcome != "hang" else 0.0
        force_max, above_ns, failures = score_force(self.witness.rows, self.limits, bound_n)
        self.failures += failures
        return {
            "outcome": outcome,
            "reason": reason,
            "hits": sum(node.hits for node in self.nodes),
            "force_max_n": force_max,
            "force_bound_n": bound_n,
            "above_ns": above_ns,
            "moved_rad": moved,
            "end_ns": end_ns,
            "failures": self.failures,
            "period_ns": self.limits.period_ns,
            "begun": self.begun,
            "first_sync_ns": session.cell.cycle.t_first_ns if session.opened and session.cell.cycle else None,
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
        self.begun.setdefault(Phase.DONE, self.stepped_ns)
        return "completed", ""

    def _count(self, _: Measurement) -> None:
        assert self.session.lockstep is not None
        self.steps += 1
        self.stepped_ns = self.session.lockstep.clock.now_ns()
        self.begun.setdefault(getattr(self.task, "phase", Phase.SCAN), self.stepped_ns)

    def _rest(self, clock: VirtualClock, end_ns: int) -> float:
        """Let time go on without a master; how far a joint moves once everything must be at rest (rad)."""
        assert self.session.world is not None
        if self.session.scene.arm is None:
            return 0.0
        plant = self.session.world.plant
        over_ns = max(end_ns, *(fault.end_ns for fault in self.case.faults), 0)
        try:
            clock.sleep_until_ns(end_ns + int(SETTLED_S * 1e9))
            before = np.array(plant.truth()["q"])
            clock.sleep_until_ns(over_ns + int(AFTER_S * 1e9))
        except CanprobeError as error:
            self.failures.append(f"crash after the end: {error}")
            return 0.0
        moved = float(np.abs(plant.truth()["q"] - before).max())
        self.failures += score_rest(moved, self.emulated)
        return moved
