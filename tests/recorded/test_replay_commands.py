"""A recorded `bus.log` through the pure stack gives the commands that the cell gave, count by count."""

from __future__ import annotations

import signal
from dataclasses import replace

import numpy as np
import pytest

import canprobe
from canprobe.emulator.faults import Fault, FaultKind, FaultyNode
from canprobe.errors import NodeError
from canprobe.protocol.frames import NmtState
from canprobe.recorded.cycles import TARGET_TOLERANCE, LogCycles, replay_task
from canprobe.recorded.recording import read_recording
from canprobe.session.session import Session, resolve_scene
from canprobe.tasks.from_plan import make_task
from canprobe.tasks.probing import Phase

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


def press():
    scene = resolve_scene(canprobe.load_scene("press"), duration_s=0.3)
    return replace(
        scene,
        task=replace(scene.task, clearance_mm=0.5),
        cycle=replace(scene.cycle, rate_hz=200.0),
        sensor=replace(scene.sensor, rate_hz=100.0, mode="features"),
    )


def replayed(session, folder):
    recording = read_recording(folder / "bus.log", session.plan, as_taken=False)
    return replay_task(session.plan, LogCycles(session.plan, recording, as_taken=False))


def told_cycles(session):
    return np.flatnonzero(np.isfinite(session.cell.log.arrays()["q_target_rad"][:, 0]))


@pytest.mark.parametrize("name", FAULTS)
def test_the_log_gives_the_same_commands(name, tmp_path):
    session = Session(press(), tmp_path)
    nodes = session.world.nodes
    session.world.participants[: len(nodes)] = [FaultyNode(node, FAULTS[name]) for node in nodes]
    task = make_task(session.plan)
    with session:
        session.run(task)
    cell = session.cell
    assert (name == "none") == (cell.drives.missed + cell.drives.implausible == 0)
    again = replayed(session, tmp_path)
    assert again.compared >= len(told_cycles(session)) - 2 > 200
    assert (again.differing, again.parted_s, again.lifted_s) == (0, None, None)
    assert again.worst_counts <= TARGET_TOLERANCE


def interrupt(_session):
    signal.raise_signal(signal.SIGINT)


def lose_sensor(session):
    """It leaves operation: every drive still obeys, so that no controlword tells of it."""
    session.world.nodes[-1]._enter(NmtState.PRE_OPERATIONAL, session.lockstep.clock.now_ns())


@pytest.mark.parametrize("end", [interrupt, lose_sensor])
def test_the_log_of_a_lift_off_gives_the_same_commands(end, tmp_path):
    session = Session(press(), tmp_path)
    task = make_task(session.plan)
    ended = []

    def step(measurement):
        if task.phase is Phase.SCAN and not ended and measurement.tactile is None:
            ended.append(measurement.cycle)
            end(session)
        return task.step(measurement)

    step.retreat = task.retreat
    with pytest.raises((KeyboardInterrupt, NodeError)), session:
        session.run(step)
    assert session.truth["force"][-1] == 0.0
    again = replayed(session, tmp_path)
    told = told_cycles(session)
    assert again.compared >= len(told) - 2 > 200
    assert (again.differing, again.parted_s) == (0, None) and again.worst_counts <= TARGET_TOLERANCE
    assert 0 < again.lifted_s / 0.005 - ended[0] <= 2, "it begins in the cycle after that, or the next"
    assert 60 < told[-1] - again.lifted_s / 0.005 < 70, "0.32 s"
    assert again.task.phase is Phase.SCAN
