"""Interpolated position (mode 7), CiA 402-2: 60C1h:01 at SYNC, controlword bit 4, statusword bit 12, halt."""

from __future__ import annotations

import pytest

from canprobe.fieldbus import load_eds
from canprobe.fieldbus.drive import make_drive_node

CYCLE = 10_000_000
ENABLED, ACTIVE, HALTED = 0x0F, 0x1F, 0x11F
RPDO = 0x201


class Master:
    """RPDO1 with 6040h and 60C1h:01, SYNC without a counter every 10 ms."""

    def __init__(self, rig):
        self.rig, self.bench, self.plant = rig, rig.drive, rig.plant
        self.bench.node = make_drive_node(load_eds("prbt_joint", 1), 1, 0, self.plant)
        self.bench.node.start(0)
        rig.put(_60C2_1=10, _1400_1=0x80000201, _1600_0=0, _1600_1=0x60400010, _1600_2=0x60C10120)
        rig.put(_1600_0=2, _1400_1=0x201, _1400_2=1, _6060=7)
        self.k, self.word = 0, 0

    def cycle(self, target, word=None):
        """SYNC, and 0.3 ms behind it the record for the next one."""
        self.word = self.word if word is None else word
        self.k += 1
        t_ns = self.k * CYCLE
        frames = self.bench.advance(t_ns) + self.bench.send(0x80, "", t_ns)
        data = self.word.to_bytes(2, "little") + target.to_bytes(4, "little", signed=True)
        self.bench.send(RPDO, data.hex(), t_ns + 300_000)
        return frames

    def half(self):
        """Position in the middle of the cycle under way."""
        self.bench.advance(self.k * CYCLE + CYCLE // 2)
        return self.rig.counts


@pytest.fixture
def master(rig):
    master = Master(rig)
    master.bench.nmt(0x01)
    for word in (0x06, 0x07, ENABLED, ENABLED, ENABLED):
        master.cycle(0, word)
    assert rig.drive.read(0x6041) & 0x6F == 0x27
    return master


def test_cia402_74_targets_are_not_followed_without_bit_4(master):
    for _ in range(4):
        master.cycle(500)
    assert (master.rig.counts, master.rig.bits(12)) == (0, (0,))
    assert master.rig.signed(0x6061) == 7


def test_cia402_74_records_are_reached_by_a_straight_line_over_60c2(master):
    master.cycle(0, ACTIVE)
    master.cycle(1000)
    assert master.rig.bits(12) == (1,)
    master.cycle(2000)  # SYNC latches 1000
    assert master.half() == pytest.approx(500)
    master.cycle(2000)
    assert master.half() == pytest.approx(1500)
    master.cycle(2000)
    assert master.half() == 2000


def test_cia402_74_the_record_that_stands_is_followed_when_bit_4_comes(master):
    """As drives do: a master has to write the present position first."""
    for put in ({"_60C1_1": 300}, {"_6040": ACTIVE}, {}):
        master.k += 1
        master.bench.advance(master.k * CYCLE)
        master.bench.send(0x80, "", master.k * CYCLE)
        master.rig.put(**put)
    assert master.half() == pytest.approx(150)


def test_cia402_74_without_bit_4_the_motion_ends(master):
    for target in range(0, 5000, 500):
        master.cycle(target, ACTIVE)
    moving = master.half()
    master.cycle(5000, ENABLED)
    for _ in range(4):
        master.cycle(9000)
    assert moving < master.rig.counts <= 5000
    assert master.rig.bits(12, 10) == (0, 1)
    master.cycle(round(master.rig.counts), ACTIVE)
    master.cycle(4800)
    master.cycle(4800)
    master.cycle(4800)
    assert (master.rig.counts, master.rig.bits(12)) == (4800, (1,))


def test_cia402_60_74_halt_holds_and_the_next_record_goes_on(master):
    for target in range(0, 3000, 300):
        master.cycle(target, ACTIVE)
    master.cycle(3000, HALTED)
    for _ in range(3):
        master.cycle(3000)
    rest = master.rig.counts
    assert rest < 3000
    assert master.rig.bits(12, 10) == (0, 1)
    master.cycle(3000, ACTIVE)
    master.cycle(3000)
    master.cycle(3000)
    assert (master.rig.counts, master.rig.bits(12)) == (3000, (1,))


def test_cia402_74_bit_4_may_come_with_enable_operation(master):
    master.cycle(0, 0x07)
    for _ in range(3):
        master.cycle(0, ACTIVE)
    assert master.rig.bits(12) == (1,)


def test_cia402_59_74_silence_of_sync_or_records(master):
    master.rig.put(_200E=4)
    master.cycle(0, ACTIVE)
    last_ns = master.k * CYCLE
    assert master.bench.advance(last_ns + 4 * CYCLE + CYCLE // 2 - 1) == []
    assert master.bench.advance(last_ns + 4 * CYCLE + CYCLE // 2) == [(0x81, "0081110000000000")]
    assert master.rig.bits(12) == (0,)


def test_cia402_59_74_records_that_are_missing(master):
    master.rig.put(_200E=3)
    master.cycle(0, ACTIVE)
    heard = []
    for _ in range(4):
        master.k += 1
        heard += master.bench.advance(master.k * CYCLE) + master.bench.send(0x80, "", master.k * CYCLE)
    assert (0x81, "5082110000000000") in heard


def test_cia402_74_60c0_is_linear_or_a_makers(master):
    assert master.bench.write(0x60C0, 0, -1, 2) == 0
    assert master.bench.write(0x60C0, 0, 1, 2) in (0x06090030, 0x06090031)


def test_cia402_74_a_halt_of_the_time_before_is_over(master):
    master.cycle(0, ACTIVE)
    master.cycle(0, HALTED)
    master.cycle(0, 0x07)
    for word in (ENABLED, ENABLED, ACTIVE):
        master.cycle(0, word)
    master.cycle(1000)
    master.cycle(2000)
    assert master.half() == pytest.approx(500)
