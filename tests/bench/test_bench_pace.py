"""What a cycle of `run cylinder` costs, as ratios that are measured in one go; run it with --benchmark-only -s.

Each figure comes from runs in processes of their own, one after the other in turn, so that what else the machine does
hits all of them. A cycle's cost is processor time from the first to the last cycle of the task, without bring-up; a
ratio is the median over the turns of the ratio within a turn. The reference is an older commit, taken from the history.
The table is that of docs/accuracy.md: `python docs/measure.py pace` writes it there.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from statistics import median

import pytest

ROOT = Path(__file__).parents[2]
REFERENCE = "c54f9ca"
TURNS = int(os.environ.get("CANPROBE_TURNS", "5"))
DURATION_S, PERIOD_US = 8.0, 2500.0
CHILD = """
import json, sys, tempfile
from time import perf_counter, process_time
import canprobe

began, last, cycles = None, None, 0
def progress(*_):
    global began, last, cycles
    if cycles % 50 == 0:  # reading a clock is dear in a virtual machine
        last = process_time(), perf_counter(), cycles
        began = began or last
    cycles += 1

interface, seconds = sys.argv[1], float(sys.argv[2])
where = {} if interface == "lockstep" else {"bus": interface}
with tempfile.TemporaryDirectory() as folder:
    canprobe.run(canprobe.load_scene("cylinder"), duration_s=seconds, progress=progress, out=folder + "/run", **where)
    end = process_time()
n = last[2] - began[2]
print(json.dumps({"us": 1e6 * (last[0] - began[0]) / n, "per_s": n / (last[1] - began[1]), "after_s": end - last[0]}))
"""


def started(tree: Path, interface: str) -> subprocess.Popen[str]:
    """A run of the package in a tree."""
    return subprocess.Popen(
        [sys.executable, "-c", CHILD, interface, str(DURATION_S)],
        cwd=tree,
        env={**os.environ, "PYTHONPATH": str(tree), "OPENBLAS_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        text=True,
    )


def measured(*runs: subprocess.Popen[str]) -> list[dict[str, float]]:
    """What they measured, once all of them have ended."""
    outputs = [run.communicate()[0] for run in runs]
    assert not any(run.returncode for run in runs)
    return [json.loads(output.splitlines()[-1]) for output in outputs]


@pytest.fixture
def reference(tmp_path):
    """The package as it was at the reference."""
    archive = subprocess.run(["git", "archive", REFERENCE], cwd=ROOT, capture_output=True, check=False)
    if archive.returncode:
        pytest.skip(f"commit {REFERENCE} is not in this clone's history: git fetch --unshallow")
    subprocess.run(["tar", "-x"], cwd=tmp_path, input=archive.stdout, check=True)
    return tmp_path


@pytest.mark.timeout(0)
def test_bench_pace(benchmark, reference):
    cores = len(os.sched_getaffinity(0))
    cases = {"reference": (reference, "lockstep"), "lockstep": (ROOT, "lockstep"), "direct": (ROOT, "direct")}
    turns = []

    def in_turn():
        for _ in range(TURNS):
            turn = {name: measured(started(*case))[0] for name, case in cases.items()}
            together = measured(*[started(ROOT, "direct") for _ in range(cores)])
            turns.append(turn | {"together": {"per_s": sum(run["per_s"] for run in together)}})

    benchmark.pedantic(in_turn, rounds=1)

    def ratio(key, over, under):
        return median(turn[over][key] / turn[under][key] for turn in turns)

    cost = {name: median(turn[name]["us"] for turn in turns) for name in cases}
    after = {name: median(turn[name]["after_s"] for turn in turns) for name in cases}
    rows = [
        (f"medians of {TURNS} turns, {DURATION_S:g} s of scan each", "measured", "goal"),
        *(
            (f"{name}, processor time a cycle", f"{us:.0f} µs, {PERIOD_US / us:.1f} × real time", "")
            for name, us in cost.items()
        ),
        (f"lockstep against {REFERENCE}", f"{ratio('us', 'reference', 'lockstep'):.2f} ×", "1.35 ×"),
        ("direct against timed lockstep", f"{ratio('us', 'lockstep', 'direct'):.2f} ×", "2 ×"),
        (f"direct against the lockstep of {REFERENCE}", f"{ratio('us', 'reference', 'direct'):.2f} ×", ""),
        (
            f"independent direct runs on {cores} cores",
            f"{ratio('per_s', 'together', 'direct'):.2f} ×",
            f"{0.9 * cores:.1f} ×",
        ),
        ("behind the last cycle", f"{after['lockstep']:.1f} s, {REFERENCE}: {after['reference']:.1f} s", "1.0 s"),
    ]
    benchmark.extra_info["table"] = rows
    print("\n" + "\n".join(f"| {' | '.join(row)} |" for row in rows))
