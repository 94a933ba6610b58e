"""SDO server, CiA 301 "Service data object": requests and answers as bytes, every abort code of the table."""

import pytest

from canprobe.fieldbus.node.sdo_server import SdoServer
from canprobe.fieldbus.node.sdo_states import SdoState

PAD = "00000000"

# point, request, answer. One expedited request each, on a fresh node.
EXPEDITED = [
    ("upload u32", "40001000" + PAD, "4300100078563412"),
    ("upload u8", "40002000" + PAD, "4f00200032000000"),
    ("upload i16", "40022000" + PAD, "4b022000feff0000"),
    ("upload real32", "40062000" + PAD, "430620000000c03f"),
    ("download u8 with size", "2f00200042000000", "60002000" + PAD),
    ("download without size", "2200200042000000", "60002000" + PAD),
    ("download i16", "2b0220009cff0000", "60022000" + PAD),
    ("10 write ro", "2300100001000000", "8000100002000106"),
    ("10 write const", "2308100001000000", "8008100002000106"),
    ("11 read wo", "40032000" + PAD, "8003200001000106"),
    ("12 absent object, read", "40993000" + PAD, "8099300000000206"),
    ("12 absent object, write", "2f99300001000000", "8099300000000206"),
    ("13 absent sub, read", "40102003" + PAD, "8010200311000906"),
    ("13 absent sub of a variable", "40002001" + PAD, "8000200111000906"),
    ("14 unknown command", "e0002000" + PAD, "8000200001000405"),
    ("15 too long", "2b00200042000000", "8000200012000706"),
    ("16 too short", "2b01200001000000", "8001200013000706"),
    ("17 above limit", "2f00200065000000", "8000200031000906"),
    ("17 below limit", "2f00200009000000", "8000200032000906"),
    ("17 signed above limit", "2b02200065000000", "8002200031000906"),
    ("17 signed below limit", "2b0220009bff0000", "8002200032000906"),
    ("20 segment upload without a transfer", "6000000000000000", "8000000001000405"),
    ("20 segment download without a transfer", "0000000000000000", "8000000001000405"),
    ("23 block size 0", "a408100000000000", "8008100002000405"),
    ("23 block size 128", "a408100080000000", "8008100002000405"),
]


@pytest.mark.parametrize(("what", "request_text", "answer"), EXPEDITED, ids=[row[0] for row in EXPEDITED])
def test_cia301_sdo_expedited(bench, what, request_text, answer):
    assert bench.send(0x605, request_text) == [(0x585, answer)]


@pytest.mark.parametrize("length", [0, 1, 7])
def test_cia301_sdo_request_of_another_length_is_ignored(bench, length):
    assert bench.send(0x605, "40" + "00" * (length - 1) if length else "") == []


def test_cia301_sdo_limits_themselves_pass(bench):
    assert [bench.write(0x2000, 0, value, 1) for value in (10, 100)] == [0, 0]


def test_cia301_sdo_segmented_upload_of_nothing(bench):
    assert bench.ask("40042000" + PAD) == "4104200000000000"
    assert bench.ask("6000000000000000") == "0f00000000000000"


# point, frames of one client, abort code in the answer to the last of them
BROKEN = [
    ("18 toggle, download", ["2104200014000000", "1030313233343536"], 0x05030000),
    ("18 toggle repeated, download", ["2104200014000000", "0030313233343536", "0030313233343536"], 0x05030000),
    ("18 toggle, upload", ["4008100000000000", "7000000000000000"], 0x05030000),
    ("15 announced too long", ["2101200005000000"], 0x06070012),
    ("16 announced too short", ["2101200003000000"], 0x06070013),
    ("22 fewer bytes than announced", ["2104200008000000", "0130313233343536"], 0x06070013),
    ("22 more bytes than announced", ["2104200006000000", "0130313233343536"], 0x06070012),
    ("15 segments too long, not announced", ["2001200000000000", "0530313233340000"], 0x06070012),
    ("16 segments too short, not announced", ["2001200000000000", "0930313200000000"], 0x06070013),
    ("10 segmented write ro", ["2100100004000000"], 0x06010002),
    ("17 limits, segmented", ["2100200001000000", "0dff000000000000"], 0x06090031),
    ("20 upload segment in a download", ["2104200014000000", "6000000000000000"], 0x05040001),
    ("20 download segment in an upload", ["4008100000000000", "0000000000000000"], 0x05040001),
    ("23 block download, sequence 0", ["c604200014000000", "0030313233343536"], 0x05040003),
    ("23 block download, crc", ["c604200007000000", "8130313233343536", "c1ffff0000000000"], 0x05040004),
    ("22 block download, size", ["c60420000e000000", "8130313233343536", "c100000000000000"], 0x06070013),
    (
        "23 block upload, acknowledged too much",
        ["a40810007f000000", "a300000000000000", "a2057f0000000000"],
        0x05040003,
    ),
    ("23 block upload, block size", ["a40810007f000000", "a300000000000000", "a200000000000000"], 0x05040002),
    ("23 block upload, wrong command", ["a40810007f000000", "a200000000000000"], 0x05040001),
]


