"""Windows of every size on the wire: each taxel where it was, nothing else, and a length that their number settles."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from canprobe.errors import ProtocolError
from canprobe.protocol.tactile import (
    WINDOWS,
    FrameAssembler,
    TactileHeader,
    TactileMode,
    crc16_ccitt,
    pack_frame,
    pdo_count,
)

MODE = TactileMode.WINDOW
PDOS = {4: 3, 6: 6, 8: 9, 10: 14, 12: 19}  # header and side² / 8 payloads, rounded up: by hand


def header(side, row=0, col=0):
    return TactileHeader(7, 200, row, col, MODE, False, 5000, window=side)


def ids(side):
    return range(0x511, 0x511 + PDOS[side])


def assemble(side, payloads, expected=None):
    assembler = FrameAssembler(ids(side), MODE, 10**7, window=side if expected is None else expected)
    frames = [assembler.push(can_id, data, 0) for can_id, data in zip(ids(side), payloads, strict=True)]
    return assembler, frames[-1]


@given(st.sampled_from(WINDOWS), st.data())
def test_every_taxel_comes_back_to_its_place(side, data):
    row, col = (data.draw(st.integers(0, 16 - side), label=name) for name in ("row", "column"))
    pad = np.frombuffer(data.draw(st.binary(min_size=256, max_size=256)), np.uint8).reshape(16, 16)
    payloads = pack_frame(header(side, row, col), pad)
    assert len(payloads) == PDOS[side] == pdo_count(MODE, side)
    assert {len(payload) for payload in payloads} == {8}
    _, frame = assemble(side, payloads)
    assert frame.window == (row, col, side, side)
    assert np.array_equal(frame.taxels[row : row + side, col : col + side], pad[row : row + side, col : col + side])
    outside = frame.taxels.copy()
    outside[row : row + side, col : col + side] = 0
    assert not outside.any()


@pytest.mark.parametrize("side", WINDOWS)
def test_the_flags_tell_the_size_and_8_is_as_it_always_was(side):
    start = pack_frame(header(side), np.zeros((side, side), np.uint8))[0]
    assert start[3] == 1 + (0 if side == 8 else side << 4)
    assert TactileHeader.unpack(start).window == side


@pytest.mark.parametrize("flags", [0x51, 0x81, 0xF1, 0x40, 0x42, 0x09])
def test_sizes_that_no_sensor_has_and_sizes_in_other_modes_are_refused(flags):
    with pytest.raises(ProtocolError, match="reserved flags"):
        TactileHeader.unpack(bytes([1, 1, 0, flags, 0, 0, 0, 0]))


def test_a_window_that_leaves_the_pad_is_refused():
    assert pack_frame(header(4, 12, 12), np.zeros((16, 16), np.uint8))
    with pytest.raises(ProtocolError, match=r"cannot begin at taxel \(5, 0\)"):
        pack_frame(header(12, 5, 0), np.zeros((16, 16), np.uint8))
    with pytest.raises(ProtocolError, match="not 7"):
        pack_frame(header(7), np.zeros((16, 16), np.uint8))


def test_a_frame_of_another_window_is_malformed_even_with_the_right_length_and_crc():
    """Four payloads more or fewer cannot come; the same number with another size in the header can."""
    payloads = pack_frame(header(6), np.full((6, 6), 9, np.uint8))
    start = bytearray(payloads[0])
    start[3] = 1 | 4 << 4
    crc = crc16_ccitt(b"".join(payloads[1:]), crc16_ccitt(bytes(start[:6])))
    assembler, frame = assemble(6, [bytes(start[:6]) + crc.to_bytes(2, "little"), *payloads[1:]])
    assert frame is None and assembler.malformed == 1 and assembler.crc_errors == 0


def test_the_identifiers_must_be_those_of_the_window():
    with pytest.raises(ProtocolError, match="window frames need"):
        FrameAssembler(ids(8), MODE, 10**7, window=10)
