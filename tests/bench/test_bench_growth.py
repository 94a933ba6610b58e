"""How processor time and memory grow with what a user makes larger; run it with --benchmark-only -s.

Each size is measured in a process by itself (`growth_child.py`). A cost in proportion to size has the exponent 1. The
exponent of the time is the slope of a line through all sizes on logarithmic axes, and of its steepest part: the slope
over the last two. Memory is the largest resident size of any process. The table is that of docs/cost.md:
`python docs/measure.py growth` writes it there; CANPROBE_LONGEST_S=300 leaves the hour out, and `-k contacts` measures
one row.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

CHILD = Path(__file__).with_name("growth_child.py")
LONGEST_S = int(os.environ.get("CANPROBE_LONGEST_S", "3600"))
AXES = {
    "joints": ("joints of an arm, direct: a cycle", (1, 2, 4, 6, 8), 1e6, "µs"),
    "taxels": ("taxels of an array of raw frames, lockstep: an image", (16, 64, 256, 576, 1024), 1e6, "µs"),
    "nodes": ("drives on the lockstep bus: a SYNC with its answers", (1, 3, 10, 30), 1e6, "µs"),
    "seconds": (
        "seconds of `cylinder`, direct: the run with all its files",
        tuple(s for s in (10, 30, 100, 300, 1000, 3600) if s <= LONGEST_S),
        1.0,
        "s",
    ),
    "contacts": ("contacts over new ground: the map, solved", (1000, 10_000, 100_000, 1_000_000), 1e3, "ms"),
    "runs": ("runs of `run_many`, one worker: all of them", (1, 10, 100, 1000), 1.0, "s"),
}
HEADINGS = ("against", "sizes", "processor time", "exponent, steepest", "memory", "exponent")


def measured(axis: str, size: int) -> dict[str, Any]:
    """Processor time and memory at a size."""
    words = [sys.executable, str(CHILD), axis, str(size)]
    env = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(words, env=env, stdout=subprocess.PIPE, text=True, check=True)
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


@pytest.mark.timeout(0)
@pytest.mark.parametrize("axis", AXES)
def test_bench_growth(benchmark, axis):
    title, sizes, scale, unit = AXES[axis]
    found = benchmark.pedantic(lambda: [measured(axis, size) for size in sizes], rounds=1)
    logs = np.log(sizes), np.log([one["s"] for one in found]), np.log([one["mib"] for one in found])
    slope, of_memory = (np.polyfit(logs[0], log, 1)[0] for log in logs[1:])
    steepest = (logs[1][-1] - logs[1][-2]) / (logs[0][-1] - logs[0][-2])
    costs, memory = [f"{scale * one['s']:.3g}" for one in found], [f"{one['mib']:.0f}" for one in found]
    behind = ", ".join(f"{100 * share:.2g}" for one in found for share in one["behind"])
    also = f"; behind the last cycle {behind} %" if behind else ""
    row = (
        title,
        ", ".join(map(str, sizes)),
        f"{', '.join(costs)} {unit}{also}",
        f"{slope:.2f}, {steepest:.2f}",
        f"{memory[0]} to {memory[-1]} MiB",
        f"{of_memory:.2f}",
    )
    benchmark.extra_info["table"] = [HEADINGS, row]
    print("\n" + " | ".join(row))
