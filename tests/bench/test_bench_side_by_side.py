"""A whole cell beside what its users know: a master of canopen-python, and python-can's virtual bus.

Each is a process by itself, one after the other in turn; a cost is the processor time of a cycle, a ratio the median of
the ratios within a turn. Run it with --benchmark-only -s; `python docs/measure.py side_by_side` writes the table.

- `lockstep`, `direct`: `cylinder`, whole: six emulated drives, array, plant, servo, estimator, supervision, log.
- `canopen-python`: a `canopen.Network` on python-can's virtual bus, for six drives: SYNC, six TPDOs received and their
  three variables read, six RPDOs with two variables written and sent. It has no drives: the TPDOs are ready-made bytes
  of another thread, whose time is taken off. It computes, supervises and records nothing.
- `canopen-python, both ends`: the same with six `LocalNode` as drives, which answer with their targets; theirs counts.
- `by name`: the variables of a PDO are asked for by their names, as canopen-python's documentation does; the others
  take them by their place, which costs less.
- `virtual bus`: the same 13 frames sent and received as messages of python-can, without a master.
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
MASTER, BOTH = "canopen-python", "canopen-python, both ends, by name"
KINDS = ("lockstep", "direct", MASTER, f"{MASTER}, by name", f"{MASTER}, both ends", BOTH, "virtual bus")


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
    headings = "processor time a cycle", "over its master alone", "over both ends, by name"
    rows = [(f"medians of {TURNS} turns, {build()}", *headings)]
    for kind in KINDS:
        over = [median(turn[kind] / turn[other] for turn in turns) for other in (MASTER, BOTH)]
        rows.append((kind, f"{median(turn[kind] for turn in turns):.0f} µs", *(f"{ratio:.2f} ×" for ratio in over)))
    benchmark.extra_info["table"] = rows
    print("\n" + "\n".join(f"| {' | '.join(row)} |" for row in rows))
