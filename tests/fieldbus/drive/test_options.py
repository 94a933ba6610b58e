"""Options and states in every mode, CiA 402-2: 605Ah–605Eh, halt in CSP, changes of mode under way, 6502h."""

from __future__ import annotations

from copy import deepcopy

import pytest

from canprobe.fieldbus import load_eds
from canprobe.fieldbus.drive import make_drive_node

SLOW, QUICK = 50_000, 400_000
SPEED = 10_000
MODES = [1, 6, 8, 9, 10]


def set_in_motion(rig, mode):
    """The drive moves at SPEED, at a SYNC; returns how fast its reference is then."""
    rig.put(_6084=SLOW, _6085=QUICK, _605A=6)
    rig.put(_6081=SPEED, _6083=10**6, _6099_2=SPEED, _609A=10**6, _6098=34, _607F=SPEED)
    rig.enable(mode)
    rig.drive.nmt(0x01)
    rig.put(_607A=10**6 if mode != 8 else 0, _60FF=SPEED, _6071=2000)
    if mode in (1, 6):
        return rig.word(0x1F).run(50)
    for k in range(1, 61):
        rig.put(_607A=25 * k, _60FF=SPEED, _6071=2000).cycles(1)
    return rig


def travelled(rig, ms=300):
    start = rig.counts
    return rig.run(ms).counts - start


@pytest.mark.parametrize(
    ("mode", "option", "rate", "end"),
    [(1, 1, SLOW, 0x40), (6, 2, QUICK, 0x40), (8, 5, SLOW, 0x07), (9, 6, QUICK, 0x07), (10, 6, QUICK, 0x07)],
)
def test_cia402_51_quick_stop_in_every_mode(rig, mode, option, rate, end):
    set_in_motion(rig, mode).put(_605A=option, _6040=0x02)
    assert travelled(rig) == pytest.approx(SPEED**2 / (2 * rate))
    assert rig.drive.read(0x6041) & 0x4F == end


@pytest.mark.parametrize(
    ("mode", "option", "rate"), [(1, 1, SLOW), (6, 2, QUICK), (8, 2, QUICK), (9, 1, SLOW), (10, 2, QUICK)]
)
def test_cia402_52_fault_reaction_in_every_mode(rig, mode, option, rate):
    set_in_motion(rig, mode).put(_605E=option).drive.node.application.inject_fault(0x2310)
    rig.drive.advance(rig.drive.t_ns)
    assert rig.drive.read(0x6041) & 0x4F == 0x0F
    assert travelled(rig) == pytest.approx(SPEED**2 / (2 * rate))
    assert rig.drive.read(0x6041) & 0x4F == 0x08


@pytest.mark.parametrize(
    ("mode", "word", "state", "option"),
    [(1, 0x06, 0x21, 1), (6, 0x07, 0x23, 1), (8, 0x06, 0x21, 0), (9, 0x07, 0x23, 0), (10, 0x06, 0x21, 1)],
)
def test_cia402_605b_605c_shutdown_and_disable_in_every_mode(rig, mode, word, state, option):
    other = 1 - option
    options = {"_605B": option, "_605C": other} if word == 0x06 else {"_605B": other, "_605C": option}
    set_in_motion(rig, mode).put(**options, _6040=word)
    assert rig.drive.read(0x6041) & 0x6F == state
    assert travelled(rig) == pytest.approx(SPEED**2 / (2 * SLOW) if option else 0.0)


@pytest.mark.parametrize(
    ("mode", "option", "rate"), [(1, 2, QUICK), (6, 1, SLOW), (8, 1, SLOW), (9, 2, QUICK), (10, 1, SLOW)]
)
def test_cia402_60_halt_in_every_mode(rig, mode, option, rate):
    set_in_motion(rig, mode).put(_605D=option, _1006=0).word(0x10F)
    assert rig.bits(10) == (0,)
    start = rig.counts
    for _ in range(100):
        rig.put(_607A=10**6, _60FF=SPEED, _6071=2000).cycles(1)
    assert rig.counts - start == pytest.approx(SPEED**2 / (2 * rate))
    assert rig.drive.read(0x6041) & 0x6F == 0x27
    assert rig.bits(10) == (1,)


def test_cia402_60_csp_follows_again_after_halt(rig):
    set_in_motion(rig, 8).word(0x10F)
    for _ in range(100):
        rig.put(_607A=1500).cycles(1)
    assert rig.bits(10, 12) == (1, 0)
    assert rig.counts == pytest.approx(1475 + SPEED**2 / (2 * SLOW))
    rig.word(0x0F)
    assert rig.bits(10, 12) == (0, 1)
    rig.put(_607A=1500).cycles(3)
    assert rig.counts == 1500


@pytest.mark.parametrize("word", [0x0F, 0x10F])
def test_cia402_60_enabling_with_halt_set(rig, word):
    rig.put(_6060=1)
    for earlier in (0x06, 0x07, word):
        rig.word(earlier)
    rig.put(_607A=100).word(word | 0x10).run(200)
    assert rig.counts == (100 if word == 0x0F else 0)


