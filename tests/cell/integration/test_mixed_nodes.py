"""A cell does not care which of its nodes are real: an arm of somebody else's and an emulated sensor, side by side."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import canprobe
from canprobe.cell.emulated.world import make_world
from canprobe.cell.master.cell import Cell
from canprobe.cell.master.controller import Command
from canprobe.cell.session.session import Session
from canprobe.errors import UsageError
from canprobe.fieldbus.bus.clock import VirtualClock
from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus
from canprobe.fieldbus.protocol.cia402 import POWERED_STATES, state_of


def mixed_scene():
    scene = canprobe.load_scene("press")
    return replace(scene, arm=replace(scene.arm, emulated=False))


def test_an_arm_of_its_own_and_an_emulated_sensor():
    """Two worlds that know nothing of each other, as the real arm and the emulator's process do not."""
    scene = mixed_scene()
    plan = canprobe.plan(scene)
    assert scene.emulated_node_ids == (16,)
    bus = LockstepBus(VirtualClock(), "can0")
    arm, sensor = make_world(plan, range(1, 7)), make_world(plan, scene.emulated_node_ids)
    for node in (*arm.nodes, *sensor.nodes):
        bus.attach(node)
    samples, q = [], []

    def nod(measurement):
        q.append(measurement.q)
        samples.extend([measurement.tactile.cycle] if measurement.tactile is not None else [])
        target = q[0] + np.array([0, 0, 0, 0, 0, 0.1 * np.sin(len(q) / 40)])
        return Command(q_target=target, done=len(q) > 200)

    with Cell(plan, bus.port()) as cell:
        cell.run(nod)
    assert cell.notes.lines() == []
    assert len(samples) == pytest.approx(100, abs=2) and set(np.diff(samples)) == {2}
    assert np.ptp(np.array(q)[:, 5]) == pytest.approx(0.2, abs=0.01)
    assert all(state_of(node.dictionary.number(0x6041)) not in POWERED_STATES for node in arm.nodes)


def test_a_lockstep_run_says_that_it_has_no_real_nodes():
    with pytest.raises(UsageError, match="node 1 is marked emulated = false"), Session(mixed_scene()):
        pass