@pytest.mark.parametrize(("what", "requests", "code"), BROKEN, ids=[row[0] for row in BROKEN])
def test_cia301_sdo_broken_transfers(bench, what, requests, code):
    answers = [answer for text in requests for answer in bench.send(0x605, text)]
    last = bytes.fromhex(answers[-1][1])
    assert (last[0], int.from_bytes(last[4:], "little")) == (0x80, code)
    assert bench.read(0x1000) == 0x12345678  # the server is free again


def test_cia301_sdo_19_time_out_and_again_free(bench):
    bench.ask("2104200014000000")
    bench.send(0x605, "0030313233343536", 400_000_000)
    assert bench.node.next_deadline_ns == 1_400_000_000
    assert bench.advance(1_400_000_000) == [(0x585, "8004200000000405")]
    assert bench.node.next_deadline_ns is None
    assert bench.read(0x1000) == 0x12345678


def test_cia301_sdo_23_lost_segment_of_a_block_is_asked_for_again(bench):
    bench.ask("c204200015000000")
    assert bench.send(0x605, "0130313233343536") == []
    assert bench.send(0x605, "8361626364656667") == [(0x585, "a2017f0000000000")]
    assert bench.send(0x605, "0141424344454647") == []
    assert bench.send(0x605, "8261626364656667") == [(0x585, "a2027f0000000000")]
    assert bench.send(0x605, "c100000000000000") == [(0x585, "a100000000000000")]
    assert bench.node.dictionary.values[0x200400] == b"0123456ABCDEFGabcdefg"


def test_cia301_sdo_23_block_upload_repeats_from_the_acknowledged_segment(bench):
    assert bench.ask("a008100004000000") == "c608100018000000"
    first = bench.send(0x605, "a300000000000000")
    assert [bytes.fromhex(data)[0] for _, data in first] == [1, 2, 3, 0x84]
    again = bench.send(0x605, "a202040000000000")
    assert [data for _, data in again] == ["01" + b"than se".hex(), "82" + b"ven".hex() + PAD]
    assert bench.send(0x605, "a202040000000000") == [(0x585, "d100000000000000")]
    assert bench.send(0x605, "a100000000000000") == []


def test_cia301_sdo_23_block_upload_switches_below_the_threshold(bench):
    assert bench.ask("a008100004180000") == "4108100018000000"
    assert bench.ask("a000100004080000") == "4300100078563412"


# The SDO server's state machine: every command byte in every state, against a table written out from the standard.

S = SdoState
OBJECT = "042000"  # 2004h, a domain that holds 16 bytes
PATHS = {
    S.IDLE: [],
    S.DOWNLOAD: ["21" + OBJECT + "14000000"],
    S.UPLOAD: ["40" + OBJECT + "00000000"],
    S.BLOCK_DOWNLOAD: ["c2" + OBJECT + "15000000"],
    S.BLOCK_DOWNLOAD_END: ["c2" + OBJECT + "07000000", "8130313233343536"],
    S.BLOCK_UPLOAD_START: ["a0" + OBJECT + "02000000"],
    S.BLOCK_UPLOAD: ["a0" + OBJECT + "02000000", "a300000000000000"],
    S.BLOCK_UPLOAD_END: ["a0" + OBJECT + "7f000000", "a300000000000000", "a2037f0000000000"],
}
CONTENT = b"sixteen bytes!!!"
COMMAND, TOGGLE, SEQUENCE, TOO_SHORT = 0x05040001, 0x05030000, 0x05040003, 0x06070013
REST = OBJECT + "7f000000"  # of an initiate: 127 segments a block, or 127 bytes announced


