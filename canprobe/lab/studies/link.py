"""Study `link`: whether `canprobe check` says of a link what the next minute of the cell shows.

Set-ups are constructed at the port in virtual time (`link_setups`), each from a seed. Each is checked for 10 s with its
drives disabled; then a new session of the same set-up holds the cell for 60 s, and shows what is true: fit, nothing
missed and at most 0.1 % overruns; unfit, the cell is stopped, cannot be brought up, or more than 2 % overrun; marginal
between. Thresholds were set on draw 0, one rule (late SYNCs that outlast the drives' patience) after nine set-ups of
draw 1; draw 2 was looked at once, and of draw 3 eleven set-ups. The study shows draw 4, which was looked at once.
Its second table has overruns at other rates (`link_rates`).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from canprobe.cell.master.controller import Command, Measurement
from canprobe.cell.master.options import RunOptions
from canprobe.cell.planning.make import make_plan
from canprobe.cell.results.picture import BLUE, INK, picture
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.check import measure_link, options_of_check
from canprobe.cell.session.session import Session
from canprobe.errors import CanprobeError
from canprobe.fieldbus.tools.link.verdict import FIT_SHARE, UNFIT_SHARE, Fitness
from canprobe.lab.studies import link_rates
from canprobe.lab.studies.link_rates import draw_rates, measure_machine
from canprobe.lab.studies.link_setups import construct, describe, draw_setup, scene_of
from canprobe.lab.studies.result import Column, Row, StudyResult, measuring_facts
from canprobe.lab.studies.sweep import Sweep

CHECK_S, MINUTE_S = 10.0, 60.0
SETUPS, QUICK_SETUPS = 40, 8
TEST_DRAW = 4
MODEL = (
    *("fieldbus/bus", "fieldbus/node", "fieldbus/drive", "fieldbus/tools/link", "cell/master", "cell/planning"),
    *("cell/session/check.py", "lab/studies/link.py", "lab/studies/link_setups.py", "lab/studies/link_rates.py"),
)
COLUMNS = (
    Column("seed", "seed"),
    Column("kind", "what is wrong"),
    Column("rate_hz", "Hz"),
    Column("size", "size", ".3g"),
    Column("verdict", "check"),
    Column("truth", "minute"),
    Column("cause", "cause"),
    Column("overruns_percent", "overruns, check %", ".2f"),
    Column("true_overruns_percent", "minute %", ".2f"),
    Column("missed", "missed, check"),
    Column("true_missed", "minute"),
    Column("ended", "ended by"),
)


def run(*, quick: bool, sweep: Sweep, draw: int = TEST_DRAW) -> StudyResult:
    """Check the set-ups of a draw, and hold each for a minute."""
    number = QUICK_SETUPS if quick else SETUPS
    seeds = [1000 * draw + i for i in range(number)]
    rows: list[Row] = list(sweep.map(measure, seeds, model=MODEL))
    facts = measuring_facts(quick, number, MODEL)
    machines = sweep.map(measure_machine, link_rates.cases(draw, quick=quick), model=MODEL)
    at_rates: list[Row] = [row for machine in machines for row in machine]
    found, draws = link_rates.findings(at_rates), partial(draw_rates, at_rates)
    more = StudyResult("link_rates", link_rates.COLUMNS, at_rates, found, facts, draws)
    return StudyResult("link", COLUMNS, rows, findings(rows), facts, partial(draw_rows, rows), (more,))


def measure(seed: int) -> dict[str, Any]:
    """Check one set-up, and hold it for a minute."""
    setup = draw_setup(seed)
    plan = make_plan(resolve(scene_of(setup)))
    session = Session(plan, options_of_check())
    construct(session, setup, 0)
    try:
        report = measure_link(session, CHECK_S)
        verdict, cause = report.verdict.fitness, report.verdict.cause
        missed, late = sum(one.missed for one in report.figures.answers), report.figures.late_share()
    except CanprobeError:
        verdict, cause, missed, late = Fitness.UNFIT, "", 0, 0.0
    session = Session(plan, RunOptions(rows_kept=100))
    construct(session, setup, 1)
    truth = _minute(session)
    return {
        **describe(setup),
        "verdict": str(verdict),
        "cause": cause,
        "overruns_percent": 100.0 * late,
        "missed": missed,
        **truth,
    }


def _minute(session: Session) -> dict[str, Any]:
    """What a minute of a held cell shows."""
    begin: list[tuple[int, int]] = []
    cycles = 0

    def hold(measurement: Measurement) -> Command:
        nonlocal cycles
        if not begin:
            begin.append(_counts(session))
        cycles += 1
        return Command(done=cycles * session.plan.sync.period_ns * 1e-9 >= MINUTE_S)

    ended = ""
    try:
        with session:
            session.run(hold)
    except CanprobeError as error:
        ended = str(error)
    overruns, missed = (now - then for now, then in zip(_counts(session), begin[0], strict=True)) if begin else (0, 0)
    share = overruns / max(1, cycles)
    if ended or share > UNFIT_SHARE:
        truth = Fitness.UNFIT
    else:
        truth = Fitness.MARGINAL if missed or share > FIT_SHARE else Fitness.FIT
    return {
        "truth": str(truth),
        "true_overruns_percent": 100.0 * share,
        "true_missed": missed,
        "ended": ended.split(";")[0][:80],
    }


def _counts(session: Session) -> tuple[int, int]:
    """Overruns, and answers of the drives that were missed."""
    cell = session.cell
    return cell.cycle.statistics.overruns if cell.cycle is not None else 0, cell.drives.missed if cell.drives else 0


def findings(rows: Sequence[Row]) -> list[str]:
    """The findings, as sentences with figures."""
    right = [row for row in rows if row["verdict"] == row["truth"]]
    dangerous = [row for row in rows if row["verdict"] == Fitness.FIT and row["truth"] == Fitness.UNFIT]
    bad = [row for row in rows if row["verdict"] != Fitness.FIT and row["truth"] != Fitness.FIT]
    named = [row for row in bad if row["cause"] == row["kind"]]
    whole = [row for row in rows if not row["ended"]]  # a cell that stopped has too few cycles to compare
    late = [row for row in whole if row["overruns_percent"] > 0.0 and row["true_overruns_percent"] > 0.0]
    ratios = sorted(row["overruns_percent"] / row["true_overruns_percent"] for row in late)
    lines = [
        f"{len(right)} of {len(rows)} set-ups are judged as the next minute shows them",
        f"{len(dangerous)} set-ups that stop the cell are called fit",
        f"the cause is right in {len(named)} of {len(bad)} that are not fit",
    ]
    if ratios:
        lines.append(f"overruns are predicted within × {ratios[0]:.2f} to × {ratios[-1]:.2f}, {len(ratios)} set-ups")
    return lines


def draw_rows(rows: Sequence[Row], path: Path) -> None:
    """Predicted overruns over those of the minute."""
    with picture(path, "Overruns that a check predicts, and those of the next minute", 4.0) as figure:
        axes = figure.subplots()
        axes.loglog(
            [max(0.01, row["true_overruns_percent"]) for row in rows],
            [max(0.01, row["overruns_percent"]) for row in rows],
            "o",
            color=BLUE,
        )
        axes.plot([0.01, 100.0], [0.01, 100.0], color=INK, linewidth=0.8)
        axes.set_xlabel("overruns in the minute, %")
        axes.set_ylabel("overruns in the check, %")
