"""One run of study `faults` in lockstep: drawn from a seed, carried out under a witness, and scored."""

from __future__ import annotations

import tempfile
import traceback
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from canprobe.cell.master.controller import Measurement
from canprobe.cell.master.options import RunOptions
from canprobe.cell.master.supervision import limits_of
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.cell.tasks.probing import Phase
from canprobe.errors import CanprobeError
from canprobe.lab.studies.fault_cases import FILES_EVERY, KINDS, NEED_TIME, PHASES, FaultCase, Windows, draw_fault
from canprobe.lab.studies.fault_scenes import SCENARIOS, scenario_plan, seeded_plan
from canprobe.lab.studies.fault_scores import Peak, peak_of, score_force, score_log, score_rest, score_summary
from canprobe.lab.studies.witnessed_run import Witness, run_to_end

AFTER_S = 0.3
"""Time after the end of the run, and of its last fault, in which nothing may move."""
SETTLED_S = 0.1
"""Time after which everything must be at rest."""
LOOK_NS = 5_000_000
BRING_UP_NS = 100_000_000
"""Time before the first SYNC for reset, configuration and start; before that the master only listens."""
STOP_NS = 20_000_000
"""Time after the end in which faults may begin too: an untimed bus stops all nodes at one instant."""


@cache
def phase_windows(scenario: str, timed: bool) -> Windows:
    """Start and end of each phase of a scenario in a run without faults, ns."""
    run = _LockstepRun(FaultCase(0, scenario, "", (), timed, files=False))
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
    """Depths to which the probe of a scenario can sink in until the cell reacts; None where nothing presses."""
    return peak_of(_LockstepRun(FaultCase(0, scenario, "", (), timed=False, files=False)).session)


def draw_case(seed: int) -> FaultCase:
    """The case of a seed."""
    rng = Random(f"fault campaign {seed}")
    (scenario,) = rng.choices(tuple(SCENARIOS), [scenario.share for scenario in SCENARIOS.values()])
    number = rng.choice((1, 1, 1, 1, 1, 1, 2, 2, 3))
    known = tuple(phase_windows(scenario, True))
    phases = [rng.choice(known) for _ in range(number)]
    kinds = [rng.choice(KINDS) for _ in range(number)]
    # an untimed bus configures all nodes at one instant: no fault could begin within it
    timed = "bring-up" in phases or any(kind.name in NEED_TIME for kind in kinds) or rng.random() < 0.1
    windows = phase_windows(scenario, timed)
    nodes = scenario_plan(scenario, timed).node_ids
    drawn = zip(kinds, phases, strict=True)
    faults = tuple(draw_fault(rng, kind, nodes, windows[phase]) for kind, phase in drawn)
    return FaultCase(seed, scenario, phases[0], faults, timed, seed % FILES_EVERY == 0)


def run_seed(seed: int) -> dict[str, Any]:
    """Draw, carry out and score the case of a seed."""
    case = draw_case(seed)
    return {
        "seed": seed,
        "scenario": case.scenario,
        "timed": case.timed,
        "phase": case.phase,
        "kinds": sorted({fault.kind.name for fault in case.faults}),
        "faults": [str(fault) for fault in case.faults],
        **carry_out(case),
    }


def carry_out(case: FaultCase) -> dict[str, Any]:
    """Run a case to its end and some time beyond it; its outcome, its figures, and every failure in words."""
    reach = peak(case.scenario)
    wrong = any(fault.incoming and fault.kind.name == "corrupt" for fault in case.faults)
    bound = reach.force(len(case.faults), wrong) if reach is not None else None
    if not case.files:
        return _LockstepRun(case).result(bound)
    with tempfile.TemporaryDirectory(prefix="canprobe-faults-") as folder:
        return _LockstepRun(case, Path(folder)).result(bound)


class _LockstepRun:
    """One case, carried out.

    Attributes:
        begun: start of each phase of the task, ns.
        end_ns: time at which the session was closed.
    """

    def __init__(self, case: FaultCase, folder: Path | None = None) -> None:
        self.case = case
        self.plan = seeded_plan(case.scenario, case.timed, case.seed)
        self.session = Session(self.plan, RunOptions(folder))
        self.task = make_task(self.plan)
        self.begun: dict[Phase, int] = {}
        self.steps = self.stepped_ns = 0
        world = self.session.world
        self.witness = Witness(world.plant, LOOK_NS)
        self.faulty = world.make_faulty(case.faults)
        # the witness sees what the recorder of the truth would, and more
        world.participants[:] = [self.witness, *self.faulty.nodes]
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
            "hits": sum(node.hits for node in self.faulty.nodes),
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
