"""Study `faults`: ten thousand short touches in lockstep, each with faults drawn from its seed, each scored.

A run is a press or a short scan over emulated nodes that drop, delay, double, corrupt and swap frames, become mute or
deaf, reboot, freeze, babble or send wrong data, at random times in bring-up, approach, scan, retreat and stop. It fails
where the true force stays above the limit for longer than the reaction may take, where anything moves or has power
after the stop, where it does not end, where the log is incomplete, or where it raises anything but an error of
canprobe. `canprobe study faults --seed N` carries out one run again and prints what happens in it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from canprobe.lab.studies.fault_cases import DRAWN_KINDS, PHASES
from canprobe.lab.studies.fault_runs import draw_case, run_seed
from canprobe.lab.studies.fault_scenes import COLOURS, FORCE_MAX_N, draw_faults
from canprobe.lab.studies.harness import Column, Row, Say, StudyResult
from canprobe.lab.studies.result_files import measuring_facts
from canprobe.lab.studies.sweep import Sweep

RUNS, QUICK_RUNS, SEEDS_A_CELL = 10_000, 8, 20
COLUMNS = (
    Column("fault", "fault"),
    Column("runs", "runs", "d"),
    *(Column(phase, phase, "d") for phase in PHASES),
    *(Column(outcome, outcome, "d") for outcome in COLOURS),
    Column("force_max_n", "highest force N", ".2f"),
    Column("above_ms", "longest above limit ms", ".0f"),
    Column("failures", "failures", "d"),
)


@dataclass(frozen=True, slots=True)
class Seeds:
    """One cell of the sweep: some runs in a row, so that a process does not load everything for a single one."""

    first: int
    count: int


def measure(seeds: Seeds) -> list[dict[str, Any]]:
    """The runs of some seeds."""
    return [run_seed(seed) for seed in range(seeds.first, seeds.first + seeds.count)]


def run(*, quick: bool, sweep: Sweep) -> StudyResult:
    """Carry out the campaign."""
    total = QUICK_RUNS if quick else RUNS
    size = min(total, SEEDS_A_CELL)
    cells = [Seeds(first, min(size, total - first)) for first in range(0, total, size)]
    runs = [one for answer in sweep.map(measure, cells) for one in answer]
    facts = measuring_facts(quick, total)
    return StudyResult("faults", COLUMNS, table_rows(runs), findings(runs), facts, partial(draw_faults, runs))


def table_rows(runs: Sequence[Mapping[str, Any]]) -> list[Row]:
    """A row for each kind of fault (a run with two kinds is in both), and one for all."""
    kinds = [(kind, [r for r in runs if kind in r["kinds"]]) for kind in DRAWN_KINDS]
    return [_row(name, some) for name, some in [*kinds, ("all", list(runs))]]


def _row(name: str, runs: Sequence[Mapping[str, Any]]) -> Row:
    phases = Counter(one["phase"] for one in runs)
    pressing = pressing_runs(runs)
    outcomes = Counter(one["outcome"] for one in runs)
    return {
        "fault": name,
        "runs": len(runs),
        **{phase: phases[phase] for phase in PHASES},
        **{outcome: outcomes[outcome] for outcome in COLOURS},
        "force_max_n": max((one["force_max_n"] for one in pressing), default=0.0),
        "above_ms": max((one["above_ms"] for one in pressing), default=0.0),
        "failures": sum(bool(one["failures"]) for one in runs),
    }


def pressing_runs(runs: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Runs in which the cell presses and its force is judged: in `listen` somebody else presses."""
    return [one for one in runs if one["force_bound_n"] is not None]


def findings(runs: Sequence[Mapping[str, Any]]) -> list[str]:
    """The figures of the campaign, and every failure with the command that runs it again."""
    failed = [one for one in runs if one["failures"]]
    hit = sum(one["hits"] > 0 for one in runs)
    pressing = pressing_runs(runs)
    above = [one["above_ms"] for one in pressing if one["above_ms"] > 0]
    lines = [
        f"{len(runs)} runs, {hit} of them with at least one frame or node hit; {len(failed)} failed.",
        f"The cell presses in {len(pressing)} runs: true force above the scene's limit of {FORCE_MAX_N:g} N in"
        f" {len(above)}, for {max(above, default=0):.0f} ms at most, highest"
        f" {max((one['force_max_n'] for one in pressing), default=0.0):.2f} N.",
    ]
    lines += [
        f"seed {one['seed']}: {'; '.join(one['failures'])} (canprobe study faults --seed {one['seed']})"
        for one in failed[:20]
    ]
    return lines if len(failed) <= 20 else [*lines, f"… and {len(failed) - 20} more failures"]


def replay(seed: int, say: Say) -> dict[str, Any]:
    """Carry out the run of one seed again and report what happens in it."""
    case = draw_case(seed)
    say(f"seed {seed}: {case.scenario}")
    for fault in case.faults:
        say(f"  {fault}")
    outcome = run_seed(seed)
    say(f"  {outcome['hits']} hits; {outcome['outcome']} at {outcome['end_s']:.3f} s {outcome['reason']}")
    say(f"  highest force {outcome['force_max_n']:.2f} N, above the limit for {outcome['above_ms']:.0f} ms")
    for failure in outcome["failures"]:
        say(f"  FAILURE: {failure}")
    return outcome
