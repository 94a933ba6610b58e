"""Study `faults` on a real vcan0: processes are killed or stalled, the interface goes down and comes back.

`canprobe vcan -- canprobe study faults --vcan`. A run fails where a drive has power or moves two seconds after the
fault, where the master does not end, or where it leaves no readable log. The nodes are a separate process, which
outlives the master: they must stop by themselves. Nodes whose interface goes down end with it.

A second table has the faults of the registry that press hardest, thrown as `canprobe inject` throws them, in a cell as
it is and in a patient one (`--patient`), and the true force of the plant.
"""

from __future__ import annotations

import json
import signal
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from random import Random
from typing import Any

from canopen.sdo.exceptions import SdoCommunicationError

from canprobe.cell.master.controller import Measurement
from canprobe.cell.planning.make import make_plan
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.child_process import ERRORS, ChildProcess
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.cell.tasks.task import Phase
from canprobe.errors import CanprobeError, InterfaceError
from canprobe.fieldbus.bus.candump import read_candump
from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.fieldbus.bus.port import Port
from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.bus.real.link import missing_ip
from canprobe.fieldbus.bus.real.socketcan import check_interface
from canprobe.fieldbus.bus.sdo import Dialogue, hold_dialogues, upload
from canprobe.fieldbus.protocol.cia402 import POWERED_STATES, DriveState, state_of
from canprobe.fieldbus.tools.faults.control import request_faults
from canprobe.lab.studies import vcan_cells
from canprobe.lab.studies.fault_cases import task_scene
from canprobe.lab.studies.fault_runs import FORCE_SHARE
from canprobe.lab.studies.figure import FORCE_AXIS, draw_by_name
from canprobe.lab.studies.result import Row, StudyResult, measuring_facts
from canprobe.lab.studies.sweep import Sweep
from canprobe.lab.studies.vcan_cells import CHANNEL
from canprobe.lab.studies.witnessed_run import forces_of, longest_above, run_to_end

RUNS, QUICK_THROWN = 40, 1
HOLD_S = 3.0
SERVED: Mapping[str, Any] = {
    **vcan_cells.ON_VCAN,
    "cycle.rate_hz": 100.0,
    "sensor.rate_hz": 100.0,
    "sensor.mode": "features",
    "task.duration_s": HOLD_S,
    "task.clearance_mm": 0.3,
}
"""Changes of `press` whose nodes are a separate process, which outlives the master; a slow guest holds 100 Hz."""
MISSED_SYNCS = 20
"""Missed SYNCs that the drives bear: a guest stands still for tens of milliseconds, which is no fault of the cell."""
PATIENCE_S = 60.0
REACTION_S = 2.0
"""Time after the fault until drives without a master must have stopped: they need 0.2 s, a slow guest needs more."""
STALL_S = 1.0
APART_S = 0.3
"""Time between two looks at the positions, s."""
MOST_COUNTS = 8
_TPDO1 = 0x181
THROWN = (
    ("node 16: stuck-image", "press", Phase.APPROACH),
    ("node 16: stuck-image", "weave", Phase.SCAN),
    ("node 16: replayed-image", "weave", Phase.SCAN),
    ("node 16: gain-lost gain=0.3", "press", Phase.APPROACH),
    ("node 16: stuck-rows first=4 rows=8", "weave", Phase.SCAN),
    ("node 3: brake-stuck", "weave", Phase.SCAN),
    ("node 3: encoder-frozen", "weave", Phase.SCAN),
    ("node 3: encoder-jump counts=200", "press", Phase.SCAN),
    ("node 3: zero-shift counts=200", "press", Phase.APPROACH),
    ("node 2: freeze", "weave", Phase.SCAN),
)
"""Faults that press hardest in lockstep, the task, and its phase."""


def stall(process: subprocess.Popen[bytes]) -> None:
    """Let a process stand still for a time."""
    process.send_signal(signal.SIGSTOP)
    vcan_cells.sleep(STALL_S)
    process.send_signal(signal.SIGCONT)


