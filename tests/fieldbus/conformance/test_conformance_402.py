"""Points 48–60 and 74: the drive, by raw frames. Source: CiA 402-2. Modes in depth: tests/fieldbus/drive/."""

from __future__ import annotations

import pytest
from conformance_bench import ON_BOTH_BUSES

from canprobe.fieldbus import load_eds
from canprobe.fieldbus.drive import make_drive_node

CYCLE_MS = 100  # 60C2h as the bench sets it
SHUTDOWN, SWITCH_ON, ENABLE, VOLTAGE, QUICK, RESET = 0x06, 0x07, 0x0F, 0x00, 0x02, 0x80
COMMANDS = (SHUTDOWN, SWITCH_ON, ENABLE, VOLTAGE, QUICK, RESET)

# Written out from the standard. State: (mask, pattern) of the statusword, controlwords that lead there from power on.
STATES = {
    "switch on disabled": ((0x4F, 0x40), []),
    "ready to switch on": ((0x6F, 0x21), [SHUTDOWN]),
    "switched on": ((0x6F, 0x23), [SHUTDOWN, SWITCH_ON]),
    "operation enabled": ((0x6F, 0x27), [SHUTDOWN, SWITCH_ON, ENABLE]),
    "quick stop active": ((0x6F, 0x07), [SHUTDOWN, SWITCH_ON, ENABLE, QUICK]),
    "fault": ((0x4F, 0x08), []),
}
TABLE = {
    "switch on disabled": {SHUTDOWN: "ready to switch on"},
    "ready to switch on": {
        SWITCH_ON: "switched on",
        ENABLE: "operation enabled",  # through switched on
        VOLTAGE: "switch on disabled",
        QUICK: "switch on disabled",
    },
    "switched on": {
        SHUTDOWN: "ready to switch on",
        ENABLE: "operation enabled",
        VOLTAGE: "switch on disabled",
        QUICK: "switch on disabled",
    },
    "operation enabled": {
        SHUTDOWN: "ready to switch on",
        SWITCH_ON: "switched on",
        VOLTAGE: "switch on disabled",
        QUICK: "quick stop active",
    },
    "quick stop active": {ENABLE: "operation enabled", VOLTAGE: "switch on disabled"},
    "fault": {RESET: "switch on disabled"},
}
FOLLOWING_ERROR, NO_ERROR = "1186210000000000", "0000000000000000"


def is_in(drive, state):
    mask, pattern = STATES[state][0]
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


def bring(drive, plant, state, option=6):
    """To `state`, with 605Ah = `option`; fault by a motor that does not follow."""
    drive.set((0x605A, 0, option, 2))
    if state == "fault":
        fail(Master(drive).enable(), plant)
        drive.nmt(0x80)
        drive.set((0x6040, 0, 0, 2))
    for word in STATES[state][1]:
        drive.set((0x6040, 0, word, 2))
    assert reaches(drive, state)


def fail(master, plant):
    """Block the motor until the drive reports a following error."""
    master.drive.set((0x6065, 0, 100, 4), (0x6066, 0, 0, 2))
    plant.stuck = True
    for _ in range(6):
        told = master.cycle(101)
        if master.emergencies:
            break
    assert master.emergencies == [FOLLOWING_ERROR]
    return told


@pytest.mark.parametrize("state", STATES)
def test_cia402_48_statusword_masks(drive, plant, state):
    bring(drive, plant, state)
    assert [other for other in STATES if is_in(drive, other)] == [state]


@pytest.mark.parametrize("state", TABLE)
@pytest.mark.parametrize("word", COMMANDS)
def test_cia402_49_50_every_command_in_every_state(drive, plant, state, word):
    bring(drive, plant, state)
    drive.send(0x601, f"2b406000{word:02x}000000")
    while (heard := drive.next()).can_id != 0x581:
        assert heard[:2] == (0x81, NO_ERROR)
    assert reaches(drive, TABLE[state].get(word, state))


@pytest.mark.parametrize(
    ("option", "after"),
    [(1, "switch on disabled"), (2, "switch on disabled"), (5, "quick stop active"), (6, "quick stop active")],
)
def test_cia402_51_quick_stop_options(drive, plant, option, after):
    bring(drive, plant, "operation enabled", option)
    drive.set((0x6040, 0, QUICK, 2))
    assert reaches(drive, after)
    if after == "quick stop active":
        drive.silence(20)
        assert drive.read(0x6041) & 0x46F == 0x407  # at rest, and stays
    drive.set((0x6040, 0, ENABLE, 2))
    assert is_in(drive, "operation enabled") is (option in (5, 6))


def test_cia402_51_options_that_do_not_exist(drive):
    for option in (0, 3, 4, 7, 8):
        assert drive.write(0x605A, 0, option, 2) in (0x06090030, 0x06090031, 0x06090032)