@pytest.mark.parametrize(("old", "new"), [(1, 0), (6, 1), (8, 6), (9, 10), (10, 9), (1, 1), (6, 6), (9, 9), (10, 10)])
def test_cia402_53_a_new_mode_under_way_slows_down_by_6084(rig, old, new):
    set_in_motion(rig, old).put(_6060=new)
    assert rig.drive.read(0x6061) == new
    assert rig.drive.read(0x6041) & 0x6F == 0x27
    travel = travelled(rig, 10)
    if new == old:
        assert travel == pytest.approx(SPEED * 0.010)
    else:
        assert travel == pytest.approx(SPEED * 0.010 - SLOW * 0.010**2 / 2)


def test_cia402_53_csp_takes_over_where_a_velocity_has_come(rig):
    set_in_motion(rig, 9).put(_6060=8)
    start = rig.counts
    for k in range(1, 11):
        rig.put(_607A=round(start) + 25 * k).cycles(1)
    assert rig.counts == pytest.approx(start + 225, abs=1)
    assert rig.bits(12) == (1,)
    rig.put(_6060=1, _607A=0).word(0x1F).run(800)
    assert (rig.counts, rig.bits(10)) == (0, (1,))


# Written out from the standard: state by its statusword, controlwords that lead there, and where each command leads.
PATHS = {
    0x40: (),
    0x21: (0x06,),
    0x23: (0x06, 0x07),
    0x27: (0x06, 0x07, 0x0F),
    0x07: (0x06, 0x07, 0x0F, 0x02),
    0x08: (),
}
GOALS = {
    0x40: {0x06: 0x21},
    0x21: {0x07: 0x23, 0x0F: 0x23, 0x00: 0x40, 0x02: 0x40},
    0x23: {0x06: 0x21, 0x0F: 0x27, 0x00: 0x40, 0x02: 0x40},
    0x27: {0x06: 0x21, 0x07: 0x23, 0x00: 0x40, 0x02: 0x07},
    0x07: {0x0F: 0x27, 0x00: 0x40},
    0x08: {0x80: 0x40},
}
MASK = {0x40: 0x4F, 0x08: 0x4F}


@pytest.mark.parametrize("mode", [0, *MODES])
def test_cia402_48_49_50_every_command_in_every_state_of_every_mode(rig, mode):
    for state, path in PATHS.items():
        for word in (0x00, 0x02, 0x06, 0x07, 0x0F, 0x80):
            rig.drive.nmt(0x81)
            rig.put(_6060=mode, _605A=6)
            if state == 0x08:
                rig.drive.node.application.inject_fault(0x2310)
                rig.run(5)
            for before in path:
                rig.put(_6040=before)
            assert rig.drive.read(0x6041) & MASK.get(state, 0x6F) == state
            rig.put(_6040=word)
            goal = GOALS[state].get(word, state)
            assert rig.drive.read(0x6041) & MASK.get(goal, 0x6F) == goal, (mode, hex(state), hex(word))


def test_cia402_51_quick_stop_options_that_do_not_exist(rig):
    for option in (0, 3, 4, 7, 8):
        assert rig.drive.write(0x605A, 0, option, 2) in (0x06090030, 0x06090031, 0x06090032)


@pytest.mark.parametrize(
    ("without", "bits"), [((), 0x3A1), ((0x60FF,), 0x2A1), ((0x6071, 0x6098), 0x181), ((0x6081,), 0x3A0)]
)
def test_cia402_53_6502_is_what_the_eds_has_the_objects_for(plant, without, bits):
    od = deepcopy(load_eds("puma260_joint", 1))
    for index in without:
        del od[index]
    node = make_drive_node(od, 1, 0, plant)
    node.start(0)
    assert node.dictionary.values[0x6502 << 8] == bits


def test_a_poor_eds_without_the_optional_objects_still_moves(rig):
    od = deepcopy(load_eds("puma260_joint", 1))
    for index in [index for index in od if index >= 0x6000]:
        if index not in (0x6040, 0x6041, 0x6060, 0x6061, 0x6064, 0x607A, 0x6081, 0x6098, 0x60FF, 0x6071):
            del od[index]
    rig.drive.node = make_drive_node(od, 1, 0, rig.plant)
    rig.drive.node.start(0)
    rig.put(_1006=2500, _6081=5000).enable(1).put(_607A=300).word(0x1F).run(300)
    assert rig.counts == 300
    for mode in (6, 8, 9, 10):
        rig.put(_6060=mode).word(0x1F).run(5)
    rig.put(_6040=0x02).run(50)
    assert rig.drive.read(0x6041) & 0x4F == 0x40


def test_cia402_60b0_position_offset_is_added(rig):
    rig.put(_60B0=-30).enable(8).drive.nmt(0x01)
    for _ in range(4):
        rig.put(_607A=100).cycles(1)
    assert rig.counts == 70


@pytest.mark.parametrize("mode", [8, 9])
def test_cia402_58_bit_11_when_the_motion_takes_all_of_6072h(rig, plant, mode):
    rig.put(_6072=300).enable(mode).drive.nmt(0x01)
    for torque, limited in ((0, 0), (300, 1), (-301, 1), (-299, 0)):
        plant.torque = torque
        rig.put(_607A=0, _60FF=100).cycles(2)
        rig.put(_607A=0, _60FF=100).cycles(1)
        assert rig.bits(11) == (limited,)
    rig.put(_6060=1)
    plant.torque = -301
    assert rig.run(5).bits(11) == (1,)