MASTER_KILLED, MASTER_STALLED = "master killed", "master stalled"
PROCESS_FAULTS: Mapping[str, Callable[[ChildProcess, ChildProcess], None]] = {
    MASTER_KILLED: lambda master, nodes: master.process.kill(),
    MASTER_STALLED: lambda master, nodes: stall(master.process),
    "nodes killed": lambda master, nodes: nodes.process.kill(),
    "link down": lambda master, nodes: vcan_cells.link("down"),
    "link down and up": lambda master, nodes: vcan_cells.replug(),
}
"""Kind of a fault → what it does to the process of the master and that of the nodes."""


@dataclass(frozen=True, slots=True)
class ProcessCase:
    """One run.

    Attributes:
        seed: number of the run.
        fault: key of `PROCESS_FAULTS`.
        after_s: time from the enabling of the drives to the fault.
    """

    seed: int
    fault: str
    after_s: float


def draw_process_case(seed: int) -> ProcessCase:
    """The case of a seed: the kinds take turns, the time is random, from the enabling to beyond the retreat."""
    kinds = tuple(PROCESS_FAULTS)
    return ProcessCase(seed, kinds[seed % len(kinds)], Random(f"vcan {seed}").uniform(0.0, HOLD_S + 1.0))


def run(*, quick: bool, sweep: Sweep) -> StudyResult:
    """Carry out the campaign: forty runs, or one of each kind with `quick`."""
    check_interface(CHANNEL)
    if (missing := missing_ip()) is not None:
        raise InterfaceError(f"{CHANNEL}: the study takes it down and up: {missing}")
    vcan_cells.link("up")  # a user who may not do that learns it before anything moves
    rows = []
    total = len(PROCESS_FAULTS) if quick else RUNS
    for seed in range(total):
        rows.append(row_of(draw_process_case(seed)))
        sweep.say(f"{seed + 1} of {total}: {rows[-1]['fault']}: {rows[-1]['failures'] or 'no failure'}")
    thrown = _throw_all(quick)
    drawn = partial(
        draw_by_name, [row | {"failed": bool(row["failures"])} for row in rows], "fault",
        ("ended_s", "from the fault to the end of the master (s)"), by="failed", log=False,
        title="How long the master took to end after processes were killed or stopped, or the link failed, on vcan0\n"
        "failed: it hung, or nodes moved or were enabled afterwards",
    )  # fmt: skip
    facts = vcan_cells.vcan_facts(quick, total, MISSED_SYNCS)
    return StudyResult("faults_vcan", rows, findings(rows), facts, drawn, more=(thrown,))


def findings(rows: Sequence[Mapping[str, object]]) -> list[str]:
    """The number of failures, and each of them."""
    failed = [row for row in rows if row["failures"]]
    return [
        f"{len(rows)} runs on {CHANNEL}, {len(failed)} failed.",
        *(f"seed {row['seed']}, {row['fault']}: {row['failures']}" for row in failed),
    ]


@cache
def served_scene() -> Scene:
    """A press whose nodes are a separate process, which outlives the master."""
    return vcan_cells.patient(load_scene("press", SERVED), MISSED_SYNCS)


def _throw_all(quick: bool) -> StudyResult:
    """Throw the faults that press hardest, each in a patient cell and in one as it is."""
    rows = [
        throw(text, task, phase, is_patient=is_patient)
        for text, task, phase in (THROWN[:QUICK_THROWN] if quick else THROWN)
        for is_patient in ((True,) if quick else (True, False))
    ]
    failed = [row for row in rows if row["failures"]]
    highest = max(row["force_max_n"] for row in rows)
    told = [f"{len(rows)} faults thrown on {CHANNEL}: highest true force {highest:.2f} N; {len(failed)} failed."]
    told += [f"{row['fault']}, {row['task']}, patient {row['patient']}: {row['failures']}" for row in failed]
    title = f"Highest true force with a fault thrown on {CHANNEL}"
    drawn = partial(draw_by_name, rows, "fault", FORCE_AXIS, title=title, by="patient")
    return StudyResult("faults_thrown", rows, told, measuring_facts(quick, len(rows)), drawn)


