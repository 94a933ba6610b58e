"""What a cycle, the end of a run and many runs cost beside an older commit; run it with --benchmark-only -s.

Each figure is processor time of runs of `cylinder`. The two commits run at the same time on the same processor, in
processes of their own, so that whatever else slows the machine down hits both. A cycle's cost is that from the first to
the last cycle of the task, without bring-up; a ratio is the median over the turns of the ratio within a turn. The
reference is taken from the history. The table is that of docs/cost.md: `python docs/measure.py pace` writes it there.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import median

import pytest

ROOT = Path(__file__).parents[2]
REFERENCE = "e7a3f7c"
TURNS = int(os.environ.get("CANPROBE_TURNS", "3"))
SCAN_S = 20
SCAN = """
import json, sys, tempfile
from time import process_time
import canprobe

began, last, cycles = None, None, 0
def progress(*_):
    global began, last, cycles
    if cycles % 50 == 0:  # reading a clock is dear in a virtual machine
        last = process_time(), cycles
        began = began or last
    cycles += 1

bus, seconds = sys.argv[1], float(sys.argv[2])
with tempfile.TemporaryDirectory() as folder:
    canprobe.run("cylinder", bus=bus, duration_s=seconds, progress=progress, out=folder + "/run")
    end = process_time()
print(json.dumps([1e6 * (last[0] - began[0]) / (last[1] - began[1]), end - last[0], end - began[0]]))
"""
MANY = """
import json, sys, tempfile
from resource import RUSAGE_CHILDREN, RUSAGE_SELF, getrusage
import canprobe

def used():
    return sum(t.ru_utime + t.ru_stime for t in map(getrusage, (RUSAGE_SELF, RUSAGE_CHILDREN)))

seconds, n = float(sys.argv[1]), int(sys.argv[2])
began = used()
with tempfile.TemporaryDirectory() as out:
    canprobe.run_many("cylinder", seeds=n, bus="direct", duration_s=seconds, workers=1, out=out, progress=False)
print(json.dumps([(used() - began) / n]))
"""
CASES = {
    "lockstep": (SCAN, "lockstep", SCAN_S),
    "direct": (SCAN, "direct", SCAN_S),
    "1 s": (MANY, 1, 40),
    "20 s": (MANY, 20, 3),
}
ROWS = (
    ("a cycle, lockstep", "lockstep", 0, "{:.0f} µs", ""),
    ("a cycle, direct", "direct", 0, "{:.0f} µs", ""),
    (f"behind the last cycle of {SCAN_S} s, direct", "direct", 1, "{:.2f} s", "at most 0.4 ×"),
    (f"a run of {SCAN_S} s, direct, to its last file", "direct", 2, "{:.2f} s", ""),
    ("a run of 1 s by `run_many`, 40 in a worker", "1 s", 0, "{:.2f} s", "at most 0.56 ×"),
    ("a run of 20 s by `run_many`, 3 in a worker", "20 s", 0, "{:.2f} s", "at most 0.77 ×"),
)
"""What, its case, place in the answer of that, form, and goal: 1.8 and 1.3 times as many runs are 0.56 and 0.77 ×."""


def measured(tree: Path, code: str, *words: object) -> list[float]:
    """What a process with the package of a tree measures."""
    done = subprocess.run(
        [sys.executable, "-c", code, *map(str, words)],
        cwd=tree,
        env={**os.environ, "PYTHONPATH": str(tree), "OPENBLAS_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    found: list[float] = json.loads(done.stdout.splitlines()[-1])
    return found


def measured_at_once(trees: Sequence[Path], *case: object) -> list[list[float]]:
    """What the packages of some trees measure at the same time on one processor."""
    processors = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(processors)})  # their threads and processes inherit it
    try:
        with ThreadPoolExecutor() as pool:
            return list(pool.map(lambda tree: measured(tree, *case), trees))
    finally:
        os.sched_setaffinity(0, processors)


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
    turns = []

    def in_turn():
        for _ in range(TURNS):
            turns.append({name: measured_at_once((reference, ROOT), *case) for name, case in CASES.items()})

    benchmark.pedantic(in_turn, rounds=1)
    rows = [(f"processor time, medians of {TURNS} turns", REFERENCE, "now", "ratio", "goal")]
    for what, name, place, form, goal in ROWS:
        costs = [(before[place], now[place]) for before, now in (turn[name] for turn in turns)]
        ratio = median(now / before for before, now in costs)
        rows.append(
            (what, *(form.format(median(column)) for column in zip(*costs, strict=True)), f"{ratio:.2f} ×", goal)
        )
    benchmark.extra_info["table"] = rows
    print("\n" + "\n".join(f"| {' | '.join(row)} |" for row in rows))
