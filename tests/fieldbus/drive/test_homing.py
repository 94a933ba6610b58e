"""Homing, CiA 402-2: limit switches, index pulses, the present position, the three bits, home offset, errors."""

from __future__ import annotations

from copy import deepcopy

import pytest
from canopen.objectdictionary import ODVariable

from canprobe.fieldbus import load_eds
from canprobe.fieldbus.drive import make_drive_node

START, HALT = 0x1F, 0x10F
UNDER_WAY, NOT_STARTED, DONE = (0, 0, 0), (0, 0, 1), (0, 1, 1)
ERROR_MOVING, ERROR_AT_REST = (1, 0, 0), (1, 0, 1)


def bits(rig):
    return rig.bits(13, 12, 10)


@pytest.fixture
def homing(rig):
    """The motor stands 250.25 counts behind an index pulse; a turn is 1000."""
    rig.plant.ramps.clear()
    rig.plant.counts[0] = 250.25
    rig.put(_6099_2=4000, _609A=100_000).enable(6).run(10)
    return rig


@pytest.mark.parametrize(("method", "home"), [(33, 0.0), (34, 1000.0)])
@pytest.mark.parametrize("offset", [0, 70, -70])
def test_cia402_55_first_index_pulse_in_a_direction(homing, method, home, offset):
    homing.put(_6098=method, _607C=offset)
    assert bits(homing) == NOT_STARTED
    homing.word(START)
    assert bits(homing) == UNDER_WAY
    homing.run(600)
    assert bits(homing) == DONE
    assert homing.counts == pytest.approx(home, abs=1e-9)
    assert homing.signed(0x6064) == -offset  # zero is home + offset
    assert homing.signed(0x607A) == -offset


@pytest.mark.parametrize(("method", "pulse"), [(33, -1000), (34, 1000)])
def test_cia402_55_a_pulse_right_here_has_been_passed(rig, method, pulse):
    rig.put(_6098=method).enable(6).word(START).run(1200)
    assert (rig.counts, bits(rig)) == (pulse, DONE)


@pytest.mark.parametrize("method", [35, 37])
@pytest.mark.parametrize("offset", [0, 123, -123])
def test_cia402_55_the_present_position_is_home(homing, method, offset):
    homing.put(_6098=method, _607C=offset).word(START)
    assert bits(homing) == DONE
    homing.run(50)
    assert (homing.counts, homing.signed(0x6064)) == (250.25, -offset)


def test_cia402_55_it_overshoots_the_pulse_and_comes_back(homing):
    homing.put(_6098=34).word(START).run(600)
    assert 1000 + 4000**2 / 2e5 <= max(counts for _, counts in homing.trace) <= 1000 + 4000**2 / 2e5 + 4000 * 2.5e-3


@pytest.mark.parametrize("method", [3, 7, 19, 30, 36])
def test_cia402_55_methods_that_need_a_home_switch_are_refused(homing, method):
    assert homing.drive.write(0x6098, 0, method, 1) == 0x06090030


@pytest.mark.parametrize("wrong", [{"_6098": 0}, {"_6098": 34, "_6099_2": 0}])
def test_cia402_55_what_cannot_be_searched_is_an_error(homing, wrong):
    homing.put(**wrong).word(START)
    assert bits(homing) == ERROR_MOVING  # until it is known to be at rest
    homing.run(5)
    assert bits(homing) == ERROR_AT_REST
    homing.put(_6098=35, _6099_2=100).word(0x0F).word(START)
    assert bits(homing) == DONE


def test_cia402_55_no_pulse_within_two_turns_is_an_error(homing):
    homing.put(_6098=34).plant.stuck = True
    homing.word(START).run(560)
    assert (bits(homing), homing.drive.read(0x6062)) == (ERROR_AT_REST, 2250)
    assert homing.drive.read(0x6041) & 0x6F == 0x27


@pytest.mark.parametrize("word", [0x0F, HALT, HALT | 0x10])
def test_cia402_55_60_taking_bit_4_away_or_halt_interrupts(homing, word):
    homing.put(_6098=34).word(START).run(60)
    homing.word(word)
    assert bits(homing) == UNDER_WAY
    homing.run(100)
    assert bits(homing) == NOT_STARTED
    assert homing.counts < 800
    homing.word(0x0F)
    assert homing.run(300).counts < 800
    homing.word(START).run(600)
    assert (homing.counts, bits(homing)) == (1000, DONE)


def test_cia402_55_60_with_bit_4_kept_homing_starts_again_after_halt(homing):
    homing.put(_6098=34).word(START).run(60).word(HALT | 0x10).run(100).word(START)
    assert bits(homing) == UNDER_WAY
    assert homing.run(600).counts == 1000


@pytest.fixture
def switched(homing):
    """Limit switches at -1500.5 and 2600.25, speeds of 8000 and 800."""
    homing.plant.switches = (-1500.5, 2600.25)
    return homing.put(_6099_1=8000, _6099_2=800)


