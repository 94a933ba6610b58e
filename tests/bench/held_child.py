"""A cell that is held and watched, in a process: `python held_child.py MINUTES` prints its memory by the minute.

It runs for MINUTES of virtual time and prints a line of JSON: resident memory, KiB, after each of them, and the
processor time of all, s.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from time import process_time

import canprobe
from canprobe.cell.master.controller import Command, Measurement
from canprobe.cell.master.monitor import Monitor, lines
from canprobe.cell.master.observers import Observation
from canprobe.cell.master.options import RunOptions, quiet
from canprobe.cell.session.session import Session
from canprobe.cell.session.up import ROWS_OF_UP, reporting_notes

MINUTE_NS, SCREEN_NS = 60_000_000_000, 100_000_000
PAGE_KIB = os.sysconf("SC_PAGE_SIZE") / 1024


def resident() -> float:
    """Resident memory of this process now, KiB."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE_KIB


def held(minutes: int) -> list[float]:
    """Hold a cell as `up` does, with a screen of its monitor ten times a second."""
    plan = canprobe.plan("cylinder", {"bus.interface": "lockstep"})
    monitor, memory = Monitor(plan), []
    next_screen_ns = 0

    def watch(observation: Observation) -> None:
        nonlocal next_screen_ns
        monitor.push(observation.frames)
        if observation.t_ns >= next_screen_ns:
            next_screen_ns += SCREEN_NS
            "".join(lines(monitor.view(observation.t_ns)))

    def hold(measurement: Measurement) -> Command:
        if measurement.t_ns >= MINUTE_NS * (len(memory) + 1):
            memory.append(resident())
        return Command(done=len(memory) == minutes)

    session = Session(plan, RunOptions(None, quiet, (watch,), ROWS_OF_UP))
    with reporting_notes(session, quiet) as report_news:
        session.run(hold, report_news)
    return memory


if __name__ == "__main__":
    print(json.dumps({"kib": held(int(sys.argv[1])), "s": process_time()}))
