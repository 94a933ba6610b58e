"""Points 10–24: the SDO server, by raw frames. Source: CiA 301, "Service data object"."""

from __future__ import annotations

from binascii import crc_hqx

import pytest
from conformance_bench import ON_BOTH_BUSES

PAD = "00000000"
NAME = b"a name longer than seven"

# request, answer: one expedited request each
ONE_SHOT = {
    "10_write_const": ("2308100001000000", "8008100002000106"),
    "12_absent_object_write": ("2f99300001000000", "8099300000000206"),
    "15_too_long_segmented": ("2101200005000000", "8001200012000706"),
    "16_too_short_segmented": ("2101200003000000", "8001200013000706"),
    "17_signed_above": ("2b02200065000000", "8002200031000906"),
    "17_signed_below": ("2b0220009bff0000", "8002200032000906"),
}


def _make(name, request_text, answer):
    def test(tiny):
        assert tiny.ask(request_text) == answer
        assert tiny.read(0x1000) == 0x12345678

    test.__name__ = test.__qualname__ = name
    return test


for _name, _row in ONE_SHOT.items():
    globals()[f"test_cia301_sdo_{_name}"] = _make(f"test_cia301_sdo_{_name}", *_row)

# frames of one client, abort code in the answer to the last of them
BROKEN = {
    "18_toggle_repeated": (["2104200014000000", "0030313233343536", "0030313233343536"], 0x05030000),
    "20_up_in_a_download": (["2104200014000000", "6000000000000000"], 0x05040001),
    "20_down_in_an_upload": (["4008100000000000", "0000000000000000"], 0x05040001),
    "22_block_fewer_than_announced": (["c60420000e000000", "8130313233343536", "c100000000000000"], 0x06070013),
    "23_block_sequence_0": (["c604200014000000", "0030313233343536"], 0x05040003),
    "23_block_size_later": (["a40810007f000000", "a300000000000000", "a200000000000000"], 0x05040002),
    "23_block_acknowledged_too_much": (["a40810007f000000", "a300000000000000", "a2057f0000000000"], 0x05040003),
}


def _make_broken(name, requests, code):
    def test(tiny):
        for text in requests:
            tiny.send(0x605, text)
        heard = tiny.next()
        while not heard.text.startswith("80") or heard.text[8:] == PAD:
            heard = tiny.next()
        assert int.from_bytes(bytes.fromhex(heard.text)[4:], "little") == code
        assert tiny.read(0x1000) == 0x12345678  # the server is free again

    test.__name__ = test.__qualname__ = name
    return test


for _name, _broken in BROKEN.items():
    globals()[f"test_cia301_sdo_{_name}"] = _make_broken(f"test_cia301_sdo_{_name}", *_broken)


def test_cia301_sdo_17_a_refused_write_changes_nothing(tiny):
    for value, code in ((101, 0x06090031), (9, 0x06090032)):
        assert tiny.write(0x2000, 0, value, 1) == code
        assert tiny.read(0x2000) == 50
    tiny.set((0x2000, 0, 100, 1), (0x2000, 0, 10, 1))


def test_cia301_sdo_19_time_out(tiny):
    tiny.ask("2104200014000000")
    asked = tiny.send(0x605, "0030313233343536")
    tiny.expect((0x585, "2000000000000000"))
    tiny.assert_after(asked, tiny.expect((0x585, "8004200000000405"), within_ms=1000), 1000)
    assert tiny.read(0x1000) == 0x12345678


@pytest.mark.parametrize("opening", ["2104200014000000", "4008100000000000", "c604200014000000", "a40810007f000000"])
def test_cia301_sdo_21_client_abort_frees_the_server_without_an_answer(tiny, opening):
    tiny.ask(opening)
    tiny.send(0x605, "8004200000000008")
    assert tiny.read(0x1000) == 0x12345678
    assert tiny.ask("0030313233343536")[-8:] == "01000405"


def test_cia301_sdo_22_exactly_as_announced(tiny):
    tiny.ask("2104200007000000")
    assert tiny.ask("0130313233343536") == "2000000000000000"
    assert tiny.ask("4004200000000000") == "4104200007000000"
    assert tiny.ask("6000000000000000") == "0130313233343536"


def test_cia301_sdo_23_segmented_up_with_toggle(tiny):
    assert tiny.ask("40081000" + PAD) == "4108100018000000"
    answers = [bytes.fromhex(tiny.ask(f"{command}00000000000000")) for command in ("60", "70", "60", "70")]
    assert [answer[0] for answer in answers] == [0x00, 0x10, 0x00, 0x19]
    assert b"".join(answer[1:] for answer in answers)[:24] == NAME


