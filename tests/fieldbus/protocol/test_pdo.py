"""PDO layouts against hand-packed bytes, and against an independent bit-string packer."""

import copy
import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canprobe.errors import ProtocolError
from canprobe.fieldbus.protocol.pdo import PdoEntry, PdoLayout

STATUS = PdoEntry(0x6041, 0, 16, False, "statusword")
POSITION = PdoEntry(0x6064, 0, 32, True, "position")
TORQUE = PdoEntry(0x6077, 0, 16, True, "torque")
DUMMY32 = PdoEntry(0x0004, 0, 32, True, "dummy")
NIBBLE = PdoEntry(0x2000, 3, 4, True)
TPDO1 = PdoLayout(0x181, (STATUS, POSITION, TORQUE))

WIRE = [
    (TPDO1, (0x1237, -5, -1), "3712fbffffffffff"),
    (TPDO1, (0x0637, 0x01020304, 0x7FFF), "370604030201ff7f"),
    (PdoLayout(0x201, (PdoEntry(0x6040, 0, 16), PdoEntry(0x607A, 0, 32, True))), (0x000F, -(2**31)), "0f0000000080"),
    (PdoLayout(0x301, (PdoEntry(0x607A, 0, 32, True), DUMMY32)), (7,), "0700000000000000"),
    (PdoLayout(0x301, (DUMMY32, PdoEntry(0x607A, 0, 32, True))), (-2,), "00000000feffffff"),
    (PdoLayout(0x511, (PdoEntry(0x2120, 0, 64),)), (0xFF00000000000001,), "01000000000000ff"),
    (PdoLayout(0x181, (PdoEntry(0x2000, 1, 1), PdoEntry(0x2000, 2, 3), NIBBLE)), (1, 5, -1), "fb"),
    (PdoLayout(0x181, (PdoEntry(0x2000, 1, 24, True),)), (-2,), "feffff"),
    (PdoLayout(0x181, (PdoEntry(0x2000, 1, 12), PdoEntry(0x2000, 2, 12))), (0xABC, 0x123), "bc3a12"),
    (PdoLayout(0x181, ()), (), ""),
]  # fmt: skip


@pytest.mark.parametrize("layout, values, wire", WIRE)
def test_bytes_and_values_both_ways(layout, values, wire):
    data = bytes.fromhex(wire)
    assert layout.length == len(data)
    assert layout.pack(*values) == data
    assert layout.unpack(data) == values
    assert len(layout.signals) == len(values)


@pytest.mark.parametrize("layout, values, wire", WIRE)
def test_any_other_length_is_refused_and_said(layout, values, wire):
    data = bytes.fromhex(wire)
    for broken in {data[:-1], data + b"\x00", bytes(9)} - {data}:
        with pytest.raises(ProtocolError, match=rf"expected {len(data)} bytes, got {len(broken)}"):
            layout.unpack(broken)


def test_what_stands_in_a_dummy_is_ignored():
    layout = PdoLayout(0x301, (DUMMY32, PdoEntry(0x607A, 0, 32, True)))
    assert layout.unpack(bytes.fromhex("ffffffff01000000")) == (1,)


@pytest.mark.parametrize(
    "values", [(0x10000, 0, 0), (-1, 0, 0), (0, 2**31, 0), (0, 0, -32769), (0, 0), (0, 0, 0, 0), (0, 1.5, 0)]
)
def test_values_that_do_not_fit_are_refused(values):
    with pytest.raises(ProtocolError, match="0x181"):
        TPDO1.pack(*values)


@pytest.mark.parametrize("values", [(2, 0), (0, 8), (0, -9), (1,), (1, 1, 1)])
def test_bit_values_that_do_not_fit_are_refused(values):
    layout = PdoLayout(0x182, (PdoEntry(0x2000, 1, 1), PdoEntry(0x2000, 2, 4, True)))
    with pytest.raises(ProtocolError, match="0x182"):
        layout.pack(*values)


@pytest.mark.parametrize("bits", [(65,), (0,), (64, 1), (32, 32, 8), (-8,)])
def test_mappings_that_cannot_be_are_refused_cia_301(bits):
    with pytest.raises(ProtocolError):
        PdoLayout(0x181, tuple(PdoEntry(0x2000, n, b) for n, b in enumerate(bits, 1)))


