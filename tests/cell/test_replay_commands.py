"""A recorded `bus.log` through the pure stack gives the commands that the cell gave, count by count."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import canprobe
from canprobe.cell.build import make_task
from canprobe.cell.log_cycles import LogCycles
from canprobe.cell.recording import read_recording
from canprobe.cell.replay import TARGET_TOLERANCE, replay_task
from canprobe.emulator.faults import Fault, FaultKind
from canprobe.emulator.faulty_node import FaultyNode
from canprobe.session import Session, resolve_scene

MS = 1_000_000
FAULTS = {
    "none": (),
    "lost and late PDOs": (
        Fault(FaultKind.DROP, 2, 600 * MS, 900 * MS, share=0.1, seed=1),
        Fault(FaultKind.DELAY, 5, 600 * MS, 900 * MS, share=0.1, amount_ns=2 * MS, seed=2),
        Fault(FaultKind.DROP, 16, 600 * MS, 900 * MS, share=0.03, seed=5),
    ),
    "wrong positions": (Fault(FaultKind.WRONG_DATA, 3, 600 * MS, 900 * MS, share=0.1, seed=4),),
}


@pytest.mark.parametrize("name", FAULTS)
def test_the_log_gives_the_same_commands(name, tmp_path):
    scene = resolve_scene(canprobe.load_scene("press"), duration_s=0.3)
    scene = replace(
        scene,
        task=replace(scene.task, clearance_mm=0.5),
        cycle=replace(scene.cycle, rate_hz=200.0),
        sensor=replace(scene.sensor, rate_hz=100.0, mode="features"),
    )
    session = Session(scene, tmp_path)
    session.joins = lambda one: FaultyNode(one, FAULTS[name]) if hasattr(one, "node_id") else one
    task = make_task(session.plan)
    with session:
        session.run(task)
    cell = session.cell
    assert (name == "none") == (cell.drives.missed + cell.drives.implausible == 0)
    recording = read_recording(tmp_path / "bus.log", session.plan, as_taken=False)
    replayed = replay_task(session.plan, LogCycles(session.plan, recording, as_taken=False))
    steps = np.count_nonzero(np.isfinite(cell.log.arrays()["q_target_rad"][:, 0]))
    assert replayed.compared >= steps - 2 > 200
    assert (replayed.differing, replayed.parted_s) == (0, None) and replayed.worst_counts <= TARGET_TOLERANCE