@pytest.mark.parametrize(
    ("method", "home", "start"),
    [
        (17, -1500.5, 250.25),
        (17, -1500.5, -1600.0),
        (18, 2600.25, -1600.0),
        (18, 2600.25, 2700.0),
        (1, -1000, 250.25),
        (2, 2000, 2700.0),
    ],
)
def test_cia402_55_limit_switches_and_the_pulse_behind_them(switched, method, home, start):
    switched.plant.ramps.clear()
    switched.plant.counts[0] = start
    switched.word(0x06).word(0x07).word(0x0F).run(5).put(_6098=method, _607C=40).word(START)
    assert bits(switched) == UNDER_WAY
    switched.run(4000)
    assert bits(switched) == DONE
    assert switched.counts == pytest.approx(home, abs=1e-6)
    assert switched.signed(0x6064) == -40


def test_cia402_55_switch_at_6099_01_and_back_at_02(switched):
    switched.put(_6098=18).word(START).run(2000)
    speeds = [(b - a) / 0.5e-3 for (_, a), (_, b) in zip(switched.trace, switched.trace[1:], strict=False)]
    assert max(speeds) == pytest.approx(8000)
    assert min(speeds) == pytest.approx(-800)
    reached = max(counts for _, counts in switched.trace)
    assert 2600.25 <= reached <= 2600.25 + 8000 * 2.5e-3 + 8000**2 / 2e5


def test_cia402_55_607e_turns_the_switches_round(switched):
    switched.drive.node.application.parts.parameters.units.scale = -1.0
    switched.put(_6098=17).word(START).run(4000)
    assert (switched.counts, bits(switched)) == (pytest.approx(2600.25), DONE)


@pytest.mark.parametrize("method", [2, 17])
def test_cia402_55_a_switch_that_is_never_found_is_an_error(homing, method):
    homing.put(_6098=method, _6099_1=100_000, _6065=0xFFFFFFFF).word(START)
    homing.run(179_000, step_us=20_000)
    assert bits(homing) == UNDER_WAY
    homing.run(5_000, step_us=20_000)
    assert bits(homing) == ERROR_AT_REST


def test_cia402_55_a_switch_that_is_never_left_is_an_error(switched):
    switched.plant.switches = (1e9, 1e10)
    switched.put(_6098=17).word(START).run(185_000, step_us=20_000)
    assert bits(switched) == ERROR_AT_REST


@pytest.mark.parametrize("speed", [{"_6099_1": 0}, {"_6099_2": 0}])
def test_cia402_55_switches_need_both_speeds(switched, speed):
    switched.put(_6098=17, **speed).word(START).run(5)
    assert bits(switched) == ERROR_AT_REST


def test_cia402_55_an_incremental_drive_counts_from_0_at_every_node_reset(rig):
    rig.plant.counts[0] = 777.0
    rig.drive.node = make_drive_node(load_eds("puma260_joint", 1), 1, 0, rig.plant, incremental=True)
    rig.drive.node.start(0)
    assert rig.signed(0x6064) == 0
    rig.put(_1019=240, _1006=2500, _6098=35, _607C=-55).enable(6).run(10).word(START)
    assert (bits(rig), rig.signed(0x6064)) == (DONE, 55)
    rig.word(0x06).drive.nmt(0x82)
    assert rig.signed(0x6064) == 55
    rig.put(_6060=6, _1019=240, _1006=2500).enable(6).run(10)
    assert bits(rig) == DONE, "reset communication keeps the zero"
    rig.word(0x06).drive.nmt(0x81)
    assert rig.signed(0x6064) == 0
    rig.put(_1019=240, _1006=2500).enable(6).run(10)
    assert bits(rig) == NOT_STARTED


def test_cia402_60fd_shows_the_limit_switches(rig):
    od = deepcopy(load_eds("puma260_joint", 1))
    inputs = ODVariable("Digital inputs", 0x60FD)
    inputs.data_type, inputs.access_type, inputs.default, inputs.pdo_mappable = 0x7, "ro", 0, True
    od.add_object(inputs)
    rig.drive.node = make_drive_node(od, 1, 0, rig.plant)
    rig.drive.node.start(0)
    rig.plant.switches = (-10.0, 10.0)
    for counts, shown in ((0.0, 0), (-10.0, 1), (10.5, 2)):
        rig.plant.counts[0] = counts
        assert rig.drive.read(0x60FD) == shown


def test_cia402_55_moves_and_limits_refer_to_the_new_zero(homing):
    homing.put(_6098=35, _607C=-50, _607D_1=-40, _607D_2=40).word(START).word(0x0F)
    homing.put(_6060=1).run(5)
    homing.put(_607A=0).word(0x1F).run(400)
    assert homing.counts == pytest.approx(250.25 - 50)
    homing.word(0x0F).put(_607A=1000).word(0x1F).run(400)
    assert homing.counts == pytest.approx(250.25 - 50 + 40)


def test_cia402_55_leaving_the_mode_gives_the_run_up(homing):
    homing.put(_6098=34).word(START).run(60).put(_6060=1).run(800)
    assert homing.counts < 800
    homing.put(_6060=6).run(10)
    assert bits(homing) == NOT_STARTED
