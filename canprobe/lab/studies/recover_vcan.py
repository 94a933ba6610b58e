"""Study `faults --recover` on a real vcan0: the cases of `recover_score`, with nodes in their own process.

`canprobe vcan -- canprobe study faults --recover --vcan`. Faults are thrown as `canprobe inject` throws them, the
interface is taken down and up by `ip`, and the master stands still in its controller. The score is that of the study in
lockstep; first targets, boot-ups and SYNCs are read from the bus log, forces from the plant. Real time is not repeated
by a seed.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from canprobe.cell.master.options import RunOptions
from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.model import MASTER_NODE_ID, Plan
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.session import Session
from canprobe.fieldbus.bus.candump import read_candump
from canprobe.fieldbus.bus.real.socketcan import check_interface
from canprobe.fieldbus.protocol.cia402 import DriveState, known_state
from canprobe.fieldbus.protocol.frames import HEARTBEAT_BASE, SYNC_ID
from canprobe.fieldbus.protocol.pdo import PdoLayout
from canprobe.fieldbus.tools.faults.control import request_faults
from canprobe.lab.studies.faults_vcan import link, sleep
from canprobe.lab.studies.realtime_cases import LATE_PERCENT, patient
from canprobe.lab.studies.recover import COLUMNS, draw_runs, findings, table_rows
from canprobe.lab.studies.recover_score import (
    END_S,
    FIRST_SYNCS,
    REPLUG,
    SCENES,
    STALL,
    RecoverCase,
    RecoverScore,
    draw_case,
    forces_of,
)
from canprobe.lab.studies.result import CHANNEL, StudyResult, measuring_facts
from canprobe.lab.studies.sweep import Sweep

RUNS, QUICK_RUNS = 50, 2
MISSED_SYNCS = 40
"""Missed SYNCs that the drives bear: a guest stands still for tens of milliseconds, which is no fault of the cell."""
STATUSWORD, POSITION, TARGET = 0x6041, 0x6064, 0x607A


def run(*, quick: bool, sweep: Sweep) -> StudyResult:
    """Carry out the runs, one after the other; a case that fails is named, and not shrunk."""
    check_interface(CHANNEL)
    link("up")  # a user who may not do that learns it before anything moves
    runs, total = list[dict[str, Any]](), QUICK_RUNS if quick else RUNS
    for seed in range(total):
        case = draw_case(seed)
        with tempfile.TemporaryDirectory(prefix="canprobe-recover-") as folder:
            runs.append({**ServedRun(case, sweep.say, Path(folder)).outcome(), "shrunk": str(case)})
        sweep.say(f"{seed + 1} of {total}: {case}: {'; '.join(runs[-1]['failures']) or 'no failure'}")
    patience = {"missed_syncs": MISSED_SYNCS, "late_cycles_max_percent": LATE_PERCENT}
    facts = measuring_facts(quick, total) | {"interface": CHANNEL, **patience}
    return StudyResult("recover_vcan", COLUMNS, table_rows(runs), findings(runs), facts, partial(draw_runs, runs))


class ServedRun:
    """One run on vcan0.

    Args:
        case: what happens.
        say: called with each step.
        out: folder of the run's files.
    """

    def __init__(self, case: RecoverCase, say: Callable[[str], None], out: Path) -> None:
        on_bus = {"bus.interface": "socketcan", "bus.channel": CHANNEL}
        changes = {**on_bus, "scene.figures": False, "task.duration_s": END_S + 2.0}
        plan = make_plan(resolve(patient(load_scene(SCENES[case.work], changes), MISSED_SYNCS)))
        self._case, self._plan, self._out = case, plan, out
        self._score = RecoverScore(case, plan, say)
        self._session = Session(plan, RunOptions(out, lambda text: self._score.say(self._now_s(), text), recover=True))
        self._stalls: list[tuple[float, float]] = []
        try:
            with ThreadPoolExecutor() as self._others, self._session as session:
                self._score.carry_out(session, self._begin, self._now_or_stall)
        finally:
            link("up")

    def _now_s(self) -> float:
        """Time since the beginning of the log, s."""
        time_s = self._session.steps.time_s
        return time_s() if time_s is not None else 0.0

    def _now_or_stall(self) -> float:
        """The time; a stall that is due is slept through, in the controller."""
        now_s = self._now_s()
        for begin_s, end_s in [one for one in self._stalls if one[0] <= now_s]:
            self._stalls.remove((begin_s, end_s))
            sleep(end_s - now_s)
        return now_s

    def _begin(self) -> None:
        """Throw the faults of the nodes, and let the others happen at their time."""
        first_s, node_ids = self._score.first_s or 0.0, self._plan.node_ids
        self._stalls += [(first_s + o.after_s, first_s + o.ends_s) for o in self._case.outages if o.name == STALL]
        faults = [o.fault(node_id, o.after_s) for o in self._case.outages for node_id in o.nodes(node_ids)]
        if faults:
            self._others.submit(request_faults, CHANNEL, faults)
        for outage in self._case.outages:
            if outage.name == REPLUG:
                self._others.submit(_replug, outage.after_s, outage.lasts_ms * 1e-3)

    def outcome(self) -> dict[str, Any]:
        """What came of it, and what failed."""
        boot_ups: dict[int, list[float]] = {node_id: [] for node_id in self._plan.node_ids}
        watch, syncs = FirstTargets(self._plan), 0
        for t_ns, _, can_id, data in read_candump(self._out / "bus.log"):
            syncs += can_id == SYNC_ID
            watch.push(can_id, data)
            if HEARTBEAT_BASE < can_id < HEARTBEAT_BASE + MASTER_NODE_ID and data == b"\0":
                boot_ups[can_id - HEARTBEAT_BASE].append(t_ns * 1e-9)
        log = self._session.cell.log
        times_s = log.arrays()["t_s"].tolist() if len(log) else list[float]()
        return self._score.outcome(boot_ups, times_s, syncs, forces_of(self._session), watch.jump_counts)


class FirstTargets:
    """Distance of target and position in the first cycles after each enabling of a drive, from a log.

    Args:
        plan: plan of the cell.

    Attributes:
        jump_counts: largest distance, from the second enabling of a drive on.
    """

    def __init__(self, plan: Plan) -> None:
        drives = [pdo for pdo in plan.pdos if pdo.kind == "drive"]
        self._layouts: Mapping[int, tuple[int, PdoLayout]] = {p.cob_id: (p.node_id, p.layout) for p in drives}
        self._values: dict[int, dict[int, int]] = {pdo.node_id: {} for pdo in drives}
        self._ages: dict[int, tuple[int, int]] = dict.fromkeys(self._values, (-1, 0))
        self.jump_counts = 0

    def push(self, can_id: int, data: bytes) -> None:
        """Take a frame; a target is compared with the position that the drive reported before it."""
        node_id, layout = self._layouts.get(can_id, (0, None))
        if layout is None or len(data) != layout.length:
            return
        values = self._values[node_id]
        got = {entry.index: value for entry, value in zip(layout.signals, layout.unpack(data), strict=True)}
        values.update(got)
        age, times = self._ages[node_id]
        if STATUSWORD in got:
            enabled = known_state(got[STATUSWORD]) is DriveState.OPERATION_ENABLED
            self._ages[node_id] = (age + 1, times + (age < 0)) if enabled else (-1, times)
        elif TARGET in got and times > 1 and 0 <= age < FIRST_SYNCS and POSITION in values:
            self.jump_counts = max(self.jump_counts, abs(got[TARGET] - values[POSITION]))


def _replug(after_s: float, lasts_s: float) -> None:
    """Take the interface down for a time."""
    sleep(after_s)
    link("down")
    sleep(lasts_s)
    link("up")
