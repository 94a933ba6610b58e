"""The cell without a bus beside the timed lockstep cell, run by run: --benchmark-only -s; skipped by default."""

from __future__ import annotations

import time
from dataclasses import replace
from statistics import median

from canprobe.scene.load import load_scene
from canprobe.session.session import Session
from canprobe.tasks.from_plan import make_task

RUNS = 5
DURATION_S = 5.0


def run_of(interface):
    """Processor time of a cycle, µs, and the pace of the whole run, × real time."""
    scene = load_scene("cylinder", {"task.duration_s": DURATION_S})
    with Session(replace(scene, bus=replace(scene.bus, interface=interface))) as session:
        task = make_task(session.plan)
        began_ns = time.process_time_ns()
        session.run(task)
        cycles_ns = time.process_time_ns() - began_ns
    cycle = session.cell.cycle
    return cycles_ns / cycle.number / 1000, cycle.t_ns / session.wall_ns


def test_direct_beside_timed_lockstep(benchmark):
    found = {"direct": [], "lockstep": []}

    def interleaved():
        for _ in range(RUNS):
            for interface, runs in found.items():
                runs.append(run_of(interface))

    run_of("direct")
    benchmark.pedantic(interleaved, rounds=1)
    print(f"\ncylinder, {DURATION_S:g} s, medians of {RUNS} interleaved runs")
    cost = {}
    for interface, runs in found.items():
        cost[interface], pace = (median(column) for column in zip(*runs, strict=True))
        print(f"  {interface:<9} {cost[interface]:6.0f} µs a cycle, {pace:5.2f} × real time with bring-up and truth")
    print(f"  lockstep / direct: {cost['lockstep'] / cost['direct']:.2f}")
