"""Study `faults`: every kind of fault in each task, phase and plant, and files that are wrong; the true force of each.

A run is a press, a weave, a straight path, an exploration or a calibration over emulated nodes, short but with all its
phases. One fault of the registry begins in one of them; the rest is drawn from the number of the run (`fault_cases`).
The true force of the plant is judged, and how the run ends (`fault_runs`). A second table has files that are wrong:
what arm, tool, layer or array are differs from what their file says, and the cell touches for the first time.
`canprobe study faults --seed N` carries out one run again and prints what happens in it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.cell.results.picture import AMBER, BLUE, GREEN, GREY, ORANGE, legend, log_scale, parts, picture
from canprobe.lab.studies.fault_cases import CASES, KINDS, TASKS, FaultCase, WrongFile, wrong_files
from canprobe.lab.studies.fault_runs import FORCE_SHARE, PRESSED_N, USUAL_SHARE, run_case, run_wrong_file
from canprobe.lab.studies.figure import FORCE_AXIS, draw_by_name
from canprobe.lab.studies.result import Row, Say, StudyResult, measuring_facts
from canprobe.lab.studies.sweep import Sweep

JOINTS = 6
QUICK_KINDS = ("stuck-image", "replayed-image", "gain-lost", "brake-stuck", "encoder-jump")
_QUICK_PLACES = (("press", "approach"), ("weave", "contact"))
QUICK_FILES = (WrongFile("true gear × ½", 3, "ideal"),)
COLOURS = {
    "completed": (GREEN, ""),
    "stopped for safety": (AMBER, "//"),
    "bus or node failure": (BLUE, "\\\\"),
    "bring-up refused": (GREY, "xx"),
}
"""Colour and hatch of each outcome; the others, `hang` and `crash`, are failures."""
FILE_COLUMNS = ("file", "joint", "plant", "force_max_n", "above_ms", "left_n", "outcome", "reason")
MOST_FAILURES = 20


def measure(number: int) -> dict[str, Any]:
    """The run of a number."""
    return run_case(FaultCase.of(number))


def quick_numbers() -> list[int]:
    """Kinds that are hard to notice, in the approach of a press and in the contact of a weave."""
    return [
        case.number
        for case in map(FaultCase.of, range(CASES))
        if case.plant == "ideal" and case.kind.name in QUICK_KINDS and (case.task, case.phase) in _QUICK_PLACES
    ]


def run(*, quick: bool, sweep: Sweep, draw: int = 0) -> StudyResult:
    """Carry out the campaign; each draw has every case, with other nodes, times and values."""
    numbers = quick_numbers() if quick else range(draw * CASES, (draw + 1) * CASES)
    runs = sweep.map(measure, numbers)
    touches = sweep.map(run_wrong_file, QUICK_FILES if quick else wrong_files(JOINTS))
    facts = measuring_facts(quick, len(numbers)) | {"draw": draw}
    title = "Highest true force of a first touch with a wrong file"
    drawn = partial(draw_by_name, touches, "file", FORCE_AXIS, title=title, by="plant")
    files = StudyResult("faults_files", touches, file_findings(touches), facts, drawn, FILE_COLUMNS)
    return StudyResult("faults", table_rows(runs), findings(runs), facts, partial(draw_runs, runs), more=(files,))


def table_rows(runs: Sequence[Mapping[str, Any]]) -> list[Row]:
    """A row for each kind of fault that ran, and one for all."""
    return [_row(name, some) for name, some in {**by_kind(runs), "all": runs}.items() if some]


def by_kind(runs: Sequence[Mapping[str, Any]]) -> dict[str, list[Mapping[str, Any]]]:
    """The runs of each kind of fault that ran."""
    found = {kind.name: [one for one in runs if one["kind"] == kind.name] for kind in KINDS}
    return {name: some for name, some in found.items() if some}


def _row(name: str, runs: Sequence[Mapping[str, Any]]) -> Row:
    outcomes = Counter(one["outcome"] for one in runs)
    worst = max(runs, key=lambda one: one["force_max_n"])
    noticed = [one["noticed_ms"] for one in runs if one["noticed_ms"] is not None]
    stopped = [one for one in runs if one["reason"]]
    left = [one["left_n"] for one in runs if one["left_n"] > PRESSED_N]
    by_task = {task: [one["force_max_n"] for one in runs if one["task"] == task] for task in TASKS}
    return {
        "fault": name,
        "runs": len(runs),
        "force_max_n": worst["force_max_n"],
        "worst": f"{worst['task']}, {worst['phase']}, {worst['plant']}",
        **{f"{task}_n": max(forces, default=None) for task, forces in by_task.items()},
        "above_ms": max(one["above_ms"] for one in runs),
        "noticed_ms": float(np.median(noticed)) if noticed else None,
        "noticed_max_ms": max(noticed, default=None),
        "unnoticed": len(runs) - len(noticed),
        **{outcome: outcomes[outcome] for outcome in COLOURS},
        "pressing": len(left),
        "left_n": max(left, default=None),
        "named": 100.0 * sum(one["named"] for one in stopped) / len(stopped) if stopped else None,
        "failures": sum(bool(one["failures"]) for one in runs),
    }


def findings(runs: Sequence[Mapping[str, Any]]) -> list[str]:
    """The figures of the campaign, and the failures with the command that runs each again."""
    failed = sorted((one for one in runs if one["failures"]), key=lambda one: -one["force_max_n"])
    shares = np.array([one["force_share"] for one in runs])
    highest, above = (max(one[key] for one in runs) for key in ("force_max_n", "above_ms"))
    hit = sum(one["hits"] > 0 for one in runs)
    kinds = {one["kind"] for one in failed}
    lines = [
        f"{len(runs)} runs, {hit} of them with at least one frame or node hit; {len(failed)} failed, of {len(kinds)} of"
        f" {len({one['kind'] for one in runs})} kinds of fault.",
        f"True force at most {USUAL_SHARE:g} × the limit in {np.mean(shares <= USUAL_SHARE):.2%} of the runs (99 %"
        f" wanted), highest {shares.max():.2f} × ({FORCE_SHARE:g} × allowed), {highest:.2f} N.",
        f"The longest time above the limit is {above:.0f} ms;"
        f" {sum(one['left_n'] > PRESSED_N for one in runs)} runs left the probe pressing.",
    ]
    lines += [
        f"{one['number']}: {one['task']}, {one['phase']}, {one['plant']}, {one['fault']}: {'; '.join(one['failures'])}"
        f" (canprobe study faults --seed {one['number']})"
        for one in failed[:MOST_FAILURES]
    ]
    return lines if len(failed) <= MOST_FAILURES else [*lines, f"… and {len(failed) - MOST_FAILURES} more failures"]


def file_findings(touches: Sequence[Mapping[str, Any]]) -> list[str]:
    """The worst first touch with each wrong file."""
    worst: dict[str, Mapping[str, Any]] = {}
    for one in touches:
        if one["force_max_n"] >= worst.get(one["file"], {"force_max_n": 0.0})["force_max_n"]:
            worst[one["file"]] = one
    places = {what: f"joint {one['joint']}, " if one["joint"] else "" for what, one in worst.items()}
    return [
        f"First touch, {what}: at most {one['force_max_n']:.2f} N ({places[what]}{one['plant']} plant),"
        f" {one['outcome']}."
        for what, one in worst.items()
    ]


def draw_runs(runs: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Draw how the runs with each kind of fault ended, and the true forces of each."""
    failed = sum(bool(one["failures"]) for one in runs)
    title = (
        f"How {len(runs)} runs with a fault of a node, a link, a drive or the array ended; {failed} failed:\n"
        "force, motion, power, log or report were not as promised"
    )
    found = by_kind(runs)
    with picture(path, title, 1.5 + 0.16 * len(found)) as figure:
        sides = parts(figure, 1, 2)
        left, right = (part.subplots() for part in sides)
        start = np.zeros(len(found))
        for outcome, (colour, hatch) in COLOURS.items():
            shares = np.array([np.mean([one["outcome"] == outcome for one in some]) for some in found.values()])
            if shares.any():
                left.barh(list(found), shares, left=start, color=colour, hatch=hatch, edgecolor="white", label=outcome)
            start += shares
        left.set(xlabel="share of the runs with this fault", xlim=(0, 1))
        for place, some in enumerate(found.values()):
            heights = [max(one["force_share"], 0.01) for one in some]
            right.plot(heights, [place] * len(some), ".", color=BLUE, ms=3, label="" if place else "a run")
        for share, style, label in ((USUAL_SHARE, "--", "99 % below"), (FORCE_SHARE, "-", "all below")):
            right.axvline(share, color=ORANGE, linestyle=style, label=f"{share:g} × the limit: {label}")
        log_scale(right, "x")
        right.set(xlabel="highest true force of a run, × the limit", yticks=range(len(found)), yticklabels=())
        for axes in (left, right):
            axes.set_ylim(len(found) - 0.5, -0.5)
            axes.grid(visible=False, axis="y")
        for part in sides:
            legend(part)


def replay(seed: int, say: Say) -> dict[str, Any]:
    """Carry out one run again and report what happens in it."""
    case = FaultCase.of(seed)
    say(f"run {seed}: {case.task}, {case.plant} plant, a fault in its {case.phase}")
    outcome = run_case(case)
    say(f"  {outcome['fault']}")
    noticed = "never" if outcome["noticed_ms"] is None else f"after {outcome['noticed_ms']:.0f} ms"
    ended = f"{outcome['outcome']} at {outcome['end_s']:.3f} s {outcome['reason']}"
    say(f"  {outcome['hits']} hits; noticed {noticed}; {ended}")
    say(f"  highest true force {outcome['force_max_n']:.2f} N, above the limit for {outcome['above_ms']:.0f} ms")
    say(f"  left with {outcome['left_n']:.2f} N")
    for failure in outcome["failures"]:
        say(f"  FAILURE: {failure}")
    return outcome
