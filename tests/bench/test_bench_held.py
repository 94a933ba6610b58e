"""Memory of a lockstep cell that is held as `up` holds one, with a monitor; run it with --benchmark-only -s.

The cell is held for CANPROBE_HELD_MIN minutes of virtual time, 12 by default, in a process by itself (`held_child.py`).
What grows is the slope of a line through the memory after each minute but the first five, in which buffers fill. Why
not a span of real time: on a busy machine it would hold too few minutes for a slope.
`python docs/measure.py held` writes the table to docs/cost.md.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

CHILD = Path(__file__).with_name("held_child.py")
MINUTES = int(os.environ.get("CANPROBE_HELD_MIN", "12"))
FILLING = 5
"""Minutes in which buffers fill."""


@pytest.mark.timeout(0)
def test_bench_held(benchmark):
    words, env = [sys.executable, str(CHILD), str(MINUTES)], os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    done = benchmark.pedantic(
        lambda: subprocess.run(words, env=env, stdout=subprocess.PIPE, text=True, check=True), rounds=1
    )
    found = json.loads(done.stdout)
    kib = found["kib"][FILLING - 1 :]
    slope = np.polyfit(range(len(kib)), kib, 1)[0]
    rows = [
        ("a lockstep cell, held and watched", "measured", "goal"),
        ("virtual time", f"{MINUTES} minutes", ""),
        ("processor time of a minute", f"{found['s'] / MINUTES:.1f} s", ""),
        (f"memory after {FILLING} minutes", f"{kib[0] / 1024:.1f} MiB", ""),
        ("memory at the end", f"{kib[-1] / 1024:.1f} MiB", ""),
        ("growth in between", f"{slope:.1f} kB a minute", "100 kB a minute"),
    ]
    benchmark.extra_info["table"] = rows
    print("\n" + "\n".join(f"| {' | '.join(row)} |" for row in rows))
