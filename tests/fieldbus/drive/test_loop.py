"""Torque limit 6072h and feed-forwards 60B1h, 60B2h: how they reach the plant, and what a dynamic arm does then."""

import numpy as np
import pytest
from puma_arm import BODIES, ELBOW_FORM, UPENN

from canprobe.cell.plant.config import PlantConfig
from canprobe.cell.plant.plant import Plant
from canprobe.fieldbus.drive.drive import make_drive_node
from canprobe.fieldbus.eds.packaged import load_eds
from canprobe.fieldbus.node.quirks import Quirks

CSP, CSV, CST = 8, 9, 10
HOLD = "0f0000000000"


@pytest.fixture
def dynamic():
    return Plant(PlantConfig(UPENN, ELBOW_FORM, taxels=None, fidelity="dynamic", bodies=BODIES["puma260"]))


def at_work(rig, mode, *words):
    """Operational, RPDO1 = controlword + the mode's target + what else is mapped."""
    mapped = [(f"_1600_{sub}", word) for sub, word in enumerate(words, start=2)]
    for name, value in (("_1400_1", 0x80000201), ("_1600_0", 0), *mapped, ("_1600_0", 1 + len(words))):
        rig.put(**{name: value})
    rig.put(_1400_1=0x201).enable(mode).drive.nmt(0x01)
    return rig


def test_position_mode_feeds_both_forward_and_takes_them_back(rig, plant):
    at_work(rig, CSP, 0x607A0020).put(_6072=800, _60B1=1500, _60B2=120).cycles(3, HOLD)
    assert plant.loops[-1] == (0, 800, 1500.0, 120.0)
    told = len(plant.loops)
    rig.cycles(5, HOLD)
    assert len(plant.loops) == told  # changes only
    rig.word(0x07)
    assert plant.loops[-1] == (0, 800, 0.0, 0.0)


def test_position_mode_feeds_what_an_rpdo_brings(rig, plant):
    at_work(rig, CSP, 0x607A0020, 0x60B20010)
    for torque in (120, 120, -40):
        rig.cycles(2, HOLD + torque.to_bytes(2, "little", signed=True).hex())
    rig.cycles(1)
    assert plant.loops == [(0, 2000, 0.0, 120.0), (0, 2000, 0.0, -40.0)]
    rig.word(0x07)
    assert plant.loops[2:] == [(0, 2000, 0.0, 0.0)]
    rig.word(0x0F)
    rig.cycles(3, HOLD + "d8ff")
    assert plant.loops[3:] == [(0, 2000, 0.0, -40.0)]


def test_velocity_mode_feeds_torque_only(rig, plant):
    at_work(rig, CSV, 0x60FF0020).put(_60B1=1500, _60B2=120).cycles(3, HOLD)
    assert plant.loops == [(0, 2000, 0.0, 120.0)]
    rig.word(0x07)
    assert plant.loops[-1][2:] == (0.0, 0.0)


def test_torque_mode_feeds_nothing(rig, plant):
    at_work(rig, CST, 0x60710010).put(_60B1=1500, _60B2=120).cycles(3, "0f000000")
    assert plant.loops == []


def test_the_limit_counts_in_every_mode(rig, plant):
    rig.enable(1).put(_6072=500)
    assert plant.loops[-1] == (0, 500, 0.0, 0.0)


@pytest.mark.parametrize("axis", [1, 4])
def test_a_dynamic_arm_gives_no_more_than_the_limit_and_bit_11_says_so(rig, dynamic, axis):
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
    assert behind == pytest.approx([2.0 * 1.0 / dynamic_frequency(), 0.0], abs=5e-5)


def dynamic_frequency():
    """Undamped, of 30 Hz at -3 dB, critically damped, rad/s."""
    return 2 * np.pi * 30.0 / np.sqrt(np.sqrt(2.0) - 1.0)


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