def test_mapping_words_cia_301_1a00h():
    assert tuple(entry.word for entry in TPDO1.entries) == (0x60410010, 0x60640020, 0x60770010)
    for entry in (*TPDO1.entries, DUMMY32):
        assert PdoEntry.from_word(entry.word, entry.signed, entry.name) == entry


def test_dummies_are_the_indices_up_to_7_cia_301():
    assert [PdoEntry(i, 0, 8).is_dummy for i in (0, 1, 7, 8, 0x2000)] == [True, True, True, False, False]


def test_layouts_compare_by_content():
    assert PdoLayout(0x181, (STATUS, POSITION, TORQUE)) == TPDO1
    assert PdoLayout(0x182, (STATUS, POSITION, TORQUE)) != TPDO1
    assert hash(PdoLayout(0x181, (STATUS, POSITION, TORQUE))) == hash(TPDO1)


@st.composite
def layouts_and_values(draw):
    room, entries, values = 64, [], []
    for n in range(draw(st.integers(1, 8))):
        if room == 0:
            break
        bits = draw(st.sampled_from([b for b in (1, 2, 3, 7, 8, 12, 16, 24, 32, 40, 64) if b <= room]))
        signed, dummy = draw(st.booleans()), draw(st.integers(0, 4)) == 0
        entries.append(PdoEntry(4 if dummy else 0x2000, n, bits, signed))
        if not dummy:
            lowest = -(2 ** (bits - 1)) if signed else 0
            values.append(draw(st.integers(lowest, lowest + 2**bits - 1)))
        room -= bits
    return PdoLayout(0x181, tuple(entries)), tuple(values)


@given(layouts_and_values())
def test_round_trip_and_agreement_with_a_string_of_bits(case):
    layout, values = case
    text, left = "", list(values)
    for entry in layout.entries:  # independent: a string of bits, first entry at its right end
        value = 0 if entry.is_dummy else left.pop(0)
        text = format(value % 2**entry.bits, f"0{entry.bits}b") + text
    expected = int(text, 2).to_bytes((len(text) + 7) // 8, "little")
    assert layout.pack(*values) == expected
    assert layout.unpack(expected) == values


@given(st.binary(max_size=12))
def test_any_bytes_unpack_or_raise_the_own_error(data):
    try:
        values = TPDO1.unpack(data)
    except ProtocolError:
        assert len(data) != 8
    else:
        assert TPDO1.pack(*values) == data


def test_a_long_pdo_is_filled_up_to_a_length_that_fd_has():
    entries = tuple(PdoEntry(0x2100, i, 64) for i in range(1, 9))
    with pytest.raises(ProtocolError, match="at most 64"):
        PdoLayout(0x512, entries)
    layout = PdoLayout(0x512, entries, fd=True)
    values = tuple(range(8))
    assert layout.length == 64 and layout.unpack(layout.pack(*values)) == values
    assert layout.pack(*values) == b"".join(value.to_bytes(8, "little") for value in values)
    uneven = PdoLayout(0x512, (*entries[:1], PdoEntry(0x2005, 0, 8)), fd=True)
    assert uneven.pack(1, 2) == b"\x01" + bytes(7) + b"\x02" + bytes(3)
    assert uneven.unpack(uneven.pack(1, 2)) == (1, 2)
    bits = PdoLayout(0x512, (*entries, PdoEntry(0x2005, 0, 1))[1:], fd=True)
    assert bits.length == 64 and bits.unpack(bits.pack(*range(7), 1)) == (*range(7), 1)
    with pytest.raises(ProtocolError, match="at most 512"):
        PdoLayout(0x512, (*entries, PdoEntry(0x2005, 0, 1)), fd=True)


@pytest.mark.parametrize(("layout", "values", "wire"), WIRE)
def test_a_layout_goes_to_another_process_and_is_the_same_there(layout, values, wire):
    for other in (pickle.loads(pickle.dumps(layout)), copy.deepcopy(layout)):
        assert other == layout and other.pack(*values).hex() == wire