def initiates(command: int) -> SdoState | None:
    """Where an initiate request leads; the client command specifier is in the three highest bits."""
    expedited = command & 2
    goals = {1: S.IDLE if expedited else S.DOWNLOAD, 2: S.UPLOAD}
    if command & 3 == 0:
        goals[5] = S.BLOCK_UPLOAD_START
    if command & 1 == 0:
        goals[6] = S.BLOCK_DOWNLOAD
    return goals.get(command >> 5)


def numbered(command: int) -> tuple[SdoState, int]:
    """A segment of a block download: only number 1 is the next, with bit 7 it is the last."""
    if command & 0x7F == 0:
        return S.IDLE, SEQUENCE
    return (S.BLOCK_DOWNLOAD_END if command == 0x81 else S.BLOCK_DOWNLOAD), 0


def right_step(state: SdoState, command: int) -> tuple[SdoState, int] | None:
    """What the one kind of frame does that goes on with the transfer; None for every other frame."""
    toggled, last = bool(command & 0x10), bool(command & 1)
    ends = (S.IDLE, TOO_SHORT) if last else (S.DOWNLOAD, 0)
    # state: (mask and pattern of the command byte, what follows)
    steps = {
        S.DOWNLOAD: (0xE0, 0x00, (S.IDLE, TOGGLE) if toggled else ends),
        S.UPLOAD: (0xE0, 0x60, (S.IDLE, TOGGLE) if toggled else (S.UPLOAD, 0)),
        S.BLOCK_UPLOAD_START: (0xE3, 0xA3, (S.BLOCK_UPLOAD, 0)),
        S.BLOCK_UPLOAD: (0xE3, 0xA2, (S.IDLE, SEQUENCE)),  # acknowledges segment 4 (of OBJECT), and two were sent
        S.BLOCK_UPLOAD_END: (0xE3, 0xA1, (S.IDLE, 0)),
        S.BLOCK_DOWNLOAD_END: (0xE1, 0xC1, (S.IDLE, TOO_SHORT if command & 0x1C else 0)),
    }
    mask, pattern, follows = steps.get(state, (0, 1, None))
    return follows if command & mask == pattern else None


def expected(state: SdoState, command: int) -> tuple[SdoState, int]:
    """State after the command (its other bytes being REST) and abort code: the standard in other words than the code's.

    Source: CiA 301, SDO protocols.
    """
    if command == 0x80:
        return S.IDLE, 0
    if state is S.BLOCK_DOWNLOAD:
        return numbered(command)
    if (goal := initiates(command)) is not None:
        return goal, 0
    return right_step(state, command) or (S.IDLE, COMMAND)


def bring(bench, state):
    bench.node.dictionary.values[0x200400] = CONTENT
    for text in PATHS[state]:
        bench.send(0x605, text)
    server = next(service for service in bench.node._services if isinstance(service, SdoServer))
    assert server.state is state
    return server


@pytest.mark.parametrize("state", S)
def test_cia301_sdo_every_command_byte_in_every_state(bench, state):
    for command in range(256):
        server = bring(bench, state)
        answers = bench.send(0x605, f"{command:02x}" + REST)
        after, code = expected(state, command)
        assert server.state is after, f"{command:02x}"
        aborts = [answer for _, answer in answers if answer.startswith("80")]
        assert [int.from_bytes(bytes.fromhex(text)[4:], "little") for text in aborts] == [code] * bool(code)
        bench.send(0x605, "80" + OBJECT + "00000000")


@pytest.mark.parametrize("state", [state for state in S if state is not S.IDLE])
def test_cia301_sdo_time_out_and_stopped_lead_to_idle_from_every_state(bench, state):
    server = bring(bench, state)
    assert bench.advance(bench.node.next_deadline_ns) == [(0x585, "80" + OBJECT + "00000405")]
    assert server.state is S.IDLE
    bring(bench, state)
    bench.nmt(0x02)
    assert server.state is S.IDLE
    bench.nmt(0x80)
    assert server.state is S.IDLE
