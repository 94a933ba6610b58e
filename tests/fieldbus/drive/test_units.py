"""Factor group, CiA 402-2: position units ↔ motor counts, polarity, and limits that only some EDS have."""

from __future__ import annotations

from copy import deepcopy

import pytest
from canopen.objectdictionary import ODVariable

from canprobe.fieldbus import load_eds
from canprobe.fieldbus.drive import make_drive_node


@pytest.fixture
def polar(rig):
    """The rig, with a drive whose EDS has 607Eh and 6080h as well."""
    od = deepcopy(load_eds("puma260_joint", 1))
    for index, data_type in ((0x607E, 0x5), (0x6080, 0x7)):
        variable = ODVariable(f"object {index:04X}", index)
        variable.data_type, variable.access_type, variable.default = data_type, "rw", 0
        od.add_object(variable)
    rig.drive.node = make_drive_node(od, 1, 0, rig.plant)
    rig.drive.node.start(0)
    return rig.put(_1019=240, _1006=2500)


def move(rig, target, ms=600):
    return rig.put(_607A=target).word(0x3F).run(ms).word(0x0F)


def velocity(rig, target, cycles=10):
    rig.put(_60FF=target)
    for _ in range(cycles):
        rig.cycles(1)
        rig.put(_60FF=target)
    return rig


@pytest.mark.parametrize(
    ("factors", "scale"),
    [
        ({"_6091_1": 2}, 2.0),
        ({"_6091_2": 4}, 0.25),
        ({"_6092_1": 2000}, 0.5),
        ({"_6092_2": 3}, 3.0),
        ({"_608F_1": 800}, 0.8),
        ({"_608F_2": 2}, 0.5),
        ({"_608F_1": 4000, "_6091_1": 50, "_6091_2": 10, "_6092_1": 360}, 4000 * 5 / 360),
    ],
)
def test_cia402_608f_6091_6092_scale_positions(rig, factors, scale):
    move(rig.put(**factors, _6081=10_000).enable(1), 300)
    assert rig.counts == pytest.approx(300 * scale)
    assert (rig.signed(0x6064), rig.signed(0x6062), rig.bits(10)) == (300, 300, (1,))


def test_cia402_factor_group_scales_speeds_and_accelerations(rig):
    rig.put(_6091_1=2, _6081=5_000, _6083=50_000, _6084=50_000).enable(1)
    move(rig, 3000, 200)
    assert rig.counts == pytest.approx(2 * 5_000 * (0.2 - 0.05))
    assert rig.signed(0x606B) == 5_000
    rig.word(0x10F).run(200)
    assert rig.counts == pytest.approx(2 * (5_000 * 0.15 + 5_000**2 / 1e5))


def test_cia402_factor_group_scales_windows(rig, plant):
    rig.put(_6091_1=10, _6065=100, _6066=0, _6067=20, _6068=5, _6081=1000).enable(1)
    plant.stuck = True
    move(rig, 20, 100)
    assert rig.bits(10) == (1,)  # 200 counts away
    assert rig.signed(0x60F4) == 20
    move(rig, 99, 300)
    assert rig.bits(3) == (0,)
    move(rig, 102, 300)
    assert rig.bits(3) == (1,)


def test_cia402_factor_group_scales_velocity_and_its_limit(rig):
    rig.put(_6091_1=2, _607F=600).enable(9).drive.nmt(0x01)
    velocity(rig, 500)
    assert rig.signed(0x606C) == 500
    start = rig.counts
    rig.cycles(2)
    assert rig.counts - start == pytest.approx(2 * 500 * 5e-3)
    velocity(rig, 700)
    assert (rig.signed(0x606C), rig.bits(11)) == (600, (1,))


def test_cia402_factor_group_scales_csp(rig):
    rig.put(_6091_1=2).enable(8).drive.nmt(0x01)
    rig.cycles(1)
    rig.cycles(3, rpdo="0f00" + "64000000")
    assert rig.counts == pytest.approx(200)
    assert rig.cycles(1)[-1] == (0x181, "3712" + "64000000" + "0000")


@pytest.mark.parametrize("name", ["_608F_1", "_6091_2", "_6092_1"])
def test_cia402_factors_cannot_change_under_power(rig, name):
    rig.put(**{name: 7}).enable(1)
    assert rig.drive.write(int(name[1:5], 16), int(name[-1]), 8, 4) == 0x08000022
    rig.word(0x06).put(**{name: 8})


def test_cia402_607e_bit_7_turns_positions_round(polar):
    move(polar.put(_607E=0x80).enable(1), 300)
    assert (polar.counts, polar.signed(0x6064)) == (-300, 300)


def test_cia402_607e_bit_7_turns_the_software_limits_round(polar):
    polar.put(_607E=0x80, _607D_1=-100, _607D_2=300).enable(9).drive.nmt(0x01)
    velocity(polar, 20_000, 20)
    assert (polar.counts, polar.signed(0x6064)) == (100, -100)
    velocity(polar, -20_000, 30)
    assert (polar.counts, polar.signed(0x6064)) == (-300, 300)


def test_cia402_607e_bit_7_turns_homing_round(polar):
    polar.put(_607E=0x80, _6098=34, _607C=30).enable(6).word(0x1F).run(1500)
    assert (polar.counts, polar.signed(0x6064)) == (-1000, -30)


def test_cia402_607e_bit_6_turns_velocities_round(polar):
    polar.put(_607E=0x40).enable(9).drive.nmt(0x01)
    velocity(polar, 4000)
    assert polar.signed(0x606C) == 4000
    assert polar.counts < 0


def test_cia402_6080_max_motor_speed_is_turns_a_minute(polar):
    polar.put(_6080=300).enable(9).drive.nmt(0x01)
    velocity(polar, 6000)
    assert (polar.signed(0x606C), polar.bits(11)) == (5000, (1,))  # 5 turns of 1000 counts a second