def test_cia402_52_fault_reaction_emcy_and_reset_on_a_rising_edge(drive, plant):
    fail(Master(drive).enable(), plant)
    assert reaches(drive, "fault")
    assert (drive.read(0x603F), drive.read(0x1001)) == (0x8611, 0x21)
    for word in (ENABLE, SHUTDOWN, VOLTAGE):
        drive.set((0x6040, 0, word, 2))
        assert is_in(drive, "fault")
    drive.send(0x601, "2b40600080000000")
    drive.expect((0x81, NO_ERROR), (0x581, "6040600000000000"))
    assert is_in(drive, "switch on disabled")
    assert (drive.read(0x603F), drive.read(0x1001)) == (0, 0)


def test_cia402_52_a_standing_reset_bit_does_not_reset(drive, plant):
    master = Master(drive).enable()
    drive.set((0x6065, 0, 100, 4), (0x6066, 0, 0, 2))
    plant.stuck = True
    while not master.emergencies:
        master.cycle(101)
    drive.nmt(0x80)
    drive.send(0x601, "2b40600080000000")
    drive.expect((0x81, NO_ERROR), (0x581, "6040600000000000"))
    plant.stuck = False
    drive.nmt(0x01)
    drive.set((0x6040, 0, 0x80, 2))
    for word in (SHUTDOWN, SWITCH_ON):
        drive.set((0x6040, 0, word, 2))
    assert is_in(drive, "switched on")


def test_cia402_53_mode_display_follows_and_supported_modes_are_true(drive):
    supported = drive.read(0x6502)
    assert supported >> 7 & 1  # cyclic synchronous position
    for mode in range(1, 11):
        drive.set((0x6060, 0, 0, 1))
        code = drive.write(0x6060, 0, mode, 1)
        assert code == (0 if supported >> mode - 1 & 1 else 0x06090030), mode
        assert drive.read(0x6061) == (0 if code else mode)


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


def test_cia402_56_following_error(drive, plant):
    master = Master(drive).enable()
    told = fail(master, plant)
    assert told[0] & 1 << 13 or master.sync()[0] & 1 << 13
    assert master.sync()[0] & 0x6F in (0x0F, 0x08, 0x28, 0x2F)


def test_cia402_56_bit_12_drive_follows(drive, plant):
    bring(drive, plant, "operation enabled")
    assert drive.read(0x6041) & 1 << 12
    drive.set((0x6040, 0, SWITCH_ON, 2))
    assert not drive.read(0x6041) & 1 << 12


@pytest.mark.parametrize(
    ("target", "reached", "limited"), [(900, 900, 0), (1100, 1000, 1), (-1100, -500, 1), (1000, 1000, 0)]
)
def test_cia402_57_software_limits(drive, target, reached, limited):
    drive.set((0x607D, 1, -500, 4), (0x607D, 2, 1000, 4), (0x6065, 0, 0xFFFFFFFF, 4))
    master = Master(drive).enable()
    for _ in range(4):
        statusword, position = master.cycle(target)
    assert (position, statusword >> 11 & 1) == (reached, limited)
    for _ in range(3):
        statusword, _ = master.cycle(0)
    assert statusword >> 11 & 1 == 0


def power(drive, plant, mode):
    """Operation enabled in a mode, no following error to watch."""
    drive.set((0x6060, 0, mode, 1), (0x6065, 0, 0xFFFFFFFF, 4))
    bring(drive, plant, "operation enabled")


def bits(drive, *numbers):
    word = drive.read(0x6041)
    return tuple(word >> number & 1 for number in numbers)


def signed(drive, index):
    value = drive.read(index)
    return value - (1 << 32) if value >> 31 else value


def waits_for(drive, bit):
    for _ in range(100):
        if bits(drive, bit) == (1,):
            return True
        drive.silence(20)
    return False


def comes_to(drive, position):
    for _ in range(100):
        if signed(drive, 0x6064) == position:
            return True
        drive.silence(20)
    return False


def test_cia402_54_handshake_of_profile_position(drive, plant):
    power(drive, plant, 1)
    drive.set((0x6081, 0, 5000, 4), (0x6083, 0, 50_000, 4), (0x6084, 0, 50_000, 4))
    drive.set((0x607A, 0, 700, 4))
    assert bits(drive, 12) == (0,)
    drive.set((0x6040, 0, 0x1F, 2))  # new set-point
    assert bits(drive, 10, 12) == (0, 1)
    drive.set((0x6040, 0, 0x0F, 2))
    assert bits(drive, 12) == (0,)
    assert waits_for(drive, 10)  # within the window 6067h
    assert comes_to(drive, 700)
    drive.set((0x607A, 0, -200, 4), (0x6040, 0, 0x5F, 2), (0x6040, 0, 0x0F, 2))  # relative
    assert waits_for(drive, 10)
    assert comes_to(drive, 500)


