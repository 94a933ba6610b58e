"""Study `faults --recover`: cells in lockstep that lose nodes or their bus by chance, and whether each comes back.

What is lost, when, for how long, alone or in pairs, follows from a seed, while the arm holds, moves, presses or scans
(`recover_cases`). A run fails where a drive is enabled with a target more than one count beside its position, where the
force exceeds the limit at another time than between loss and stop (study `faults` judges that time), where the cell
does not come back or takes more than a second from the boot-up of the last node to the hold, or where its log lacks a
cycle. Behind a loss without a boot-up the cell may take as long again as its nodes may take to stop. A stop that
somebody has to look at, such as a probe that is left pressing, is counted by itself. `canprobe study faults --recover
--seed N` carries out one run again; a failure is shrunk to the fewest losses that still fail.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from canprobe.cell.results.picture import BLUE, picture
from canprobe.lab.studies.recover_cases import SCENES, draw_case, shrink
from canprobe.lab.studies.recover_runs import run_case
from canprobe.lab.studies.result import Column, Row, Say, StudyResult, measuring_facts
from canprobe.lab.studies.sweep import Sweep

RUNS, QUICK_RUNS, SEEDS_A_CELL = 1000, 8, 20
COLUMNS = (
    Column("work", "while it"),
    Column("runs", "runs", "d"),
    Column("lost", "losses", "d"),
    Column("back", "came back", "d"),
    Column("refused", "somebody has to look", "d"),
    Column("jump_counts", "largest jump, counts", "d"),
    Column("force_max_n", "highest force N", ".2f"),
    Column("force_calm_n", "but for the stop N", ".2f"),
    Column("late_s", "longest from return to hold s", ".2f"),
    Column("rows_lost", "cycles without a row", "d"),
    Column("failures", "failures", "d"),
)


def run(*, quick: bool, sweep: Sweep) -> StudyResult:
    """Carry out the runs."""
    total = QUICK_RUNS if quick else RUNS
    cells = [list(range(first, min(total, first + SEEDS_A_CELL))) for first in range(0, total, SEEDS_A_CELL)]
    runs = [one for answer in sweep.map(measure, cells) for one in answer]
    rows = table_rows(runs)
    facts = measuring_facts(quick, total)
    return StudyResult("recover", COLUMNS, rows, findings(runs), facts, partial(draw_runs, runs))


def measure(seeds: Sequence[int]) -> list[dict[str, Any]]:
    """The runs of some seeds; a case that fails is shrunk."""
    return [_one(seed) for seed in seeds]


def _one(seed: int) -> dict[str, Any]:
    case = draw_case(seed)
    outcome = run_case(case)
    return {**outcome, "shrunk": str(shrink(case, run_case)) if outcome["failures"] else ""}


def replay(seed: int, say: Say) -> dict[str, Any]:
    """Carry out the run of one seed again, and report what happens in it; a failure is shrunk."""
    case = draw_case(seed)
    say(f"seed {seed}: {case}")
    with tempfile.TemporaryDirectory(prefix="canprobe-recover-") as folder:
        outcome = run_case(case, say, Path(folder))
    for failure in outcome["failures"]:
        say(f"FAILURE: {failure}")
    if outcome["failures"]:
        say(f"shrunk: {shrink(case, run_case)} (canprobe study faults --recover --seed {seed})")
    return outcome


def table_rows(runs: Sequence[Mapping[str, Any]]) -> list[Row]:
    """A row for each kind of work, and one for all."""
    return [_row(work, [run for run in runs if run["work"] == work]) for work in SCENES] + [_row("all", runs)]


def _row(name: str, runs: Sequence[Mapping[str, Any]]) -> Row:
    sums: Counter[str] = Counter()
    for run in runs:
        sums.update({key: int(run[key]) for key in ("lost", "back", "refused", "rows_lost")})
        sums["failures"] += bool(run["failures"])
    most = {
        key: max((run[key] for run in runs), default=0)
        for key in ("jump_counts", "force_max_n", "force_calm_n", "late_s")
    }
    return {
        "work": name,
        "runs": len(runs),
        **{key: sums[key] for key in ("lost", "back", "refused", "rows_lost", "failures")},
        **most,
    }


def findings(runs: Sequence[Mapping[str, Any]]) -> list[str]:
    """The figures, and every failure with the line that runs it again."""
    failed = [run for run in runs if run["failures"]]
    most = _row("all", runs)
    lines = [
        f"{len(runs)} runs with {most['lost']} losses: the cell came back from {most['back']}, in"
        f" {most['refused']} runs somebody has to look; {len(failed)} runs failed.",
        f"Largest distance of a first target from the position: {most['jump_counts']} counts; highest force:"
        f" {most['force_max_n']:.2f} N between loss and stop, {most['force_calm_n']:.2f} N else; longest time from the"
        f" last return to the hold: {most['late_s']:.2f} s; {most['rows_lost']} cycles without a row in the log.",
    ]
    for run in failed[:20]:
        seed, why = run["seed"], "; ".join(run["failures"])
        lines.append(f"seed {seed}: {run['shrunk']}: {why} (canprobe study faults --recover --seed {seed})")
    return lines


def draw_runs(runs: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Times from the last return to the hold."""
    with picture(path, "Time from the last return of what was lost to the hold", 3.0) as figure:
        axes = figure.subplots()
        axes.hist([run["late_s"] for run in runs if run["back"]], bins=40, color=BLUE)
        axes.set_xlabel("s")
        axes.set_ylabel("runs")
