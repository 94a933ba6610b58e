"""Study `faults` on a real vcan0: processes are killed or stalled, the interface goes down and comes back.

`canprobe vcan -- canprobe study faults --vcan`. A run fails where a drive has power or moves two seconds after the
fault, where the master does not end, or where it leaves no readable log. The nodes are a separate process, which
outlives the master: they must stop by themselves. Nodes whose interface goes down end with it.

A second table has the faults of the registry that press hardest, thrown as `canprobe inject` throws them, in a cell as
it is and in a patient one (`--patient`), and the true force of the plant.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from enum import Enum
from functools import cache, partial
from pathlib import Path
from random import Random
from typing import Any

from canopen.sdo.exceptions import SdoCommunicationError

from canprobe.cell.master.controller import Measurement
from canprobe.cell.planning.make import make_plan
from canprobe.cell.scene.load import dump_scene, load_scene
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.child_process import EmulatorChild, with_our_imports
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.cell.tasks.task import Phase
from canprobe.errors import CanprobeError, InterfaceError
from canprobe.fieldbus.bus.candump import read_candump
from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.fieldbus.bus.port import Port
from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.bus.real.link import missing_ip
from canprobe.fieldbus.bus.real.opening import open_port
from canprobe.fieldbus.bus.real.socketcan import check_interface
from canprobe.fieldbus.bus.sdo import hold_dialogues, upload
from canprobe.fieldbus.protocol.cia402 import POWERED_STATES, DriveState, state_of
from canprobe.fieldbus.tools.faults.control import request_faults
from canprobe.lab.studies.fault_cases import task_scene
from canprobe.lab.studies.fault_runs import FORCE_SHARE
from canprobe.lab.studies.figure import FORCE_AXIS, draw_by_name
from canprobe.lab.studies.realtime_cases import ON_VCAN, patient, vcan_facts, with_real_nodes
from canprobe.lab.studies.recover_score import forces_of
from canprobe.lab.studies.result import CHANNEL, Row, StudyResult, measuring_facts
from canprobe.lab.studies.sweep import Sweep
from canprobe.lab.studies.witnessed_run import longest_above, run_to_end

RUNS, QUICK_THROWN = 40, 1
HOLD_S = 3.0
SERVED: Mapping[str, Any] = {
    **ON_VCAN,
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
COLUMNS = ("seed", "fault", "after_s", "status", "ended_s", "drives", "failures")


THROWN_COLUMNS = ("fault", "task", "phase", "patient", "force_max_n", "above_ms", "left_n", "reason", "failures")
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


class ProcessFault(Enum):
    """Kind of a fault on vcan0."""

    MASTER_KILLED = "master killed"
    MASTER_STALLED = "master stalled"
    NODES_KILLED = "nodes killed"
    LINK_DOWN = "link down"
    LINK_DOWN_UP = "link down and up"


@dataclass(frozen=True, slots=True)
class ProcessCase:
    """One run.

    Attributes:
        seed: number of the run.
        fault: kind of the fault.
        after_s: time from the enabling of the drives to the fault.
    """

    seed: int
    fault: ProcessFault
    after_s: float


def draw_process_case(seed: int) -> ProcessCase:
    """The case of a seed: the kinds take turns, the time is random, from the enabling to beyond the retreat."""
    kinds = tuple(ProcessFault)
    return ProcessCase(seed, kinds[seed % len(kinds)], Random(f"vcan {seed}").uniform(0.0, HOLD_S + 1.0))


def run(*, quick: bool, sweep: Sweep) -> StudyResult:
    """Carry out the campaign: forty runs, or one of each kind with `quick`."""
    check_interface(CHANNEL)
    if (missing := missing_ip()) is not None:
        raise InterfaceError(f"{CHANNEL}: the study takes it down and up: {missing}")
    link("up")  # a user who may not do that learns it before anything moves
    rows = []
    total = len(ProcessFault) if quick else RUNS
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
    facts = vcan_facts(quick, total, MISSED_SYNCS)
    return StudyResult("faults_vcan", COLUMNS, rows, findings(rows), facts, drawn, (thrown,))


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
    return patient(load_scene("press", SERVED), MISSED_SYNCS)


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
    return StudyResult("faults_thrown", THROWN_COLUMNS, rows, told, measuring_facts(quick, len(rows)), drawn)


def throw(text: str, task: str, phase: Phase, *, is_patient: bool) -> Row:
    """Run a task, throw a fault in a phase of it, and score the true force."""
    scene = load_scene(task_scene(task, "ideal"), ON_VCAN)
    session = Session(patient(scene, MISSED_SYNCS) if is_patient else scene)
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
    with tempfile.TemporaryDirectory(prefix="canprobe-faults-") as folder:
        run = _ServedRun(case, EmulatorChild(make_plan(resolve(served_scene())), None, (CHANNEL,)), Path(folder))
        try:
            status, ended_s, drives = run.carry_out()
        finally:
            link("up")
            run.close()
    return {
        "seed": case.seed,
        "fault": case.fault.value,
        "after_s": case.after_s,
        "status": status,
        "ended_s": ended_s,
        "drives": drives,
        "failures": "; ".join(run.failures),
    }


class _ServedRun:
    """One case that is carried out."""

    def __init__(self, case: ProcessCase, child: EmulatorChild, folder: Path) -> None:
        self.case, self.child, self.folder = case, child, folder
        self.clock = MonotonicClock()
        self.master: subprocess.Popen[bytes] | None = None
        self.failures: list[str] = []

    def carry_out(self) -> tuple[int | None, float, str]:
        """Status of the master (None: killed after a hang), seconds from the fault to its end, states of the drives."""
        port = self._open()
        try:
            self.child.start()
            self.child.await_boot_ups(port)
            self.master = self._start_master()
            if not self._await_enabled(port, self.master):
                self.failures.append("the drives were never enabled")
                return self.master.poll(), 0.0, ""
            sleep(self.case.after_s)
        finally:
            port.close()
        fault_ns = self.clock.now_ns()
        self._let_happen(self.master)
        status = None
        try:
            status = self.master.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.failures.append(f"hang: the master still runs {PATIENCE_S:g} s after the fault")
        ended_s = (self.clock.now_ns() - fault_ns) * 1e-9
        sleep(REACTION_S - ended_s)
        link("up")
        drives = self._look()
        self.failures += score_end(self.case.fault, status, self.folder)
        return status, ended_s, drives

    def close(self) -> None:
        """Leave no process behind."""
        if self.master is not None and self.master.poll() is None:
            self.master.kill()
            self.master.wait()
        self.child.end()

    def _open(self) -> Port:
        return open_port("socketcan", CHANNEL, 1_000_000, self.clock)

    def _start_master(self) -> subprocess.Popen[bytes]:
        scene = with_real_nodes(served_scene())
        path = self.folder / "scene.toml"
        path.write_text(dump_scene(replace(scene, outputs=replace(scene.outputs, figures=False))), encoding="utf-8")
        command = [sys.executable, "-P", "-m", "canprobe", "run", str(path), "--out", str(self.folder / "run")]
        with (self.folder / "stderr").open("wb") as errors:
            return subprocess.Popen(
                command,
                env=with_our_imports(),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=errors,
            )

    def _await_enabled(self, port: Port, master: subprocess.Popen[bytes]) -> bool:
        """Wait until the first drive reports operation enabled."""
        deadline_ns = self.clock.now_ns() + round(PATIENCE_S * 1e9)
        while self.clock.now_ns() < deadline_ns and master.poll() is None:
            port.wait(self.clock.now_ns() + 50_000_000)
            for can_id, data, _ in port.drain():
                word = int.from_bytes(data[:2], "little")
                if can_id == _TPDO1 and state_of(word) is DriveState.OPERATION_ENABLED:
                    return True
        return False

    def _let_happen(self, master: subprocess.Popen[bytes]) -> None:
        match self.case.fault:
            case ProcessFault.MASTER_KILLED:
                master.kill()
            case ProcessFault.MASTER_STALLED:
                master.send_signal(signal.SIGSTOP)
                sleep(STALL_S)
                master.send_signal(signal.SIGCONT)
            case ProcessFault.NODES_KILLED:
                os.kill(self.child.pid, signal.SIGKILL)
            case ProcessFault.LINK_DOWN:
                link("down")
            case ProcessFault.LINK_DOWN_UP:
                link("down")
                link("up")

    def _look(self) -> str:
        """The states of the drives, where their process still answers."""
        first: dict[int, int] = {}
        if Path(f"/proc/{self.child.pid}").exists():
            with contextlib.suppress(CanprobeError):
                first = self._ask(0x6041)
        if not first:
            if self.case.fault in (ProcessFault.MASTER_KILLED, ProcessFault.MASTER_STALLED):
                self.failures.append("the nodes ended with a master that is not their parent")
            return "gone"
        before = self._ask(0x6064)
        sleep(APART_S)
        after = self._ask(0x6064)
        states = {node_id: state_of(word) for node_id, word in first.items()}
        for node_id, state in states.items():
            if state in POWERED_STATES:
                self.failures.append(f"node {node_id} is {state.name} after the stop")
            if abs(after[node_id] - before[node_id]) > MOST_COUNTS:
                self.failures.append(f"node {node_id} moves after the stop")
        codes = self._ask(0x603F) if DriveState.FAULT in states.values() else {}
        return ", ".join(sorted({_text_of(state, codes.get(node_id)) for node_id, state in states.items()}))

    def _ask(self, index: int) -> dict[int, int]:
        """An object of each drive; empty where one does not answer."""
        drives = served_scene().drives
        port = self._open()
        answers: dict[int, int] = {}
        try:
            dialogues = {node_id: _read(index, node_id, answers.__setitem__) for node_id in drives}
            hold_dialogues(PumpedNetwork(port), dialogues, timeout_s=1.0, retries=1)
        finally:
            port.close()
        return answers if len(answers) == len(drives) else {}


def score_end(fault: ProcessFault, status: int | None, folder: Path) -> list[str]:
    """Failures in what a master left: its status, `stderr`, and `run/bus.log` and `run/summary.json` in `folder`."""
    failures = []
    killed = fault is ProcessFault.MASTER_KILLED
    if status is not None and not killed and status not in (1, 3):
        failures.append(f"the master ended with status {status}, expected 1 or 3")
    errors = (folder / "stderr").read_text(encoding="utf-8", errors="replace")
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


def _read(index: int, node_id: int, keep: Callable[[int, int], None]) -> Generator[bytes | None, bytes, None]:
    try:
        keep(node_id, int.from_bytes((yield from upload(index, 0)), "little", signed=index == 0x6064))
    except SdoCommunicationError:
        return


def _text_of(state: DriveState, code: int | None) -> str:
    return f"{state.name} {code:04X}h" if state is DriveState.FAULT and code is not None else state.name


def sleep(seconds: float) -> None:
    """Sleep for some time, s; not at all for a negative one."""
    clock = MonotonicClock()
    clock.sleep_until_ns(clock.now_ns() + max(0, round(seconds * 1e9)))


def link(state: str) -> None:
    """Take the interface down or up.

    Raises:
        InterfaceError: the right to do so is missing.
    """
    done = subprocess.run(["ip", "link", "set", CHANNEL, state], capture_output=True, text=True, check=False)
    if done.returncode:
        raise InterfaceError(
            f"{CHANNEL}: the study takes it down and up, and `ip` says: {done.stderr.strip()}; run the study as root"
        )
