"""Study `faults --recover` on a real vcan0: the cases of `recover_score`, with nodes in their own process.

`canprobe vcan -- canprobe study faults --recover --vcan`. Faults are thrown as `canprobe inject` throws them, the
interface is taken down and up by `ip`, and the master stands still in its controller. The score is that of the study in
lockstep. Real time is not repeated by a seed.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from canprobe.cell.master.options import RunOptions
from canprobe.cell.planning.make import make_plan
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.session import Session
from canprobe.fieldbus.bus.real.socketcan import check_interface
from canprobe.fieldbus.tools.faults.control import request_faults
from canprobe.lab.studies.faults_vcan import link, sleep
from canprobe.lab.studies.realtime_cases import ON_VCAN, patient, vcan_facts
from canprobe.lab.studies.recover import COLUMNS, draw_runs, findings, table_rows
from canprobe.lab.studies.recover_score import END_S, REPLUG, SCENES, STALL, RecoverCase, RecoverScore, draw_case
from canprobe.lab.studies.result import CHANNEL, StudyResult
from canprobe.lab.studies.sweep import Sweep

RUNS, QUICK_RUNS = 50, 2
MISSED_SYNCS = 40
"""Missed SYNCs that the drives bear: a guest stands still for tens of milliseconds, which is no fault of the cell."""


def run(*, quick: bool, sweep: Sweep) -> StudyResult:
    """Carry out the runs, one after the other; a case that fails is named, and not shrunk."""
    check_interface(CHANNEL)
    link("up")  # a user who may not do that learns it before anything moves
    runs, total = list[dict[str, Any]](), QUICK_RUNS if quick else RUNS
    for seed in range(total):
        case = draw_case(seed)
        with tempfile.TemporaryDirectory(prefix="canprobe-recover-") as folder:
            runs.append({**ServedRun(case, sweep.say, Path(folder)).outcome, "shrunk": str(case)})
        sweep.say(f"{seed + 1} of {total}: {case}: {'; '.join(runs[-1]['failures']) or 'no failure'}")
    facts = vcan_facts(quick, total, MISSED_SYNCS)
    return StudyResult("recover_vcan", COLUMNS, table_rows(runs), findings(runs), facts, partial(draw_runs, runs))


class ServedRun:
    """One run on vcan0.

    Args:
        case: what happens.
        say: called with each step.
        out: folder of the run's files.

    Attributes:
        outcome: what came of it, and what failed.
    """

    def __init__(self, case: RecoverCase, say: Callable[[str], None], out: Path) -> None:
        changes = {**ON_VCAN, "outputs.figures": False, "task.duration_s": END_S + 2.0}
        plan = make_plan(resolve(patient(load_scene(SCENES[case.work], changes), MISSED_SYNCS)))
        self._case, self._score = case, RecoverScore(case, plan, say)
        self._session = Session(plan, RunOptions(out, lambda text: self._score.say(self._now_s(), text), recover=True))
        self._stalls: list[tuple[float, float]] = []
        try:
            with ThreadPoolExecutor() as self._others, self._session as session:
                self._score.carry_out(session, self._begin, self._now_or_stall)
        finally:
            link("up")
        self.outcome = self._score.outcome(self._session)

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
        first_s, node_ids = self._score.first_s or 0.0, self._score.plan.node_ids
        self._stalls += [(first_s + o.after_s, first_s + o.ends_s) for o in self._case.outages if o.name == STALL]
        faults = [o.fault(node_id, o.after_s) for o in self._case.outages for node_id in o.nodes(node_ids)]
        if faults:
            self._others.submit(request_faults, CHANNEL, faults)
        for outage in self._case.outages:
            if outage.name == REPLUG:
                self._others.submit(_replug, outage.after_s, outage.lasts_ms * 1e-3)


def _replug(after_s: float, lasts_s: float) -> None:
    """Take the interface down for a time."""
    sleep(after_s)
    link("down")
    sleep(lasts_s)
    link("up")
