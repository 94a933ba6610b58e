"""The drive group: bytes in, joint angles out; joint targets in, bytes out; late is late."""

import numpy as np
import pytest

from canprobe.cell.drives import DriveAxis, DriveGroup
from canprobe.protocol.cia402 import DriveState
from canprobe.protocol.pdo import PdoEntry, PdoLayout
from canprobe.robot.puma260 import MODELS, joints_to_counts

STATUS, POSITION, TORQUE = PdoEntry(0x6041, 0, 16), PdoEntry(0x6064, 0, 32, True), PdoEntry(0x6077, 0, 16, True)
WORD, TARGET, DUMMY = PdoEntry(0x6040, 0, 16), PdoEntry(0x607A, 0, 32, True), PdoEntry(0x0004, 0, 32)
MODEL = MODELS["upenn"]
ENABLED = DriveState.OPERATION_ENABLED.value
NAN = float("nan")


def make_group(grouped=False, repeat=40, torque=range(1, 7)):
    axes = []
    for i in range(1, 7):
        feedback = PdoLayout(0x180 + i, (STATUS, POSITION, TORQUE) if i in torque else (STATUS, POSITION))
        if grouped:
            entries = (TARGET, DUMMY) if i % 2 else (DUMMY, TARGET)
            commands = (PdoLayout(0x200 + i, (WORD,), 255), PdoLayout(0x301 + (i - 1) // 2 * 2, entries))
        else:
            commands = (PdoLayout(0x200 + i, (WORD, TARGET)),)
        axes.append(DriveAxis(i, feedback, commands))
    return DriveGroup(tuple(axes), MODEL, repeat)


def hear(group, counts, status=ENABLED, skip=()):
    for i, axis in enumerate(group.axes):
        if i not in skip:
            torque = [-7] * (len(axis.feedback.entries) - 2)
            group.push(axis.feedback.cob_id, axis.feedback.pack(status, round(counts[i]), *torque))


def test_joint_angles_come_back_through_the_coupled_wrist():
    q = np.array((0.3, -0.2, 0.1, 0.5, -0.4, 1.0))
    group = make_group()
    group.begin(0)
    hear(group, joints_to_counts(MODEL, q))
    assert group.complete
    assert group.joints() == pytest.approx(q, abs=2e-4)
    assert group.torque_permille == [-7] * 6


@pytest.mark.parametrize(("torque", "told"), [((1, 4), [-7, NAN, NAN, -7, NAN, NAN]), ((), [])])
def test_a_drive_without_torque_in_its_tpdo_is_heard_like_the_others(torque, told):
    group = make_group(torque=torque)
    group.begin(0)
    hear(group, [10.0] * 6)
    assert group.complete and group.ages() == (0,) * 6
    assert group.torque_permille == pytest.approx(told, nan_ok=True)


def test_wrist_motors_turn_with_joint_4():
    counts = joints_to_counts(MODEL, np.array((0, 0, 0, 2 * np.pi, 0, 0)))
    assert counts[4] == pytest.approx(-9.8462 * 800, rel=1e-6)
    assert counts[5] == pytest.approx(1.0 * 800, rel=1e-6)


def test_a_tpdo_twice_or_after_the_window_is_late_and_not_used():
    group = make_group()
    group.begin(0)
    hear(group, [10.0] * 6)
    hear(group, [99.0] * 6)
    assert group.late == 6
    group.end_collect()
    hear(group, [98.0] * 6)
    assert group.late == 12
    group.begin(1)
    hear(group, [15.0] * 6, skip=(2,))
    group.end_collect()
    assert group.missed == 1
    assert group.ages() == (0, 0, 1, 0, 0, 0)
    counts = joints_to_counts(MODEL, group.joints())
    assert counts == pytest.approx([15, 15, 10, 15, 15, 15], abs=1e-6)


def test_a_tpdo_from_before_the_sync_is_late_though_it_is_read_afterwards():
    group = make_group()
    group.begin(0, 1000)
    group.push(0x181, group.axes[0].feedback.pack(ENABLED, 5, 0), 999)
    assert (group.late, group.ages()[0]) == (1, 1)
    group.push(0x181, group.axes[0].feedback.pack(ENABLED, 7, 0), 1000)
    assert (group.late, group.ages()[0]) == (1, 0)


def test_without_a_target_each_drive_is_told_to_stay():
    group = make_group()
    group.begin(0)
    hear(group, [11, 22, 33, 44, 55, -66])
    assert group.frames()[5] == (0x206, (15).to_bytes(2, "little") + (-66).to_bytes(4, "little", signed=True))


def test_grouped_targets_share_a_frame_and_the_controlword_goes_on_change():
    group = make_group(grouped=True, repeat=3)
    group.begin(0)
    hear(group, [1, 2, 3, 4, 5, -6])
    frames = dict(group.frames())
    assert sorted(frames) == [0x201, 0x202, 0x203, 0x204, 0x205, 0x206, 0x301, 0x303, 0x305]
    assert frames[0x305] == (5).to_bytes(4, "little") + (-6).to_bytes(4, "little", signed=True)
    seen = []
    for cycle in range(1, 5):
        group.begin(cycle)
        seen.append(sum(1 for can_id, _ in group.frames() if can_id < 0x300))
    assert seen == [0, 0, 6, 0]


def test_a_fault_reset_that_did_not_take_gets_a_new_edge():
    group = make_group()
    words = []
    for cycle in range(4):
        group.begin(cycle)
        hear(group, [0] * 6, status=DriveState.FAULT.value)
        words.append(group.frames()[0][1][0] >> 7)
    assert words == [1, 0, 1, 0]