def throw(text: str, task: str, phase: Phase, *, is_patient: bool) -> Row:
    """Run a task, throw a fault in a phase of it, and score the true force."""
    scene = load_scene(task_scene(task, "ideal"), vcan_cells.ON_VCAN)
    session = Session(vcan_cells.patient(scene, MISSED_SYNCS) if is_patient else scene)
    work = make_task(session.plan)
    with ThreadPoolExecutor(1) as others:
        thrown: list[Future[Any]] = []

        def look(_: Measurement) -> None:
            if not thrown and getattr(work, "phase", None) is phase:
                thrown.append(others.submit(request_faults, CHANNEL, [text]))

        outcome, error = run_to_end(session, work, look)
    reason, limit = str(error or ""), session.plan.setup.limits.force_max
    rows = [(round(1e9 * t_s), force) for t_s, force in forces_of(session)]
    highest, left = max((force for _, force in rows), default=0.0), rows[-1][1] if rows else 0.0
    failures = [] if thrown else ["the fault was not thrown"]
    failures += [str(one.exception()) for one in thrown if one.exception() is not None]
    if outcome in ("crash", "hang"):
        failures.append(f"{outcome}: {reason}")
    if highest > FORCE_SHARE * limit:
        failures.append(f"true force of {highest:.2f} N, limit {limit:g} N")
    if outcome == "completed" and highest > limit:
        failures.append(f"completed, with a true force of up to {highest:.2f} N")
    return {
        "fault": text,
        "task": task,
        "phase": phase.name.lower(),
        "patient": is_patient,
        "force_max_n": highest,
        "above_ms": longest_above(rows, limit) * 1e-6,
        "left_n": left,
        "reason": reason or outcome,
        "failures": "; ".join(failures),
    }


def row_of(case: ProcessCase) -> Row:
    """Bring the cell up, let the fault happen, and score the end: the row of the case."""
    with vcan_cells.served(served_scene()) as nodes, running_master() as master:
        run = _ServedRun(case, master, nodes)
        try:
            status, ended_s, drives = run.carry_out()
        finally:
            vcan_cells.link("up")
    row = {"seed": case.seed, "fault": case.fault, "after_s": case.after_s}
    return row | {"status": status, "ended_s": ended_s, "drives": drives, "failures": "; ".join(run.failures)}


@contextmanager
def running_master() -> Iterator[ChildProcess]:
    """`canprobe run` of the served scene in its own process, which is killed where it outlives the block."""
    plan = make_plan(resolve(load_scene(vcan_cells.with_real_nodes(served_scene()), {"outputs.figures": False})))
    master = ChildProcess()
    master.launch(plan, ["canprobe", "run", str(master.scene_file), "--out", str(master.folder / "run")])
    try:
        yield master
    finally:
        master.process.kill()
        master.process.wait()
        master.remove()


