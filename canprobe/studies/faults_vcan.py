"""Study `faults` on a real vcan0: processes are killed or stalled, the interface goes down and comes back.

`canprobe vcan -- canprobe study faults --vcan`. A run fails where a drive has power or moves two seconds after the
fault, where the master does not end by itself, or where it leaves no readable log behind. The nodes are a process of
their own, which outlives the master: they must stop by themselves. Nodes whose interface goes down end with it.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from random import Random
from typing import Any

from canprobe.bus.socketcan import check_interface
from canprobe.studies.fault_processes import CHANNEL, HOLD_S, PATIENCE, ProcessCase, ProcessFault, carry_out
from canprobe.studies.study import Column, StudyResult
from canprobe.studies.study_files import measuring_facts
from canprobe.studies.sweep import Sweep

RUNS = 40
COLUMNS = (
    Column("seed", "seed", "d"),
    Column("fault", "fault"),
    Column("after_s", "after s", ".2f"),
    Column("status", "master's status"),
    Column("ended_s", "ended within s", ".2f"),
    Column("drives", "drives afterwards"),
    Column("failures", "failures"),
)


def draw_process_case(seed: int) -> ProcessCase:
    """The case of a seed: the kinds take turns, the time is random, from the enabling to beyond the retreat."""
    kinds = tuple(ProcessFault)
    return ProcessCase(seed, kinds[seed % len(kinds)], Random(f"vcan {seed}").uniform(0.0, HOLD_S + 1.0))


def run(*, quick: bool, sweep: Sweep) -> StudyResult:
    """Carry out the campaign: forty runs, or one of each kind with `quick`."""
    check_interface(CHANNEL)
    rows = []
    total = len(ProcessFault) if quick else RUNS
    for seed in range(total):
        rows.append(row_of(draw_process_case(seed)))
        sweep.say(f"{seed + 1} of {total}: {rows[-1]['fault']}: {rows[-1]['failures'] or 'as it should be'}")
    return StudyResult(
        "faults",
        COLUMNS,
        rows,
        findings(rows),
        measuring_facts(quick, total) | {"interface": CHANNEL, **PATIENCE},
        lambda path: _draw(rows, path),
    )


def row_of(case: ProcessCase) -> dict[str, Any]:
    """Carry out one case."""
    with tempfile.TemporaryDirectory(prefix="canprobe-faults-") as folder:
        result = carry_out(case, Path(folder))
    return {
        "seed": case.seed,
        "fault": case.fault.value,
        "after_s": case.after_s,
        "status": result.status,
        "ended_s": result.ended_s,
        "drives": result.drives,
        "failures": "; ".join(result.failures),
    }


def findings(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """What the campaign says."""
    failed = [row for row in rows if row["failures"]]
    return [
        f"{len(rows)} runs on {CHANNEL}, {len(failed)} failed.",
        *(f"seed {row['seed']}, {row['fault']}: {row['failures']}" for row in failed),
    ]


def _draw(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    from canprobe.studies.faults_figure import draw_ends

    draw_ends(rows, path)
