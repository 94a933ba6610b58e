"""Record docs/notebooks/touch.csv: images and poses of a part of the packaged scene `saddle`.

`python docs/recorded_touch.py`
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

import canprobe
from canprobe.cell.results.recording import recording
from canprobe.cell.tasks.task import Phase
from canprobe.mechanics import forward
from canprobe.mechanics.robot.chain import ending_in

FILE = Path(__file__).parent / "notebooks" / "touch.csv"
EVERY = 2
"""Each second image: 100 Hz."""
LONGEST_S = 4.0

if __name__ == "__main__":
    result = canprobe.run("saddle", bus="direct", duration_s=LONGEST_S - 0.5, files=False)
    setup, log, tactile = result.plan.setup, result.log, result.tactile
    chain = ending_in(setup.needed_arm().model.chain, setup.probe.T_flange_probe)
    begin = log["t_s"][np.flatnonzero(log["phase"] == Phase.SETTLE)[0]]
    at = tactile["t_sample_s"]
    rows = np.flatnonzero((at >= begin) & (at < begin + LONGEST_S) & (at <= log["t_s"][-1]))[::EVERY]
    with recording(FILE) as add:
        for row in rows:
            q = [np.interp(at[row], log["t_s"], joint) for joint in log["q_rad"].T]
            add(at[row] - begin, tactile["taxels"][row], forward(chain, np.array(q)))
    print(f"{FILE}: {len(rows)} images, {FILE.stat().st_size} bytes")