@ON_BOTH_BUSES
def test_cia301_sdo_23_domain_in_blocks_both_ways_with_crc(tiny):
    sent = bytes(i * 7 % 256 for i in range(1000))  # 143 segments: two blocks
    crc = crc_hqx(sent, 0)
    assert tiny.ask("c6042000e8030000") == "a40420007f000000"
    pieces = [sent[i : i + 7] for i in range(0, 1000, 7)]
    for number, piece in enumerate(pieces[:127], start=1):
        tiny.send(0x605, (bytes((number,)) + piece).hex())
    tiny.expect((0x585, "a27f7f0000000000"))
    for number, piece in enumerate(pieces[127:], start=1):
        last = 0x80 if number == 16 else 0
        tiny.send(0x605, (bytes((number | last,)) + piece.ljust(7, b"\0")).hex())
    tiny.expect((0x585, "a2107f0000000000"))
    unused = 143 * 7 - 1000
    assert tiny.ask((bytes((0xC1 | unused << 2,)) + crc.to_bytes(2, "little")).ljust(8, b"\0").hex())[:2] == "a1"

    assert tiny.ask("a404200064000000") == "c6042000e8030000"  # blocks of 100
    tiny.send(0x605, "a300000000000000")
    got = b""
    for count in (100, 43):
        block = [bytes.fromhex(tiny.next().text) for _ in range(count)]
        assert [segment[0] & 0x7F for segment in block] == list(range(1, count + 1))
        assert [segment[0] >> 7 for segment in block] == [0] * (count - 1) + [count == 43]
        got += b"".join(segment[1:] for segment in block)
        tiny.send(0x605, bytes((0xA2, count, 100)).ljust(8, b"\0").hex())
    end = bytes.fromhex(tiny.next().text)
    assert (end[0], end[1] | end[2] << 8) == (0xC1 | unused << 2, crc)
    tiny.send(0x605, "a100000000000000")
    assert got[:1000] == sent
    assert tiny.read(0x1000) == 0x12345678


def test_cia301_sdo_23_a_lost_segment_is_asked_for_again(tiny):
    tiny.ask("c204200015000000")
    tiny.send(0x605, "0130313233343536")
    tiny.send(0x605, "8361626364656667")
    tiny.expect((0x585, "a2017f0000000000"))
    tiny.send(0x605, "0141424344454647")
    tiny.send(0x605, "8261626364656667")
    tiny.expect((0x585, "a2027f0000000000"))
    assert tiny.ask("c100000000000000") == "a100000000000000"
    assert tiny.ask("4004200000000000") == "4104200015000000"


def test_cia301_sdo_24_two_clients_at_once(tiny):
    """One on the default server, one on 1201h: neither disturbs the other's transfer."""
    tiny.set((0x1201, 1, 0x340, 4), (0x1201, 2, 0x3C0, 4))

    def ask(text):
        tiny.send(0x340, text)
        heard = tiny.next()
        assert heard.can_id == 0x3C0
        return heard.text

    assert tiny.ask("210420000a000000") == "6004200000000000"
    assert ask("4008100000000000") == "4108100018000000"
    assert tiny.ask("0030313233343536") == "2000000000000000"
    assert ask("6000000000000000") == "00" + NAME[:7].hex()
    assert ask("7000000000000000") == "10" + NAME[7:14].hex()
    assert tiny.ask("1937383900000000") == "3000000000000000"
    assert ask("4001200000000000") == "4301200004030201"
    assert ask("4004200000000000") == "410420000a000000"


@pytest.mark.parametrize("sub", [1, 2])
def test_cia301_sdo_24_identifiers_of_an_additional_server(tiny, sub):
    for cob_id in (0x601, 0x640, 0x581, 0x180, 0x77F, 0x20000340):
        assert tiny.write(0x1201, sub, cob_id, 4) == 0x06090030
    tiny.set((0x1201, sub, 0x340, 4))
    assert tiny.write(0x1201, sub, 0x341, 4) == 0x06090030  # in use
    tiny.send(0x340, "4000100000000000")  # one of the two identifiers is not enough
    tiny.read(0x1000)


def test_cia301_sdo_24_a_new_request_takes_the_place_of_an_open_transfer(tiny):
    tiny.ask("2104200014000000")
    assert tiny.read(0x1000) == 0x12345678
    assert tiny.ask("0030313233343536")[-8:] == "01000405"