def test_cia402_55_homing_bits(drive, plant):
    power(drive, plant, 6)
    assert drive.write(0x6098, 0, 19, 1) == 0x06090030  # needs a home switch, which this drive has not
    drive.set((0x6098, 0, 37, 1), (0x607C, 0, 90, 4))
    assert bits(drive, 12, 13) == (0, 0)
    drive.set((0x6040, 0, 0x1F, 2))
    assert waits_for(drive, 12)
    assert bits(drive, 10, 13) == (1, 0)
    assert signed(drive, 0x6064) == -90
    drive.set((0x6040, 0, 0x0F, 2), (0x6098, 0, 0, 1), (0x6040, 0, 0x1F, 2))  # no method
    assert waits_for(drive, 13)
    assert bits(drive, 12) == (0,)


@pytest.mark.parametrize(("method", "home"), [(17, -300), (18, 300)])
def test_cia402_55_homing_to_a_limit_switch(drive, plant, method, home):
    power(drive, plant, 6)
    plant.switches = (-300.0, 300.0)
    drive.set((0x6099, 1, 5000, 4), (0x6099, 2, 1000, 4), (0x609A, 0, 100_000, 4))
    drive.set((0x6098, 0, method, 1), (0x607C, 0, 0, 4), (0x6040, 0, 0x1F, 2))
    assert bits(drive, 10, 12, 13) == (0, 0, 0)
    assert waits_for(drive, 12)
    assert bits(drive, 10, 13) == (1, 0)
    assert signed(drive, 0x6064) == 0
    assert plant.counts[0] == pytest.approx(home)


def test_cia402_74_interpolated_position(connect, plant):
    drive = connect(make_drive_node(load_eds("prbt_joint", 1), 1, 0, plant)).boot()
    drive.set(*((0x1800 + n, 1, 0x80000181 + 0x100 * n, 4) for n in range(4)))
    drive.set((0x60C2, 1, CYCLE_MS, 1), (0x200E, 0, 100, 2), (0x6060, 0, 7, 1))
    assert drive.read(0x6061) == 7
    drive.nmt(0x01)
    for word in (SHUTDOWN, SWITCH_ON, ENABLE):
        drive.set((0x6040, 0, word, 2))
    assert reaches(drive, "operation enabled")
    drive.set((0x60C1, 1, 500, 4))
    drive.send(0x80)
    drive.silence(2 * CYCLE_MS)
    assert (bits(drive, 12), signed(drive, 0x6064)) == ((0,), 0)
    drive.set((0x60C1, 1, 0, 4), (0x6040, 0, ENABLE | 0x10, 2))
    assert bits(drive, 12) == (1,)
    for target in (1000, -200):
        start = signed(drive, 0x6064)
        drive.set((0x60C1, 1, target, 4))
        drive.send(0x80)
        drive.silence(CYCLE_MS / 2)
        half = signed(drive, 0x6064)
        if not drive.real_time:
            assert half == (start + target) / 2
        assert comes_to(drive, target)
    drive.set((0x6040, 0, ENABLE | 0x110, 2))  # halt
    assert waits_for(drive, 10)
    drive.set((0x6040, 0, ENABLE, 2))
    assert bits(drive, 12) == (0,)


def test_cia402_58_torque_limit(drive, plant):
    drive.set((0x6072, 0, 200, 2), (0x6007, 0, 0, 2))
    power(drive, plant, 10)
    master = Master(drive)
    for torque, applied, limited in ((500, 200, 1), (150, 150, 0)):
        drive.set((0x6071, 0, torque, 2))
        for _ in range(3):
            master.sync()
            drive.silence(10)
        assert (drive.read(0x6077), bits(drive, 11)) == (applied, (limited,))


def test_cia402_60_halt_and_on(drive, plant):
    power(drive, plant, 1)
    drive.set((0x6081, 0, 2000, 4), (0x6083, 0, 50_000, 4), (0x6084, 0, 50_000, 4), (0x605D, 0, 1, 2))
    drive.set((0x607A, 0, 4000, 4), (0x6040, 0, 0x1F, 2), (0x6040, 0, 0x0F, 2))
    drive.silence(200)
    drive.set((0x6040, 0, 0x10F, 2))
    assert waits_for(drive, 10)  # at rest
    there = signed(drive, 0x6064)
    assert 0 < there < 4000
    assert is_in(drive, "operation enabled")
    drive.silence(50)
    assert signed(drive, 0x6064) == there
    drive.set((0x6040, 0, 0x0F, 2))
    assert comes_to(drive, 4000)


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


def test_cia402_59_by_6007_0_the_drive_goes_on(drive):
    drive.set((0x6007, 0, 0, 2))
    master = Master(drive).enable()
    for _ in range(8):
        master.sync()
    assert is_in(drive, "operation enabled")
