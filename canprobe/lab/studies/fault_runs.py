"""One run of study `faults` in lockstep, under a witness of the true force, and its score.

The score looks at the emulated nodes and the plant, not at what the master believes. A run fails where the true force
exceeds `FORCE_SHARE` of the limit (`limits.force_max_n`), where it is reported as completed although the fault
mattered, where anything moves or has power after the stop, where it does not end, where its log or summary is
incomplete, or where it raises anything but an error of canprobe.

A fault mattered where the true force was above the limit, or above the measured one by more than `LIE_SHARE` of the
limit for `LIE_S`. It is noticed with the first condition of the supervision behind its beginning, with the reason for
which the task ends, or with the error that ends the run.
"""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.cell.master.controller import Measurement
from canprobe.cell.master.options import RunOptions
from canprobe.cell.planning.model import Plan
from canprobe.cell.results.summary import summarise
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.cell.tasks.task import Phase, record_of
from canprobe.errors import CanprobeError
from canprobe.fieldbus.bus.candump import read_candump
from canprobe.fieldbus.protocol.cia402 import POWERED_STATES, state_of
from canprobe.fieldbus.tools.faults import Fault
from canprobe.fieldbus.tools.faults.fault import FOREVER_NS
from canprobe.lab.studies.fault_cases import CONTACT_SHARE, LIFT_OFF_NS, FaultCase, Windows, WrongFile, task_plan
from canprobe.lab.studies.sweep import error_text
from canprobe.lab.studies.witnessed_run import Witness, longest_above, run_to_end

FORCE_SHARE, USUAL_SHARE = 1.5, 1.2
"""Shares of the force limit: never above the first, in 99 % of the runs not above the second."""
LIE_SHARE, LIE_S = 0.4, 0.1
PRESSED_N = 0.05
"""Force above which the probe is left pressing, N."""
AFTER_S = 0.3
"""Time after the end of the run in which nothing may move."""
SETTLED_S = 0.1
"""Time after which everything must be at rest."""
AT_REST_RAD = 2e-4
LOOK_NS = 5_000_000
BRING_UP_NS = 100_000_000
"""Time before the first SYNC for reset, configuration and start; before that the master only listens."""
FILES_EVERY = 8
"""One run in so many writes its log, and is scored on that."""
_OF_THE_ARRAY = re.compile(r"\b(array|image|tactile|taxels?|sensor)\b", re.IGNORECASE)


@cache
def phase_windows(task: str, plant: str) -> Windows:
    """Time in which a fault of each phase of a task begins, ns, from a run without faults."""
    run = FaultRun(task_plan(task, plant))
    cycle, begun = run.session.cell.cycle, run.begun
    assert cycle is not None
    approach, contact, retreat = (begun[phase] for phase in (Phase.APPROACH, Phase.SETTLE, Phase.RETREAT))
    return {
        "start": (cycle.t_first_ns - BRING_UP_NS, approach),
        "approach": (approach, contact),
        "contact": (contact, contact + round(CONTACT_SHARE * (retreat - contact))),
        "lift-off": (retreat, retreat + LIFT_OFF_NS),
    }


def run_case(case: FaultCase) -> dict[str, Any]:
    """Carry out and score a case."""
    plan = task_plan(case.task, case.plant).with_seed(case.number)
    setup = plan.setup
    assert setup.arm is not None and setup.array is not None
    fault = case.fault(setup.arm.node_ids, setup.array.node_id, phase_windows(case.task, case.plant))
    about = {"number": case.number, "kind": case.kind.name, "fault": str(fault)}
    about |= {"task": case.task, "phase": case.phase, "plant": case.plant}
    if case.number % FILES_EVERY:
        return about | FaultRun(plan, (fault,)).result()
    with tempfile.TemporaryDirectory(prefix="canprobe-faults-") as folder:
        return about | FaultRun(plan, (fault,), Path(folder)).result()


