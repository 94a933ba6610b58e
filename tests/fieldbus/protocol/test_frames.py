"""NMT, heartbeat, SYNC, EMCY: tables of bytes and meaning, run both ways, cut short and too long."""

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canprobe.errors import ProtocolError
from canprobe.fieldbus.protocol import emcy, frames
from canprobe.fieldbus.protocol.frames import NmtCommand, NmtState

NMT = [
    (NmtCommand.START, 5, "0105"),
    (NmtCommand.STOP, 127, "027f"),
    (NmtCommand.PRE_OPERATIONAL, 0, "8000"),
    (NmtCommand.RESET_NODE, 16, "8110"),
    (NmtCommand.RESET_COMMUNICATION, 1, "8201"),
]


@pytest.mark.parametrize("command, node_id, wire", NMT)
def test_nmt_cia_301(command, node_id, wire):
    data = bytes.fromhex(wire)
    assert frames.pack_nmt(command, node_id) == (0x000, data)


@pytest.mark.parametrize(
    "node_id, state, can_id, wire",
    [(1, 0, 0x701, "00"), (6, 4, 0x706, "04"), (16, 5, 0x710, "05"), (127, 0x7F, 0x77F, "7f")],
)
def test_heartbeat_both_ways_cia_301(node_id, state, can_id, wire):
    data = bytes.fromhex(wire)
    assert frames.pack_heartbeat(node_id, NmtState(state)) == (can_id, data)
    assert frames.unpack_heartbeat(data) is NmtState(state)
    assert frames.unpack_heartbeat(bytes([data[0] | 0x80])) is NmtState(state)  # node guarding's toggle bit


@given(st.binary(max_size=8))
def test_any_bytes_raise_only_protocol_errors(data):
    for unpack in (frames.unpack_heartbeat, emcy.Emcy.unpack):
        with contextlib.suppress(ProtocolError):
            unpack(data)


@pytest.mark.parametrize("node_id", [-1, 128])
def test_node_ids_out_of_range_are_refused(node_id):
    with pytest.raises(ProtocolError):
        frames.pack_nmt(NmtCommand.START, node_id)
    with pytest.raises(ProtocolError):
        frames.pack_heartbeat(node_id, NmtState.STOPPED)


def test_heartbeat_of_node_0_is_refused():
    with pytest.raises(ProtocolError):
        frames.pack_heartbeat(0, NmtState.STOPPED)


@pytest.mark.parametrize("first, last, restricted", [
    (0x000, 0x07F, True), (0x080, 0x100, False), (0x101, 0x180, True), (0x181, 0x580, False), (0x581, 0x5FF, True),
    (0x600, 0x600, False), (0x601, 0x67F, True), (0x680, 0x6DF, False), (0x6E0, 0x6FF, True), (0x700, 0x700, False),
    (0x701, 0x7FF, True),
])  # fmt: skip
def test_restricted_identifiers_cia_301(first, last, restricted):
    assert {frames.is_restricted(cob_id) for cob_id in range(first, last + 1)} == {restricted}


# --- SYNC ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("overflow", [2, 3, 240])
def test_sync_counts_from_1_to_the_overflow_cia_301_1019h(overflow):
    counter = frames.SyncCounter(overflow)
    rounds = [counter.next() for _ in range(2 * overflow)]
    assert rounds == 2 * list(range(1, overflow + 1))
    counter.next()
    counter.reset()
    assert counter.next() == 1


def test_sync_without_counter():
    counter = frames.SyncCounter(0)
    assert [counter.next() for _ in range(3)] == [None] * 3


@pytest.mark.parametrize("overflow", [-1, 1, 241, 255, 256])
def test_reserved_overflows_are_refused_cia_301_1019h(overflow):
    with pytest.raises(ProtocolError, match=str(overflow)):
        frames.SyncCounter(overflow)


@pytest.mark.parametrize("counter, wire", [(None, ""), (1, "01"), (240, "f0")])
def test_sync_frames(counter, wire):
    assert frames.pack_sync(counter) == (0x080, bytes.fromhex(wire))


@pytest.mark.parametrize("counter", [0, 241, -1])
def test_impossible_sync_counters_are_refused(counter):
    with pytest.raises(ProtocolError):
        frames.pack_sync(counter)


# --- EMCY ---------------------------------------------------------------------------------------------------------

EMCY = [
    (0x8130, 0x11, b"\x01\x02\x03\x04\x05", "3081110102030405"),
    (0x0000, 0x00, bytes(5), "0000000000000000"),
    (0x8611, 0x21, b"\xff\x00\x00\x00\x01", "118621ff00000001"),
]


@pytest.mark.parametrize("code, register, data, wire", EMCY)
def test_emcy_both_ways_cia_301(code, register, data, wire):
    message, raw = emcy.Emcy(code, register, data), bytes.fromhex(wire)
    assert message.pack() == raw
    assert emcy.Emcy.unpack(raw) == message
    for broken in (raw[:-1], raw + b"\x00", b""):
        with pytest.raises(ProtocolError, match=f"got {len(broken)}"):
            emcy.Emcy.unpack(broken)


@pytest.mark.parametrize(
    "message", [emcy.Emcy(0x10000, 0), emcy.Emcy(-1, 0), emcy.Emcy(0, 256), emcy.Emcy(0, 0, bytes(6))]
)
def test_emcy_that_does_not_fit_is_refused(message):
    with pytest.raises(ProtocolError):
        message.pack()


def test_short_emcy_data_are_filled():
    assert emcy.Emcy(0x1000, 1, b"\x07").pack() == bytes.fromhex("0010010700000000")


@pytest.mark.parametrize(
    "code, words",
    [
        (0x0000, "no error"),
        (0x0012, "no error"),
        (0x0100, "unknown"),
        (0x0856, "unknown"),
        (0x1234, "generic error"),
        (0x2311, "over-current"),
        (0x3199, "mains voltage"),
        (0x8130, "heartbeat"),
        (0x81F0, "communication"),
        (0x8210, "not processed due to length"),
        (0x8220, "length exceeded"),
        (0x8240, "SYNC data length"),
        (0x8250, "RPDO time-out"),
        (0x8611, "following error"),
        (0x8612, "reference"),
        (0xA000, "unknown"),
        (0xF042, "additional functions"),
        (0xFF42, "device specific"),
    ],
)
def test_emcy_in_words_takes_the_most_specific_entry(code, words):
    assert words in emcy.describe(code)


def test_every_emcy_code_has_words():
    assert all(emcy.describe(code) for code in range(0x10000))
