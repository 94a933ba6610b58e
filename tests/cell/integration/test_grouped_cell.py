"""Targets of two drives in one RPDO through dummy mapping, end to end in lockstep: master and emulator."""

import dataclasses

import numpy as np
import pytest
from puma_arm import MODELS
from undrawn import undrawn_run

import canprobe
from canprobe.fieldbus.bus.candump import read_candump
from canprobe.fieldbus.protocol.cia402 import DriveState, state_of


@pytest.fixture(scope="module")
def swung(tmp_path_factory):
    """Half a second of `free` with grouped targets and identifiers by deadline: the result and the frames."""
    scene = canprobe.load_scene("free")
    grouped = dataclasses.replace(
        scene,
        arm=dataclasses.replace(scene.arm, grouped_rpdo=True),
        bus=dataclasses.replace(scene.bus, cob_ids="by_deadline"),
    )
    out = tmp_path_factory.mktemp("grouped")
    return undrawn_run(grouped, out=out, duration_s=0.5), list(read_candump(out / "bus.log"))


def test_three_frames_a_cycle_carry_six_targets(swung):
    result, frames = swung
    shared = {pdo.cob_id for pdo in result.plan.pdos if pdo.direction == "rpdo" and pdo.number == 2}
    words = {pdo.cob_id for pdo in result.plan.pdos if pdo.direction == "rpdo" and pdo.number == 1}
    syncs = sum(frame[2] == 0x080 for frame in frames)
    assert len(shared) == 3 and {len(frame[3]) for frame in frames if frame[2] in shared} == {8}
    assert abs(sum(frame[2] in shared for frame in frames) - 3 * syncs) <= 3
    assert 0 < sum(frame[2] in words for frame in frames) < 0.05 * 6 * syncs + 6 * 12  # every 100 ms, and on a change
    assert max(shared) < min(words)  # priorities by deadline: 2.5 ms before 100 ms


def test_each_drive_goes_where_its_half_of_the_frame_says_and_is_left_disabled(swung):
    result, frames = swung
    assert result.summary["completed"] and not result.summary["faults"]
    assert result.summary["cycle"]["missed_pdos"] == 0
    assert np.ptp(result.log["q_rad"], axis=0).min() > 5e-3
    last = {can_id: data for _, _, can_id, data in frames}
    first = [pdo for pdo in result.plan.pdos if pdo.number == 2 and not pdo.entries[0].is_dummy]
    halves = [np.frombuffer(last[pdo.cob_id], "<i4") for pdo in sorted(first, key=lambda pdo: pdo.node_id)]
    status = {pdo.node_id: last[pdo.cob_id] for pdo in result.plan.pdos if pdo.direction == "tpdo"}
    motors = [int.from_bytes(status[node_id][2:6], "little", signed=True) for node_id in range(1, 7)]
    joints = np.linalg.solve(MODELS["puma260"].units_per_q, np.subtract(np.concatenate(halves), motors))
    assert np.abs(joints).max() < 0.02  # rad behind its target
    states = {state_of(int.from_bytes(data[:2], "little")) for data in status.values()}
    assert states == {DriveState.SWITCH_ON_DISABLED}
