"""Drives on the emulated arm: what its motors do when a drive homes, controls torque or opens the brake."""

from __future__ import annotations

import numpy as np
import pytest
from puma_arm import BODIES, ELBOW_FORM, UPENN

from canprobe.cell.plant.config import PlantConfig
from canprobe.cell.plant.ideal_arm import natural_frequency
from canprobe.cell.plant.plant import Plant
from canprobe.fieldbus.drive.drive import make_drive_node
from canprobe.fieldbus.eds.packaged import load_eds
from canprobe.fieldbus.node.quirks import Quirks


@pytest.fixture
def dynamic():
    return Plant(PlantConfig(UPENN, ELBOW_FORM, taxels=None, fidelity="dynamic", bodies=BODIES["puma260"]))


def test_a_dynamic_arm_gives_no_more_than_the_limit_and_bit_11_says_so(rig, dynamic):
    axis = 4
    bench = type(rig.drive)(make_drive_node(load_eds("puma260_joint", 1), 1, axis, dynamic))
    bench.node.start(0)
    rig = type(rig)(bench, dynamic)
    rig.enable(1).put(_6072=300, _6081=400_000, _6083=20_000_000, _607A=round(dynamic.motor_counts(axis)) + 3000)
    rig.word(0x1F)
    most, bits = 0, set()
    for _ in range(80):
        rig.drive.advance(rig.drive.t_ns + 1_000_000)
        most = max(most, abs(dynamic.torque_permille(axis)))
        bits |= {rig.bits(11)}
    assert most == 300
    assert (1,) in bits


def test_speed_fed_forward_removes_the_lag_of_a_dynamic_arm(dynamic):
    behind = []
    for speed in (0.0, 4000.0):
        arm = Plant(dynamic.config)
        start = arm.motor_counts(3)
        arm.set_loop(3, 2000, speed, 0.0)
        arm.set_ramp(3, start, start + 4000.0, 0, 1_000_000_000)
        arm.advance(900_000_000)
        behind.append((start + 3600.0 - arm.motor_counts(3)) / 4000.0)
    assert behind == pytest.approx([2.0 / natural_frequency(30.0), 0.0], abs=5e-5)


def test_torque_fed_forward_pushes_at_once(dynamic):
    still = dynamic.motor_counts(0)
    before = dynamic.torque_permille(0)
    dynamic.set_loop(0, 2000, 0.0, 600.0)
    assert dynamic.torque_permille(0) == pytest.approx(before + 600, abs=1)
    dynamic.advance(5_000_000)
    assert dynamic.motor_counts(0) > still + 0.1
    dynamic.advance(1_000_000_000)  # the integrator has taken it over
    assert dynamic.motor_counts(0) == pytest.approx(still, abs=3.0)


@pytest.mark.parametrize(("early_ms", "falls"), [(0, False), (60, True)])
def test_a_brake_that_opens_before_the_torque_comes_lets_a_vertical_axis_fall(rig, early_ms, falls):
    stretched = Plant(PlantConfig(UPENN, np.zeros(6), taxels=None, fidelity="dynamic", bodies=BODIES["puma260"]))
    quirks = Quirks(brake_early_ns=early_ms * 1_000_000)
    node = make_drive_node(load_eds("puma260_joint", 1), 1, 1, stretched, quirks=quirks)
    rig.drive.node, rig.plant = node, stretched
    node.start(0)
    stretched.advance(200_000_000)
    rig.drive.t_ns = 200_000_000
    before = stretched.motor_counts(1)
    rig.put(_6060=1, _6065=0xFFFFFFFF)
    for word in (0x06, 0x07, 0x0F):
        rig.word(word)
    lost = []
    for t_ms in range(205, 700, 5):
        rig.drive.advance(t_ms * 1_000_000)
        lost.append(abs(stretched.motor_counts(1) - before))
    assert (max(lost) > 5.0) is falls, max(lost)
    assert lost[-1] < 5.0, "it is caught"


