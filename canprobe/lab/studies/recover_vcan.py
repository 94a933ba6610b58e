"""Study `faults --recover` on a real vcan0: the cases of `recover_runs`, with nodes in their own process.

`canprobe vcan -- canprobe study faults --recover --vcan`. Faults are thrown as `canprobe inject` throws them, the
interface is taken down and up by `ip`, and the master stands still in its controller. The score is that of the study in
lockstep. Real time is not repeated by a seed.
"""

from __future__ import annotations

import tempfile
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from canprobe.cell.master.controller import Measurement
from canprobe.fieldbus.bus.real.socketcan import check_interface
from canprobe.fieldbus.tools.faults.control import request_faults
from canprobe.lab.studies.recover import COLUMNS, draw_runs, findings, table_rows
from canprobe.lab.studies.recover_runs import REPLUG, STALL, RecoverCase, RecoverRun, draw_case
from canprobe.lab.studies.result import Say, StudyResult
from canprobe.lab.studies.sweep import Sweep
from canprobe.lab.studies.vcan_cells import CHANNEL, ON_VCAN, link, patience, replug, sleep, vcan_facts

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
            one = ServedRun(case, Path(folder), sweep.say)
            one.carry_out()
            runs.append({**one.outcome(), "shrunk": str(case)})
        sweep.say(f"{seed + 1} of {total}: {case}: {'; '.join(runs[-1]['failures']) or 'no failure'}")
    facts = vcan_facts(quick, total, MISSED_SYNCS)
    return StudyResult("recover_vcan", table_rows(runs), findings(runs), facts, partial(draw_runs, runs), COLUMNS)


class ServedRun(RecoverRun):
    """One run on vcan0; for its arguments see `RecoverRun`."""

    def __init__(self, case: RecoverCase, out: Path, say: Say) -> None:
        super().__init__(case, {**ON_VCAN, **patience(MISSED_SYNCS)}, out, say)
        self._stalls: list[tuple[float, float]] = []

    def carry_out(self) -> None:
        try:
            with ThreadPoolExecutor() as self._others, self.session:
                super().carry_out()
        finally:
            link("up")

    def is_over(self, measurement: Measurement) -> bool:
        """See `RecoverRun.is_over`; a stall that is due is slept through, in the controller."""
        for begin_s, end_s in [one for one in self._stalls if one[0] <= self.now_s()]:
            self._stalls.remove((begin_s, end_s))
            sleep(end_s - self.now_s())
        return super().is_over(measurement)

    def lose(self) -> None:
        self._stalls += [
            (self.first_s + o.after_s, self.first_s + o.ends_s) for o in self.case.outages if o.name == STALL
        ]
        faults = [o.fault(node_id, o.after_s) for o in self.case.outages for node_id in o.nodes(self.plan.node_ids)]
        if faults:
            self._others.submit(request_faults, CHANNEL, faults)
        for outage in self.case.outages:
            if outage.name == REPLUG:
                self._others.submit(replug, outage.after_s, outage.lasts_ms * 1e-3)
