"""Cyclic synchronous position, CiA 402-2: delay contract, limits, following error, quick stop, dead master."""

from __future__ import annotations

import pytest

from canprobe.fieldbus.protocol.cia402 import DriveState as S

CYCLE = 2_500_000
FASTEST = 800_000
"""607Fh, counts/s: 2000 counts in a cycle."""


class Master:
    """SYNC, then an RPDO 0.3 ms later, every 2.5 ms."""

    def __init__(self, drive):
        self.drive = drive
        self.k = 0
        assert drive.write(0x607F, 0, FASTEST, 4) == 0
        drive.nmt(0x01, 0)

    def sync(self):
        self.k += 1
        t_ns = self.k * CYCLE
        frames = self.drive.advance(t_ns) if (self.drive.node.next_deadline_ns or t_ns + 1) <= t_ns else []
        return frames + self.drive.send(0x80, f"{(self.k - 1) % 240 + 1:02x}", t_ns)

    def rpdo(self, target, word=0x0F):
        data = word.to_bytes(2, "little") + target.to_bytes(4, "little", signed=True)
        return self.drive.send(0x201, data.hex(), self.k * CYCLE + 300_000)

    def cycle(self, target, word=0x0F):
        frames = self.sync()
        self.rpdo(target, word)
        return frames

    def enable(self, target=0):
        for word in (0x06, 0x07, 0x0F, 0x0F, 0x0F):
            self.cycle(target, word)
        assert self.drive.node.application.state is S.OPERATION_ENABLED
        return self


@pytest.fixture
def master(drive):
    return Master(drive)


def position(frames):
    (data,) = [bytes.fromhex(data) for can_id, data in frames if can_id == 0x181]
    return int.from_bytes(data[2:6], "little", signed=True)


def statusword(frames):
    (data,) = [bytes.fromhex(data) for can_id, data in frames if can_id == 0x181]
    return int.from_bytes(data[:2], "little")


