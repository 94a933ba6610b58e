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
    """Half a second of `free` with grouped targets and identifiers by deadline, and as it is."""
    scene = canprobe.load_scene("free")
    grouped = dataclasses.replace(
        scene,
        arm=dataclasses.replace(scene.arm, grouped_rpdo=True),
        bus=dataclasses.replace(scene.bus, cob_ids="by_deadline"),
    )
    out = tmp_path_factory.mktemp("grouped")
    return undrawn_run(grouped, out=out, duration_s=0.5), canprobe.run(scene, duration_s=0.5, files=False), out


def test_three_frames_a_cycle_carry_six_targets(swung):
    result, _, out = swung
    frames = list(read_candump(out / "bus.log"))
    shared = {pdo.cob_id for pdo in result.plan.pdos if pdo.direction == "rpdo" and pdo.number == 2}
    words = {pdo.cob_id for pdo in result.plan.pdos if pdo.direction == "rpdo" and pdo.number == 1}
    syncs = sum(frame[2] == 0x080 for frame in frames)
    assert len(shared) == 3 and {len(frame[3]) for frame in frames if frame[2] in shared} == {8}
    assert abs(sum(frame[2] in shared for frame in frames) - 3 * syncs) <= 3
    assert 0 < sum(frame[2] in words for frame in frames) < 0.05 * 6 * syncs + 6 * 12  # every 100 ms, and on a change
    assert max(shared) < min(words)  # priorities by deadline: 2.5 ms before 100 ms


def test_each_drive_goes_where_its_half_of_the_frame_says(swung):
    """The arm follows the same path as with a target RPDO for each drive, and every half is its own drive's."""
    result, alone, out = swung
    assert result.summary["completed"] and not result.summary["faults"]
    assert result.summary["cycle"]["missed_pdos"] == 0
    n = min(len(result.log["q_rad"]), len(alone.log["q_rad"]))
    assert np.abs(result.log["q_rad"][n // 2 : n] - alone.log["q_rad"][n // 2 : n]).max() < 2e-3
    assert np.ptp(result.log["q_rad"], axis=0).min() > 5e-3
    frames = list(read_candump(out / "bus.log"))
    first = {pdo.cob_id: pdo.node_id for pdo in result.plan.pdos if pdo.number == 2 and not pdo.entries[0].is_dummy}
    last = {can_id: np.frombuffer(data, "<i4") for _, _, can_id, data in frames if can_id in first}
    targets = np.concatenate([last[can_id] for can_id in sorted(first, key=first.__getitem__)]).astype(float)
    reported = {
        pdo.node_id: int.from_bytes(data[2:6], "little", signed=True)
        for _, _, can_id, data in frames
        for pdo in result.plan.pdos
        if pdo.direction == "tpdo" and pdo.cob_id == can_id
    }
    motors = np.array([reported[node_id] for node_id in range(1, 7)], float)
    joints = np.linalg.solve(MODELS["puma260"].units_per_q, targets - motors)
    assert np.abs(joints).max() < 0.02  # rad behind its target


def test_the_drives_are_left_disabled(swung):
    result, _, out = swung
    status = {pdo.cob_id for pdo in result.plan.pdos if pdo.direction == "tpdo"}
    last = {can_id: data for _, _, can_id, data in read_candump(out / "bus.log") if can_id in status}
    states = {state_of(int.from_bytes(data[:2], "little")) for data in last.values()}
    assert states == {DriveState.SWITCH_ON_DISABLED}