def run_wrong_file(case: WrongFile) -> dict[str, Any]:
    """Carry out and score a first touch with a wrong file; a plan that refuses it is an outcome."""
    about = {"file": case.what, "joint": case.joint, "plant": case.plant}
    try:
        plan = case.plan()
    except CanprobeError as error:
        return about | {"outcome": "refused by the plan", "reason": str(error), "force_max_n": 0.0, "failures": []}
    assert plan.setup.array is not None
    run = FaultRun(plan, case.faults(plan.setup.array.node_id))
    result = run.result()
    return about | result | {"reason": result["reason"] or "; ".join(run.task.remarks) or "nothing"}


class FaultRun:
    """One run, carried out.

    Args:
        plan: plan of the run.
        faults: its faults.
        folder: folder of its files; None: it writes none.

    Attributes:
        begun: start of each phase of the task, ns.
        end_ns: time at which the session was closed.
    """

    def __init__(self, plan: Plan, faults: Sequence[Fault] = (), folder: Path | None = None) -> None:
        self.plan, self.faults = plan, faults
        self.session = Session(plan, RunOptions(folder))
        self.task = make_task(plan)
        self.begun: dict[Phase, int] = {}
        self.steps = self.stepped_ns = 0
        self.reason_ns: int | None = None
        world = self.session.buses.world
        self.witness = Witness(world.plant, LOOK_NS)
        self.faulty = world.make_faulty(faults)
        # the witness sees what the recorder of the truth would, and more
        world.participants[:] = [self.witness, *self.faulty.nodes]
        self.outcome, self.error = run_to_end(self.session, self.task, self._count)
        assert self.session.buses.lockstep is not None
        self.clock = self.session.buses.lockstep.clock
        self.end_ns = self.clock.now_ns()
        if self.outcome == "completed":
            self.begun.setdefault(Phase.DONE, self.stepped_ns)

    def _count(self, _: Measurement) -> None:
        assert self.session.buses.lockstep is not None
        self.steps += 1
        self.stepped_ns = self.session.buses.lockstep.clock.now_ns()
        self.begun.setdefault(getattr(self.task, "phase", Phase.SCAN), self.stepped_ns)
        if self.reason_ns is None and getattr(self.task, "reason", None) is not None:
            self.reason_ns = self.stepped_ns

    def result(self) -> dict[str, Any]:
        """The score."""
        session, reason, rows = self.session, str(self.error or ""), self.witness.rows
        assert session.buses.lockstep is not None
        session.buses.lockstep.recorder = None  # the log is closed
        limit = self.plan.setup.limits.force_max
        highest, left = max((force for _, force in rows), default=0.0), rows[-1][1] if rows else 0.0
        failures = [f"hang: {reason}"] if self.outcome == "hang" else []
        if self.outcome == "crash":
            assert self.error is not None
            failures.append(f"crash: {error_text(self.error)}")
        failures += self._log_problems() + self._summary_problems(reason)
        if highest > FORCE_SHARE * limit:
            failures.append(f"true force of {highest:.2f} N, limit {limit:g} N")
        lie = self._lie_n()
        if self.outcome == "completed" and (highest > limit or lie > LIE_SHARE * limit):
            failures.append(
                f"completed, with a true force of up to {highest:.2f} N, {lie:.2f} N above the measured one"
            )
        if self.outcome != "hang":
            failures += self._rest_problems()
        noticed_ns = self._noticed_ns()
        return {
            "hits": sum(node.host.hits for node in self.faulty.nodes),
            "outcome": self.outcome,
            "reason": reason,
            "named": bool(reason) and self._is_named(reason),
            "force_max_n": highest,
            "force_share": highest / limit,
            "above_ms": longest_above(rows, limit) * 1e-6,
            "above_measured_n": lie,
            "left_n": left,
            "noticed_ms": None if noticed_ns is None else noticed_ns * 1e-6,
            "end_s": self.end_ns * 1e-9,
            "failures": failures,
        }

    def _noticed_ns(self) -> int | None:
        """Time from the beginning of the fault until it was noticed, ns; None where it was not, or never began."""
        begun = [span.begin_ns for node in self.faulty.nodes for span in node.spans]
        begin_ns = min(begun, default=None) if self.faults else 0
        if begin_ns is None:
            return None
        times = [] if self.reason_ns is None else [self.reason_ns]
        if self.session.opened and (cycle := self.session.cell.cycle) is not None:
            period_ns = self.plan.sync.period_ns
            times += [cycle.t_first_ns + k * period_ns for k in self.session.cell.supervisor.first.values()]
        if self.error is not None:
            times.append(self.stepped_ns if self.stepped_ns > begin_ns else self.end_ns)
        return min((t_ns - begin_ns for t_ns in times if t_ns >= begin_ns), default=None)

    def _is_named(self, reason: str) -> bool:
        """Whether the reason names a node of the faults, or the array."""
        arm, array = self.plan.setup.arm, self.plan.setup.array
        assert arm is not None and array is not None
        for fault in self.faults:
            if fault.node_id == array.node_id and _OF_THE_ARRAY.search(reason):
                return True
            joint = arm.node_ids.index(fault.node_id) + 1 if fault.node_id in arm.node_ids else 0
            if re.search(rf"\b(node|nodes) {fault.node_id}\b|\bjoint {joint}\b", reason):
                return True
        return False

    def _lie_n(self) -> float:
        """Force by which the true one was above the measured one in all of the worst `LIE_S`, N."""
        if not self.session.opened or (cycle := self.session.cell.cycle) is None:
            return 0.0
        columns = self.session.cell.log.arrays()
        if "force_n" not in columns or not self.witness.rows:
            return 0.0
        times, forces = np.array(self.witness.rows).T
        t_ns = cycle.t_first_ns + self.plan.sync.period_ns * np.arange(len(columns["force_n"]))
        off = np.interp(t_ns, times, forces) - np.nan_to_num(columns["force_n"])
        length = round(LIE_S * 1e9 / self.plan.sync.period_ns)
        if len(off) < length:
            return 0.0
        return float(np.lib.stride_tricks.sliding_window_view(off, length).min(axis=1).max())

    def _rest_problems(self) -> list[str]:
        """Motion after the stop, once all must be at rest and no master is there; and drives that are not disabled."""
        plant = self.session.buses.world.plant
        ends_ns = [fault.end_ns for fault in self.faults if fault.duration_ns < FOREVER_NS]
        try:
            self.clock.sleep_until_ns(self.end_ns + round(SETTLED_S * 1e9))
            before = np.array(plant.truth()["q"])
            self.clock.sleep_until_ns(max(self.end_ns, *ends_ns, 0) + round((SETTLED_S + AFTER_S) * 1e9))
        except CanprobeError as error:
            return [f"crash after the end: {error}"]
        moved_rad = float(np.abs(plant.truth()["q"] - before).max())
        failures = [f"motion after the stop: {moved_rad:.5f} rad"] if moved_rad > AT_REST_RAD else []
        for node in self.faulty.nodes:
            number, frozen = node.node.dictionary.number, any(fault.kind.name == "freeze" for fault in node.holding)
            if not frozen and (state := state_of(number(0x6041))) in POWERED_STATES:
                failures.append(f"{node.name} is {state.name} after the stop")
        return failures

    def _summary_problems(self, reason: str) -> list[str]:
        """Failures to make and write a summary of the run, whatever happened in it."""
        if not self.session.started:
            return []
        try:
            json.dumps(summarise(self.session, record_of(self.task), {}, reason or None), allow_nan=False)
        except Exception as error:  # of any kind: a user would have lost the summary of the run
            return [f"summary: {type(error).__name__}: {error}"]
        return []

    def _log_problems(self) -> list[str]:
        """Missing rows of cycles in the log, and missing frames in `bus.log`, where one is written."""
        session, failures = self.session, []
        if session.opened and (rows := len(session.cell.log)) < self.steps:
            failures.append(f"log: {rows} rows of {self.steps} cycles")
        if session.options.out is None:
            return failures
        try:
            lines = sum(1 for _ in read_candump(session.options.out / "bus.log", whole=True))
        except CanprobeError as error:
            return [*failures, f"log: {error}"]
        frames = sum(counter.frames for counter in session.record.traffic.values())
        return failures if lines == frames else [*failures, f"log: {lines} lines of {frames} frames"]
