"""Study `realtime --link`: whether `canprobe check` says of a link what the next minute of the cell shows.

Set-ups are constructed at the port in virtual time (`link_setups`), each from a seed. Each is checked for 10 s with its
drives disabled; then a new session of the same set-up holds the cell for 60 s, and shows what is true: fit, nothing
missed and at most 0.1 % overruns; unfit, the cell is stopped, cannot be brought up, or more than 2 % overrun; marginal
between. Thresholds were set on draw 0, one rule (late SYNCs that outlast the drives' patience) after nine set-ups of
draw 1; draw 2 was looked at once, and of draw 3 eleven set-ups. The study shows draw 4, which was looked at once.

Its second table has overruns that a check at 400 Hz predicts for 100 to 1000 Hz, beside those of a minute at each rate.
The bus is faster than CAN there, so that it carries 1000 Hz; the drives wait for their master, and no late cycle stops
the cell.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

from canprobe.cell.master.controller import Command, Measurement
from canprobe.cell.master.options import RunOptions
from canprobe.cell.scene.model import Scene
from canprobe.cell.session.check import measure_link, options_of_check
from canprobe.cell.session.session import Session
from canprobe.errors import CanprobeError
from canprobe.fieldbus.tools.link.verdict import FIT_SHARE, UNFIT_SHARE, Fitness
from canprobe.lab.studies.figure import draw_points
from canprobe.lab.studies.link_setups import MACHINE_HZ, construct, draw_machine, draw_setup, scene_at
from canprobe.lab.studies.result import Row, StudyResult, measuring_facts
from canprobe.lab.studies.sweep import Sweep
from canprobe.lab.studies.vcan_cells import on_any_bitrate, patient

CHECK_S, MINUTE_S, QUICK_MINUTE_S = 10.0, 60.0, 10.0
SETUPS, QUICK_SETUPS, MACHINES, QUICK_MACHINES = 40, 8, 6, 3
TEST_DRAW = 4
RATES_HZ = (100, 200, 400, 800, 1000)
ENOUGH = 25
"""Late SYNCs in the check from which a share is compared: fewer are scattered by chance by more than a fifth."""
MODEL = (
    *("fieldbus/bus", "fieldbus/node", "fieldbus/drive", "fieldbus/tools/link", "cell/master", "cell/planning"),
    *("cell/session/check.py", "lab/studies/realtime_link.py", "lab/studies/link_setups.py"),
)
COLUMNS = (
    "seed", "kind", "rate_hz", "size", "verdict", "truth", "cause", "overruns_percent", "true_overruns_percent",
    "missed", "true_missed", "ended",
)  # fmt: skip
RATE_COLUMNS = ("seed", "kind", "rate_hz", "late", "predicted_percent", "seen_percent", "ratio")


def run(*, quick: bool, sweep: Sweep, draw: int = TEST_DRAW) -> StudyResult:
    """Check the set-ups of a draw, and hold each for a minute; then the machines of a draw at each rate."""
    number = QUICK_SETUPS if quick else SETUPS
    rows: list[Row] = sweep.map(measure, [1000 * draw + i for i in range(number)], model=MODEL)
    machines, minute_s = (QUICK_MACHINES, QUICK_MINUTE_S) if quick else (MACHINES, MINUTE_S)
    cases = [(900 * draw + i, minute_s) for i in range(machines)]
    rates: list[Row] = [row for some in sweep.map(measure_machine, cases, model=MODEL) for row in some]
    facts = measuring_facts(quick, number, MODEL)
    drawn = partial(
        draw_points, rows, ("true_overruns_percent", "overruns in the minute, %"),
        ("overruns_percent", "overruns in the check, %"), log=True, lines=((1.0, "as predicted"),),
        title="Overruns that a check predicts, and those of the next minute",
    )  # fmt: skip
    drawn_rates = partial(
        draw_points, rates, ("seen_percent", "overruns in the minute, %"),
        ("predicted_percent", "overruns predicted, %"), by="kind", log=True, lines=((1.0, "as predicted"),),
        title="Overruns at other rates: predicted by a check at 400 Hz, and seen in a minute",
    )  # fmt: skip
    more = StudyResult("link_rates", rates, rate_findings(rates), facts, drawn_rates, RATE_COLUMNS)
    return StudyResult("link", rows, findings(rows), facts, drawn, COLUMNS, (more,))


class Held(NamedTuple):
    """What a hold of the cell shows: share of the cycles that overrun, missed answers, and why it ended early."""

    overruns: float
    missed: int
    ended: str


def hold(session: Session, seconds: float) -> Held:
    """Hold the cell for a time."""
    # overruns and missed answers at each cycle: those before the first are not of the hold
    seen: list[tuple[int, int]] = []

    def counts() -> tuple[int, int]:
        cell = session.cell
        return cell.cycle.statistics.overruns if cell.cycle is not None else 0, cell.drives.missed if cell.drives else 0

    def step(_: Measurement) -> Command:
        seen.append(counts())
        return Command(done=len(seen) * session.plan.sync.period_ns * 1e-9 >= seconds)

    ended = ""
    try:
        with session:
            session.run(step)
    except CanprobeError as error:
        ended = str(error)
    overruns, missed = (now - then for now, then in zip(counts(), seen[0], strict=True)) if seen else (0, 0)
    return Held(overruns / max(1, len(seen)), missed, ended)


def measure(seed: int) -> dict[str, Any]:
    """Check one set-up, and hold it for a minute."""
    setup = draw_setup(seed)
    session = Session(scene_at(setup.rate_hz), options_of_check())
    construct(session, setup, 0)
    try:
        report = measure_link(session, CHECK_S)
        verdict, cause = report.verdict.fitness, report.verdict.cause
        missed, late = sum(one.missed for one in report.figures.answers), report.figures.late_share()
    except CanprobeError:
        verdict, cause, missed, late = Fitness.UNFIT, "", 0, 0.0
    session = Session(session.plan, RunOptions(rows_kept=100))
    construct(session, setup, 1)
    held = hold(session, MINUTE_S)
    if held.ended or held.overruns > UNFIT_SHARE:
        truth = Fitness.UNFIT
    else:
        truth = Fitness.MARGINAL if held.missed or held.overruns > FIT_SHARE else Fitness.FIT
    return {
        "seed": seed,
        "kind": setup.kind,
        "rate_hz": setup.rate_hz,
        "size": setup.size,
        "verdict": str(verdict),
        "cause": cause,
        "overruns_percent": 100.0 * late,
        "missed": missed,
        "truth": str(truth),
        "true_overruns_percent": 100.0 * held.overruns,
        "true_missed": held.missed,
        "ended": held.ended.split(";")[0][:80],
    }


def measure_machine(case: tuple[int, float]) -> list[Row]:
    """Check a machine, by its seed, at one rate, and hold the cell at each rate for a length, s."""
    seed, minute_s = case
    machine = draw_machine(seed)
    session = Session(_patient_scene(MACHINE_HZ), options_of_check())
    construct(session, machine, 0)
    report = measure_link(session, CHECK_S)
    late = report.figures.late_share() * report.figures.cycles
    rows: list[Row] = []
    for rate_hz in RATES_HZ:
        session = Session(_patient_scene(rate_hz), RunOptions(rows_kept=100))
        construct(session, machine, rate_hz)
        predicted, held = report.verdict.overruns[float(rate_hz)], hold(session, minute_s)
        if held.ended:
            raise CanprobeError(held.ended)
        row = {"seed": seed, "kind": machine.kind, "rate_hz": rate_hz, "late": late}
        row |= {"predicted_percent": 100.0 * predicted, "seen_percent": 100.0 * held.overruns}
        rows.append(row | {"ratio": predicted / held.overruns if predicted and held.overruns else None})
    return rows


def _patient_scene(rate_hz: float) -> Scene:
    return on_any_bitrate(patient(scene_at(rate_hz)))


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


def rate_findings(rows: Sequence[Row]) -> list[str]:
    """How far the predictions lie from what was seen, of machines with enough late SYNCs, and of slow ones."""
    told = [row for row in rows if row["ratio"] is not None and (row["late"] >= ENOUGH or row["kind"] == "slow")]
    ratios = sorted(row["ratio"] for row in told)
    if not ratios:
        return ["no machine had late SYNCs"]
    near = sum(1 / 1.5 <= ratio <= 1.5 for ratio in ratios)
    unforeseen = sum(row["predicted_percent"] < 0.1 and row["seen_percent"] > 2.0 for row in rows)
    return [
        f"overruns at {RATES_HZ[0]} to {RATES_HZ[-1]} Hz, predicted by a check at {MACHINE_HZ} Hz: {near} of"
        f" {len(ratios)} within x 1.5 of what a minute shows, x {ratios[0]:.2f} to x {ratios[-1]:.2f}, of machines with"
        f" {ENOUGH} late SYNCs or more in the check; {unforeseen} of {len(rows)} with more than 2 % were not foreseen"
    ]