@pytest.mark.parametrize("axis", [0, 5])
def test_cia402_cst_the_ideal_arm_needs_the_torque_that_it_is_given(drive, axis):
    """Steady motion of a real plant: 600 permille in, and its own torque model says 600 permille."""
    plant = Plant(PlantConfig(UPENN, ELBOW_FORM, taxels=None))
    drive.node = make_drive_node(load_eds("puma260_joint", axis + 1), axis + 1, axis, plant)
    drive.node.start(0)
    for index, value, size in ((0x6060, 10, 1), (0x1006, 2500, 4), (0x607F, 10**7, 4)):
        assert drive.write(index, 0, value, size) == 0
    for word in (0x06, 0x07, 0x0F):
        drive.write(0x6040, 0, word, 2)
    drive.nmt(0x01)
    for k in range(1, 800):
        drive.send(0x80, "", k * 2_500_000)
        drive.write(0x6071, 0, -600, 2)
    assert plant.torque_permille(axis) == pytest.approx(-600, abs=2)
    assert (UPENN.q_per_unit @ plant.arm.motors()[1])[axis] < -0.5


def test_cia402_55_a_lagging_wrist_motor_stands_on_its_pulse():
    """Axis 5 of the ideal arm, 800 counts a turn, 8 ms behind its reference: the pulse is caught where it is."""
    plant = Plant(PlantConfig(UPENN, ELBOW_FORM, taxels=None))
    node = make_drive_node(load_eds("puma260_joint", 5), 5, 4, plant)
    node.start(0)
    t_ns = 0
    for text in (
        "238f600120030000",  # 608Fh:01 = 800
        "2392600120030000",  # 6092h:01 = 800
        "2398600022000000",  # wrong length: refused
        "2f98600022000000",  # method 34
        "2f60600006000000",
        *("2b40600006000000", "2b40600007000000", "2b4060000f000000", "2b4060001f000000"),
    ):
        t_ns += 1_000_000
        node.receive(0x605, bytes.fromhex(text), t_ns)
        node.advance(t_ns)
    start = plant.motor_counts(4)
    others = [plant.motor_counts(axis) for axis in (0, 1, 2, 3, 5)]
    for k in range(1, 500):
        node.advance(t_ns + k * 2_500_000)
    pulse = (start // 800 + 1) * 800
    assert plant.motor_counts(4) == pytest.approx(pulse, abs=0.5)
    assert node.dictionary.values[0x6041 << 8] >> 10 & 7 == 0b101
    answer = node.receive(0x605, bytes.fromhex("4064600000000000"), t_ns + 1250 * 10**6)[0][1]
    assert abs(int.from_bytes(answer[4:], "little", signed=True)) <= 1
    assert [plant.motor_counts(axis) for axis in (0, 1, 2, 3, 5)] == pytest.approx(others, abs=1e-6)


def test_cia402_55_a_coupled_wrist_joint_finds_its_switch_where_the_joint_really_is(rig):
    """Axis 5 of the ideal arm counts from 0 at power on, and lags 8 ms behind its reference."""
    rig.plant = plant = Plant(PlantConfig(UPENN, ELBOW_FORM, taxels=None))
    rig.drive.node = make_drive_node(load_eds("puma260_joint", 1), 1, 4, plant, incremental=True)
    rig.drive.node.start(0)
    assert rig.signed(0x6064) == 0
    rig.put(_6099_1=20_000, _6099_2=500, _609A=200_000, _6098=18).enable(6)
    rig.drive.advance(rig.drive.t_ns + 10_000_000)
    rig.word(0x1F)
    for _ in range(4000):
        rig.drive.advance(rig.drive.t_ns + 2_500_000)
    assert rig.bits(13, 12, 10) == (0, 1, 1)
    margin = 0.01 * (UPENN.q_max[4] - UPENN.q_min[4])
    assert plant.truth()["q"][4] == pytest.approx(UPENN.q_max[4] + margin, abs=1e-4)
    assert abs(rig.signed(0x6064)) <= 1
