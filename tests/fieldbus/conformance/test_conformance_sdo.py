"""Points 23 and 24: the SDO server, by raw frames. Source: CiA 301, "Service data object".

Every request and abort code: tests/fieldbus/node/test_sdo_server.py.
"""

from __future__ import annotations

from binascii import crc_hqx

import pytest
from conformance_bench import ON_BOTH_BUSES


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


@pytest.mark.parametrize("sub", [1, 2])
def test_cia301_sdo_24_identifiers_of_an_additional_server(tiny, sub):
    for cob_id in (0x601, 0x640, 0x581, 0x180, 0x77F, 0x20000340):
        assert tiny.write(0x1201, sub, cob_id, 4) == 0x06090030
    tiny.set((0x1201, sub, 0x340, 4))
    assert tiny.write(0x1201, sub, 0x341, 4) == 0x06090030  # in use
    tiny.send(0x340, "4000100000000000")  # one of the two identifiers is not enough
    tiny.read(0x1000)
