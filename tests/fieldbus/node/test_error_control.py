"""Error control, CiA 301: heartbeat producer and consumer; points 8 and 44."""

import pytest

from canprobe.fieldbus.protocol.frames import NmtState

MS = 1_000_000
MASTER_250 = 127 << 16 | 250
SAVE = 0x65766173


def test_cia301_heartbeat_08_write_acts_at_once_and_repeats(bench):
    bench.t_ns = 3 * MS
    assert bench.send(0x605, "2b17100064000000") == [(0x705, "7f"), (0x585, "6017100000000000")]
    assert bench.node.next_deadline_ns == 103 * MS
    assert bench.advance(103 * MS) == [(0x705, "7f")]
    assert bench.advance(203 * MS) == [(0x705, "7f")]
    bench.write(0x1017, 0, 0, 2)
    assert bench.node.next_deadline_ns is None


def test_cia301_heartbeat_boot_up_is_the_first_with_a_stored_time(bench):
    bench.write(0x1017, 0, 50, 2)
    bench.write(0x1010, 1, SAVE, 4)
    bench.t_ns = 7 * MS
    assert bench.nmt(0x81) == [(0x705, "00")]
    assert bench.node.next_deadline_ns == 57 * MS


def test_cia301_heartbeat_44_watched_from_the_first_on_and_loss_reported(bench):
    assert bench.write(0x1016, 1, MASTER_250, 4) == 0
    assert bench.node.next_deadline_ns is None
    bench.nmt(0x01)
    bench.send(0x77F, "05", 1000 * MS)
    bench.send(0x77F, "05", 1100 * MS)
    assert bench.node.next_deadline_ns == 1350 * MS
    assert bench.advance(1350 * MS) == [(0x85, "3081117f00000000")]
    assert bench.node.state is NmtState.PRE_OPERATIONAL  # 1029h:01 = 0
    assert bench.send(0x77F, "05", 1400 * MS) == [(0x85, "0000000000000000")]


def test_cia301_heartbeat_44_the_error_ends_when_the_last_of_two_lost_is_back(bench):
    bench.write(0x1029, 1, 1, 1)
    for sub, node_id in ((1, 127), (2, 126)):
        bench.write(0x1016, sub, node_id << 16 | 250, 4)
    bench.write(0x100C, 0, 100, 2)
    bench.write(0x100D, 0, 2, 1)
    for can_id in (0x77F, 0x77E, 0x40000705):
        bench.send(can_id, "05" if can_id < 0x800 else "", 0)
    assert bench.advance(200 * MS) == [(0x85, "3081110000000000")]  # life guarding
    assert bench.advance(250 * MS) == []  # both producers: the error is there already
    assert bench.send(0x77F, "05", 260 * MS) == bench.send(0x77E, "05", 260 * MS) == []
    assert bench.send(0x40000705, "", 270 * MS) == [(0x705, "ff"), (0x85, "0000000000000000")]


def test_cia301_guarding_09_a_heartbeat_that_is_switched_on_ends_life_guarding(bench):
    bench.write(0x100C, 0, 100, 2)
    bench.write(0x100D, 0, 2, 1)
    bench.send(0x40000705, "", 0)
    bench.send(0x605, "2b171000e8030000")  # 1000 ms
    assert bench.send(0x40000705, "") == []
    assert bench.advance(900 * MS) == []


# SYNC and EMCY, CiA 301: objects 1001h, 1003h, 1005h, 1006h, 1014h, 1015h, 1019h; points 39–43 and 47.


def test_cia301_sync_39_counter_overflow_values(bench):
    answers = [bench.write(0x1019, 0, value, 1) for value in range(256)]
    assert answers == [0x06090030 if value == 1 or value > 240 else 0 for value in range(256)]


def test_cia301_sync_41_no_sync_for_one_and_a_half_periods(bench):
    bench.write(0x1006, 0, 2000, 4)
    bench.nmt(0x01, 0)
    assert bench.node.next_deadline_ns is None  # from the first SYNC on
    bench.send(0x80, "", 10 * MS)
    bench.send(0x80, "", 12 * MS)
    assert bench.advance(15 * MS - 1) == []
    assert bench.advance(15 * MS) == [(0x85, "0081110000000000")]
    assert bench.send(0x80, "", 20 * MS)[0] == (0x85, "0000000000000000")


def test_cia301_emcy_47_error_register_follows(bench):
    emcy = bench.node.emcy
    for act, code, told in (
        (emcy.report, 0x2310, "1023030000000000"),
        (emcy.report, 0x8130, "3081130000000000"),
        (emcy.clear, 0x8130, "0000030000000000"),  # one is left
        (emcy.clear, 0x2310, "0000000000000000"),
    ):
        act(code)
        assert bench.advance(0) == [(0x85, told)]
        assert bench.read(0x1001) == int(told[4:6], 16)


@pytest.mark.parametrize(
    ("code", "register"),
    [
        (0x2310, 3),
        (0x3210, 5),
        (0x4310, 9),
        (0x8130, 0x11),
        (0x8210, 0x11),
        (0x8611, 0x21),
        (0x7121, 0x81),
        (0xFF01, 0x81),
        (0x5000, 1),
    ],
)
def test_cia301_emcy_register_bits(bench, code, register):
    bench.node.emcy.report(code, b"\x01\x02")
    assert bench.advance(0) == [(0x85, code.to_bytes(2, "little").hex() + f"{register:02x}" + "0102000000")]


def test_cia301_emcy_42_history(bench):
    assert (bench.read(0x1003), bench.refusal(0x1003, 1)) == (0, 0x08000024)
    for code in (0x1000, 0x2310, 0x3210, 0x4310):
        bench.node.emcy.report(code, b"\x07\x09")
    assert bench.read(0x1003) == 3  # three entries in this EDS
    assert [bench.read(0x1003, sub) for sub in (1, 2, 3)] == [0x09074310, 0x09073210, 0x09072310]  # low byte first
    assert bench.write(0x1003, 0, 1, 1) == 0x06090030
    assert bench.write(0x1003, 0, 0, 1) == 0
    assert (bench.read(0x1003), bench.refusal(0x1003, 1)) == (0, 0x08000024)


def test_cia301_emcy_43_inhibit_time(bench):
    bench.write(0x1015, 0, 100, 2)  # 10 ms
    bench.node.emcy.report(0x1000)
    bench.node.emcy.report(0x2310)
    assert bench.advance(0) == [(0x85, "0010010000000000")]
    assert bench.node.next_deadline_ns == 10 * MS
    assert bench.advance(10 * MS) == [(0x85, "1023030000000000")]


def test_cia301_emcy_is_not_sent_when_stopped_but_remembered(bench):
    bench.nmt(0x02)
    bench.node.emcy.report(0x1000)
    assert bench.advance(0) == []
    bench.nmt(0x80)
    assert bench.read(0x1003, 1) == 0x1000