def test_cia402_56_delay_contract_sent_in_k_latched_at_k1_reached_at_k2(master, plant):
    master.enable()
    k = master.k + 1
    seen = [position(master.cycle(target)) for target in (1000, 2000, 2000, 2000, 2000)]
    assert seen == [0, 0, 1000, 2000, 2000]  # at SYNC k, k+1, …
    plant.advance((k + 1) * CYCLE + CYCLE // 2)


@pytest.mark.parametrize(
    ("target", "reached", "limited"), [(900, 900, 0), (1100, 1000, 1), (-1100, -500, 1), (1000, 1000, 0)]
)
def test_cia402_57_software_limits(drive, target, reached, limited):
    for sub, limit in ((1, -500), (2, 1000)):
        assert drive.write(0x607D, sub, limit, 4) == 0
    master = Master(drive).enable()
    for _ in range(4):
        frames = master.cycle(target)
    assert (position(frames), statusword(frames) >> 11 & 1) == (reached, limited)
    for _ in range(3):
        frames = master.cycle(0)
    assert statusword(frames) >> 11 & 1 == 0


@pytest.mark.parametrize(
    ("value", "index", "interpolation"), [(25, -4, 2_500_000), (4, -3, 4_000_000), (1, -2, 10_000_000)]
)
def test_cia402_60c2_sets_the_interpolation_time(drive, plant, value, index, interpolation):
    assert drive.write(0x60C2, 1, value, 1) == 0
    assert drive.write(0x60C2, 2, index, 1) == 0
    master = Master(drive).enable()
    master.cycle(500)
    master.sync()
    assert plant.ramps[-1] == (0, 0, 500, master.k * CYCLE, master.k * CYCLE + interpolation)


def test_cia402_enabling_presets_the_target_to_the_present_position(drive, plant):
    plant.ramps.clear()
    plant.counts[0] = 123.4
    drive.node.start(0)
    for index, value, size in ((0x6060, 8, 1), (0x1019, 240, 1), (0x1006, 2500, 4)):
        drive.write(index, 0, value, size)
    for word in (0x06, 0x07, 0x0F):
        drive.write(0x6040, 0, word, 2)
    assert drive.read(0x607A) == 123
    assert plant.ramps[-1][1:3] == (123.4, 123.4)


def test_cia402_targets_are_not_followed_outside_operation_enabled(master, plant):
    for word in (0x06, 0x07, 0x07, 0x07):
        master.cycle(5000, word)
    assert plant.counts[0] == 0.0
    master.cycle(5000, 0x0F)
    master.sync()  # enabled here: the target in the same PDO is not latched yet
    assert plant.ramps[-1][1:3] == (0.0, 0.0)


def test_cia402_a_cycle_without_a_target_holds_the_last(master, plant):
    master.enable()
    master.cycle(1000)
    for _ in range(3):
        frames = master.sync()
    assert position(frames) == 1000


@pytest.mark.parametrize(("step", "goes_on"), [(2000, True), (2400, False)])
def test_cia402_607f_bounds_the_way_from_target_to_target_however_the_syncs_jitter(drive, step, goes_on):
    master = Master(drive).enable()
    t_ns = (master.k + 1) * CYCLE
    for k in range(1, 12):
        master.k += 1
        drive.advance(t_ns)
        drive.send(0x80, f"{(master.k - 1) % 240 + 1:02x}", t_ns)
        drive.send(0x201, (b"\x0f\0" + (k * step).to_bytes(4, "little")).hex(), t_ns + 300_000)
        t_ns += CYCLE + (600_000 if k % 2 else -600_000)
    assert (drive.node.application.state is S.OPERATION_ENABLED) == goes_on


def test_cia402_56_following_error_after_its_time(drive, plant):
    drive.write(0x6065, 0, 100, 4)
    drive.write(0x6066, 0, 10, 2)  # 10 ms: four cycles
    master = Master(drive).enable()
    plant.stuck = True
    history = []
    for _ in range(9):
        frames = master.cycle(101)
        history.append((drive.node.application.state, [data for can_id, data in frames if can_id == 0x81]))
    # sent at 0, latched at 1, demand reached and seen at 2, fault at 2 + 4
    assert [state is S.OPERATION_ENABLED for state, _ in history] == [True] * 6 + [False] * 3
    assert history[6][1] == ["1186210000000000"]
    assert history[7][0] is S.FAULT
    assert statusword(frames) & 0x204F == 0x2008


def test_cia402_56_following_error_inside_the_window_or_short_is_none(drive, plant):
    drive.write(0x6065, 0, 100, 4)
    drive.write(0x6066, 0, 10, 2)
    master = Master(drive).enable()
    plant.stuck = True
    for target in [100] * 12 + [150] * 3 + [0] * 8 + [-100] * 12:
        master.cycle(target)
    assert drive.node.application.state is S.OPERATION_ENABLED


def test_cia402_606c_velocity_and_6077_torque(drive, plant):
    master = Master(drive).enable()
    for k in range(5):
        master.cycle(-10 * k)
    assert drive.read(0x606C) == 0xFFFFFFFF + 1 - 4000
    plant.torque = -250
    assert bytes.fromhex(master.sync()[-1][1])[6:] == (-250).to_bytes(2, "little", signed=True)


@pytest.mark.parametrize(("at", "told"), [(0.4, 0), (0.6, 1), (12.7, 13), (-0.4, 0), (-0.6, -1), (-12.7, -13)])
def test_the_encoder_tells_the_nearest_whole_count_of_a_motor_that_is_between_them(drive, plant, at, told):
    master = Master(drive)
    plant.stuck, plant.counts[0] = True, at
    assert position(master.sync()) == told
    assert plant.motor_counts(0) == at


def test_cia402_51_quick_stop_between_syncs_decelerates_from_the_running_ramp(drive, plant):
    rate = 400_000
    drive.write(0x605A, 0, 6, 2)
    drive.write(0x6085, 0, rate, 4)
    master = Master(drive).enable()
    for k in range(8):
        master.cycle(25 * k)
    t_ns = master.k * CYCLE + CYCLE // 2
    drive.send(0x601, "2b40600002000000", t_ns)
    plant.advance(t_ns)
    start = plant.counts[0]
    for step in range(1, 15):
        drive.advance(t_ns + step * CYCLE)
    assert drive.node.application.state is S.QUICK_STOP_ACTIVE
    assert plant.counts[0] - start == pytest.approx(10_000**2 / (2 * rate))
    assert drive.read(0x6041) >> 10 & 1 == 1


def test_cia402_59_four_missing_rpdos_do_not(master, drive):
    master.enable()
    for _ in range(6):
        master.sync()
        for _ in range(4):
            master.sync()
        master.rpdo(0)
    assert drive.node.application.state is S.OPERATION_ENABLED


@pytest.mark.parametrize("option", [5, 6])
def test_cia402_59_a_repeated_controlword_does_not_restart_a_drive_that_stopped_itself(drive, option):
    drive.write(0x605A, 0, option, 2)
    master = Master(drive).enable()
    for _ in range(6):
        master.sync()
    assert drive.node.application.state is S.QUICK_STOP_ACTIVE
    for _ in range(5):
        master.cycle(0, 0x0F)
    assert drive.node.application.state is S.QUICK_STOP_ACTIVE


@pytest.mark.parametrize(
    ("step", "followed"), [(2000, True), (-2000, True), (2010, False), (-2010, False), (1 << 20, False)]
)
def test_cia402_a_target_that_the_motor_cannot_reach_in_time_is_a_fault(drive, plant, step, followed):
    master = Master(drive).enable()
    frames = [frame for _ in range(3) for frame in master.cycle(step)]
    assert (drive.node.application.state is S.OPERATION_ENABLED) is followed
    assert [data for can_id, data in frames if can_id == 0x81] == ([] if followed else ["1286210000000000"])
    assert plant.ramps[-1][2] == (step if followed else 0)


def test_cia402_a_target_after_missed_ones_may_be_further_away(drive, plant):
    master = Master(drive).enable()
    master.cycle(1000)
    master.sync()  # latched: 1000 by the next SYNC
    master.sync()
    master.cycle(1000 + 5900)  # 2000 for each of the cycles since
    master.sync()
    assert drive.node.application.state is S.OPERATION_ENABLED and plant.ramps[-1][2] == 6900