class _ServedRun:
    """One case that is carried out."""

    def __init__(self, case: ProcessCase, master: ChildProcess, nodes: ChildProcess) -> None:
        self.case, self.master, self.nodes = case, master, nodes
        self.clock = MonotonicClock()
        self.failures: list[str] = []

    def carry_out(self) -> tuple[int | None, float, str]:
        """Status of the master (None: it hung), seconds from the fault to its end, states of the drives."""
        with closing(vcan_cells.open_vcan()) as port:
            if not self._await_enabled(port):
                self.failures.append("the drives were never enabled")
                return self.master.process.poll(), 0.0, ""
            vcan_cells.sleep(self.case.after_s)
        fault_ns = self.clock.now_ns()
        PROCESS_FAULTS[self.case.fault](self.master, self.nodes)
        status = None
        try:
            status = self.master.process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.failures.append(f"hang: the master still runs {PATIENCE_S:g} s after the fault")
        ended_s = (self.clock.now_ns() - fault_ns) * 1e-9
        vcan_cells.sleep(REACTION_S - ended_s)
        vcan_cells.link("up")
        drives = self._look()
        self.failures += score_end(self.case.fault, status, self.master.folder)
        return status, ended_s, drives

    def _await_enabled(self, port: Port) -> bool:
        """Wait until the first drive reports operation enabled."""
        deadline_ns = self.clock.now_ns() + round(PATIENCE_S * 1e9)
        while self.clock.now_ns() < deadline_ns and self.master.process.poll() is None:
            port.wait(self.clock.now_ns() + 50_000_000)
            for can_id, data, _ in port.drain():
                word = int.from_bytes(data[:2], "little")
                if can_id == _TPDO1 and state_of(word) is DriveState.OPERATION_ENABLED:
                    return True
        return False

    def _look(self) -> str:
        """The states of the drives, where their process still answers."""
        words = self._ask(0x6041) if self.nodes.process.poll() is None else {}
        if not words:
            if self.case.fault in (MASTER_KILLED, MASTER_STALLED):
                self.failures.append("the nodes ended with a master that is not their parent")
            return "gone"
        before = self._ask(0x6064)
        vcan_cells.sleep(APART_S)
        after = self._ask(0x6064)
        states = {node_id: state_of(word) for node_id, word in words.items()}
        for node_id, state in states.items():
            if state in POWERED_STATES:
                self.failures.append(f"node {node_id} is {state.name} after the stop")
            if abs(after[node_id] - before[node_id]) > MOST_COUNTS:
                self.failures.append(f"node {node_id} moves after the stop")
        codes = self._ask(0x603F) if DriveState.FAULT in states.values() else {}
        return ", ".join(sorted({_text_of(state, codes.get(node_id)) for node_id, state in states.items()}))

    def _ask(self, index: int) -> dict[int, int]:
        """An object of each drive; empty where one does not answer."""
        answers: dict[int, int] = {}

        def ask(node_id: int) -> Dialogue:
            answer = yield from upload(index, 0)
            answers[node_id] = int.from_bytes(answer, "little", signed=index == 0x6064)

        drives = served_scene().drives
        with suppress(CanprobeError, SdoCommunicationError), closing(vcan_cells.open_vcan()) as port:
            hold_dialogues(PumpedNetwork(port), {i: ask(i) for i in drives}, timeout_s=1.0, retries=1)
        return answers if len(answers) == len(drives) else {}


def score_end(fault: str, status: int | None, folder: Path) -> list[str]:
    """Failures in what a master left: its status, `ERRORS`, and `run/bus.log` and `run/summary.json` in `folder`."""
    failures = []
    killed = fault == MASTER_KILLED
    if status is not None and not killed and status not in (1, 3):
        failures.append(f"the master ended with status {status}, expected 1 or 3")
    errors = (folder / ERRORS).read_text(encoding="utf-8", errors="replace")
    if "Traceback" in errors:
        failures.append(f"crash: {errors.strip().splitlines()[-1]}")
    try:
        if not sum(1 for _ in read_candump(folder / "run" / "bus.log", whole=True)):
            failures.append("log: bus.log is empty")
        summary = folder / "run" / "summary.json"
        if not killed and json.loads(summary.read_text(encoding="utf-8"))["completed"]:
            failures.append("the summary says that the run was completed")
    except (CanprobeError, OSError, ValueError) as error:
        failures.append(f"log: {error}")
    return failures


def _text_of(state: DriveState, code: int | None) -> str:
    return f"{state.name} {code:04X}h" if state is DriveState.FAULT and code is not None else state.name
