"""Study `faults --recover`: cells in lockstep that lose nodes or their bus by chance, and whether each comes back.

What is lost, when, for how long, alone or in pairs, follows from a seed, while the arm holds, moves, presses or scans
(`recover_runs`). A run fails where a drive is enabled with a target more than one count beside its position, where the
force exceeds the limit at another time than between loss and stop (study `faults` judges that time), where the cell
does not come back or takes more than a second from the boot-up of the last node to the hold, or where its log lacks a
cycle. Behind a loss without a boot-up the cell may take as long again as its nodes may take to stop. A stop that
somebody has to look at, such as a probe that is left pressing, is counted by itself. `canprobe study faults --recover
--seed N` carries out one run again; a failure is shrunk to the fewest losses that still fail.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from canprobe.cell.master.options import quiet
from canprobe.cell.results.picture import BLUE, picture
from canprobe.errors import InterfaceError
from canprobe.fieldbus.bus.port import Port
from canprobe.lab.studies.recover_runs import REPLUG, SCENES, STALL, RecoverCase, RecoverRun, draw_case, shrink
from canprobe.lab.studies.result import Row, Say, StudyResult, measuring_facts
from canprobe.lab.studies.sweep import Sweep

RUNS, QUICK_RUNS = 1000, 8
COLUMNS = (
    "work", "runs", "lost", "back", "refused", "jump_counts", "force_max_n", "force_calm_n", "late_s", "rows_lost",
    "failures",
)  # fmt: skip


def run(*, quick: bool, sweep: Sweep) -> StudyResult:
    """Carry out the runs."""
    total = QUICK_RUNS if quick else RUNS
    runs = sweep.map(measure, range(total))
    rows = table_rows(runs)
    facts = measuring_facts(quick, total)
    return StudyResult("recover", rows, findings(runs), facts, partial(draw_runs, runs), COLUMNS)


def measure(seed: int) -> dict[str, Any]:
    """The run of a seed; a case that fails is shrunk."""
    case = draw_case(seed)
    outcome = run_case(case)
    return {**outcome, "shrunk": str(shrink(case, run_case)) if outcome["failures"] else ""}


def replay(seed: int, say: Say) -> dict[str, Any]:
    """Carry out the run of one seed again, and report what happens in it; a failure is shrunk."""
    case = draw_case(seed)
    say(f"seed {seed}: {case}")
    outcome = run_case(case, say)
    for failure in outcome["failures"]:
        say(f"FAILURE: {failure}")
    if outcome["failures"]:
        say(f"shrunk: {shrink(case, run_case)} (canprobe study faults --recover --seed {seed})")
    return outcome


def table_rows(runs: Sequence[Mapping[str, Any]]) -> list[Row]:
    """A row for each kind of work, and one for all."""
    return [_row(work, [run for run in runs if run["work"] == work]) for work in SCENES] + [_row("all", runs)]


def _row(name: str, runs: Sequence[Mapping[str, Any]]) -> Row:
    most = ("jump_counts", "force_max_n", "force_calm_n", "late_s")
    return {
        "work": name,
        "runs": len(runs),
        **{key: sum(int(run[key]) for run in runs) for key in ("lost", "back", "refused", "rows_lost")},
        "failures": sum(bool(run["failures"]) for run in runs),
        **{key: max((run[key] for run in runs), default=0) for key in most},
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
        axes.set(xlabel="s", ylabel="runs")


class LockstepRun(RecoverRun):
    """One run in lockstep; for its arguments see `RecoverRun`."""

    def __init__(self, case: RecoverCase, out: Path, say: Say) -> None:
        super().__init__(case, {"bus.timed": False}, out, say)
        self._faulty = self.session.buses.world.make_faulty()
        self.session.around = self._disturbed
        self._away: list[tuple[int, int, bool]] = []
        """Times in which the master's interface is down, or the master stands still: begin and end, ns."""

    def lose(self) -> None:
        assert self.session.buses.lockstep is not None
        now_ns = self.session.buses.lockstep.clock.now_ns()
        for loss in self.case.outages:
            if loss.name in (REPLUG, STALL):
                begin_ns = now_ns + round(loss.after_s * 1e9)
                self._away.append((begin_ns, begin_ns + loss.lasts_ms * 1_000_000, loss.name == STALL))
            for node_id in loss.nodes(self.plan.node_ids):
                self._faulty.inject(loss.fault(node_id, loss.after_s), now_ns)

    def _disturbed(self, port: Port) -> Port:
        """The port of the master: it fails while its interface is down, and its calls do not return in a stall."""

        def around(method: Callable[..., Any]) -> Callable[..., Any]:
            def call(*arguments: Any) -> Any:
                for begin_ns, end_ns, stalls in self._away:
                    if begin_ns <= port.clock.now_ns() < end_ns:
                        if not stalls:
                            down = f"{port.channel}: interface is down; type: sudo ip link set {port.channel} up"
                            raise InterfaceError(down)
                        port.clock.sleep_until_ns(end_ns)
                return method(*arguments)

            return call

        for name in ("send_batch", "drain", "wait"):
            setattr(port, name, around(getattr(port, name)))
        return port


def run_case(case: RecoverCase, say: Say = quiet) -> dict[str, Any]:
    """Carry out a run: what came of it, and what failed; with the hash of the bus log."""
    with tempfile.TemporaryDirectory(prefix="canprobe-recover-") as folder:
        run = LockstepRun(case, Path(folder), say)
        with run.session:
            run.carry_out()
        log = hashlib.sha256((Path(folder) / "bus.log").read_bytes()).hexdigest()
        return {**run.outcome(), "bus_log_sha256": log}
