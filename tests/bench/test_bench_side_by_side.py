"""A whole cell beside what its users know: canopen-python at both ends, python-can's virtual bus, a simulator.

Each is a process by itself, one after the other in turn; a cost is the processor time of a cycle, a ratio the median of
the ratios within a turn. Run it with --benchmark-only -s; `python docs/measure.py side_by_side` writes the table.

- `lockstep`, `direct`: `cylinder`, whole: six emulated drives, array, plant, servo, estimator, supervision, log.
- `canopen-python, by name`: both ends of the same traffic, each a `canopen.Network` on python-can's virtual bus: SYNC;
  six `LocalNode` as drives, which answer with their targets in a TPDO of three variables; a seventh whose image of nine
  TPDOs comes with every second SYNC; a master that reads all of them and writes six RPDOs of two variables. Variables
  are asked for by their names, as canopen-python's documentation does. Nothing is computed, supervised or recorded.
- `canopen-python`: the same, with the variables taken by their place in a PDO, which costs less.
- `virtual bus`: the same frames sent and received as messages of python-can, without nodes and a master.
- `MuJoCo, touch grid`: a step of an arm of six joints with a sensor of 16 × 16. It is another work: rigid bodies whose
  contact forces are put into a grid; neither a pad with its errors, nor nodes, a bus, a master and an estimate.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import sysconfig
from pathlib import Path
from statistics import median

import pytest

CHILD = Path(__file__).with_name("side_by_side_child.py")
TURNS = int(os.environ.get("CANPROBE_TURNS", "5"))
BOTH = "canopen-python, by name"
KINDS = ("lockstep", "direct", BOTH, "canopen-python", "virtual bus", "MuJoCo, touch grid")


def build() -> str:
    """The build of the Python that measures: an unoptimised one costs about a tenth."""
    flags = sysconfig.get_config_var("CONFIG_ARGS") or ""
    optimised = "with" if "--enable-optimizations" in flags else "without"
    return f"{platform.python_implementation()} {platform.python_version()}, built {optimised} --enable-optimizations"


def measured(kind: str) -> float:
    """Processor time of a cycle, µs."""
    words, env = [sys.executable, str(CHILD), kind], os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(words, env=env, stdout=subprocess.PIPE, text=True, check=True)
    return float(json.loads(done.stdout.splitlines()[-1]))


@pytest.mark.timeout(0)
def test_bench_side_by_side(benchmark):
    turns = []
    benchmark.pedantic(lambda: turns.extend({k: measured(k) for k in KINDS} for _ in range(TURNS)), rounds=1)
    rows = [(f"medians of {TURNS} turns, {build()}", "processor time a cycle", "over canopen-python, by name")]
    for kind in KINDS:
        cost, ratio = median(turn[kind] for turn in turns), median(turn[kind] / turn[BOTH] for turn in turns)
        rows.append((kind, f"{cost:.0f} µs" if cost > 10 else f"{cost:.1f} µs", f"{ratio:.2f} ×"))
    benchmark.extra_info["table"] = rows
    print("\n" + "\n".join(f"| {' | '.join(row)} |" for row in rows))
