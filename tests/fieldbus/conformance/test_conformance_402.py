"""Points 52, 56 and 59: a drive at work, by raw frames. Source: CiA 402-2. All other points: tests/fieldbus/drive/."""

from __future__ import annotations

import pytest
from conformance_bench import ON_BOTH_BUSES

CYCLE_MS = 100  # 60C2h as the bench sets it
SHUTDOWN, SWITCH_ON, ENABLE, VOLTAGE = 0x06, 0x07, 0x0F, 0x00
# Written out from the standard: mask and pattern of the statusword.
STATES = {"switch on disabled": (0x4F, 0x40), "quick stop active": (0x6F, 0x07), "fault": (0x4F, 0x08)}
FOLLOWING_ERROR, NO_ERROR = "1186210000000000", "0000000000000000"


def is_in(drive, state):
    mask, pattern = STATES[state]
    return drive.read(0x6041) & mask == pattern


def reaches(drive, state):
    """Automatic transitions take a step or two: look until the statusword tells `state`."""
    for _ in range(20):
        if is_in(drive, state):
            return True
        drive.silence(5)
    return False


class Master:
    """SYNC with a counter, the TPDO that it causes, and then an RPDO."""

    def __init__(self, drive):
        self.drive, self.counter = drive, 0
        self.emergencies = []
        drive.nmt(0x01)

    def sync(self):
        """One SYNC; statusword and position of the answer."""
        self.counter = self.counter % 240 + 1
        self.drive.send(0x80, f"{self.counter:02x}")
        while (heard := self.drive.next()).can_id != 0x181:
            assert heard.can_id == 0x81, heard
            self.emergencies.append(heard.text)
        data = bytes.fromhex(heard.text)
        return int.from_bytes(data[:2], "little"), int.from_bytes(data[2:6], "little", signed=True)

    def rpdo(self, target, word=ENABLE):
        self.drive.send(0x201, (word.to_bytes(2, "little") + target.to_bytes(4, "little", signed=True)).hex())

    def cycle(self, target, word=ENABLE, ms=CYCLE_MS):
        """SYNC, RPDO, and the rest of the period."""
        told = self.sync()
        self.rpdo(target, word)
        self.drive.silence(ms)
        return told

    def enable(self):
        for word in (SHUTDOWN, SWITCH_ON, ENABLE, ENABLE, ENABLE):
            told = self.cycle(0, word, 10)
        assert told[0] & 0x6F == 0x27
        return self


def test_cia402_52_fault_reaction_emcy_and_reset_on_a_rising_edge(drive, plant):
    master = Master(drive).enable()
    drive.set((0x6065, 0, 100, 4), (0x6066, 0, 0, 2))
    plant.stuck = True
    for _ in range(6):
        told = master.cycle(101)
        if master.emergencies:
            break
    assert master.emergencies == [FOLLOWING_ERROR]
    assert told[0] & 1 << 13 or master.sync()[0] & 1 << 13
    assert reaches(drive, "fault")
    assert (drive.read(0x603F), drive.read(0x1001)) == (0x8611, 0x21)
    for word in (ENABLE, SHUTDOWN, VOLTAGE):
        drive.set((0x6040, 0, word, 2))
        assert is_in(drive, "fault")
    drive.send(0x601, "2b40600080000000")
    drive.expect((0x81, NO_ERROR), (0x581, "6040600000000000"))
    assert is_in(drive, "switch on disabled")
    assert (drive.read(0x603F), drive.read(0x1001)) == (0, 0)


def test_cia402_56_interpolation_between_syncs(drive, plant):
    drive.set((0x6065, 0, 0xFFFFFFFF, 4))  # on a slow machine the bench is late, and nothing else
    master = Master(drive).enable()
    master.cycle(1000)
    assert master.sync()[1] == 0  # latched here
    master.rpdo(1000)
    drive.silence(CYCLE_MS / 2)
    half = drive.read(0x6064)
    half = half - (1 << 32) if half >> 31 else half
    drive.silence(CYCLE_MS)
    master.rpdo(1000)
    assert 0 < half <= 1000
    if not drive.real_time:
        assert half == 500
    assert master.sync()[1] == 1000


@pytest.mark.parametrize("lost", ["SYNC", "RPDO"])
@ON_BOTH_BUSES
def test_cia402_59_a_silent_master_stops_the_drive(drive, lost):
    drive.set((0x605A, 0, 6, 2))
    master = Master(drive).enable()
    master.sync()
    if lost == "SYNC":
        drive.expect((0x81, "0081110000000000"), within_ms=6 * CYCLE_MS)
    else:
        for _ in range(5):
            assert master.emergencies == []
            master.sync()
        assert master.emergencies == ["5082110000000000"]
    assert reaches(drive, "quick stop active")
