"""Frame lengths against a frame drawn bit by bit, published formulas, and published CRCs of whole frames."""

import re

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from canprobe.errors import ProtocolError
from canprobe.fieldbus.protocol.frame_bits import (
    FD_LENGTHS,
    WORST_ERROR_BITS,
    FrameLength,
    best_case_bits,
    best_case_fd_bits,
    crc15,
    exact_bits,
    exact_fd_bits,
    worst_case_bits,
    worst_case_fd_bits,
)
from canprobe.fieldbus.protocol.frames import EFF_FLAG, RTR_FLAG

# --- the wire drawn bit by bit, as strings ----------------------------------------------------------------------------


def remainder(bits, generator):
    """CRC by long division of polynomials; `generator` with its highest power."""
    width = generator.bit_length() - 1
    value = int(bits, 2) << width
    while value.bit_length() > width:
        value ^= generator << (value.bit_length() - 1 - width)
    return f"{value:0{width}b}"


def stuff(bits):
    out = ""
    for bit in bits:
        out += bit
        if re.search(r"(0{5}|1{5})$", out):
            out += "10"[int(bit)]
    return out


def field(value, width):
    return f"{value:0{width}b}"


def payload(data):
    return "".join(field(byte, 8) for byte in data)


def classical(can_id, data, remote=False, extended=False):
    code = field(len(data), 4)
    if extended:
        head = "0" + field(can_id >> 18, 11) + "11" + field(can_id & 0x3FFFF, 18) + str(int(remote)) + "00"
    else:
        head = "0" + field(can_id, 11) + str(int(remote)) + "00"
    body = head + code + payload(data)
    return stuff(body + remainder(body, 0xC599)) + "1" + "01" + "1" * 7 + "111"


def flexible(can_id, data, extended):
    """Bits at the nominal rate, bits at the data rate, and the whole frame, with bit-rate switch."""
    if extended:
        head = "0" + field(can_id >> 18, 11) + "11" + field(can_id & 0x3FFFF, 18) + "0" + "101"
    else:
        head = "0" + field(can_id, 11) + "00" + "101"
    unstuffed = head + "0" + field(FD_LENGTHS.index(len(data)), 4) + payload(data)
    stuffed, before = stuff(unstuffed[:-1]) + unstuffed[-1], stuff(head)  # next comes a stuff bit of fixed place anyway
    count = (len(stuffed) - len(unstuffed)) % 8
    gray = field(count ^ count >> 1, 3)
    counted = gray + str(gray.count("1") % 2)
    width, generator = (17, 0x3685B) if len(data) <= 16 else (21, 0x302899)
    protected = stuffed + counted
    start = field(int(protected, 2) ^ (1 << len(protected) - 1), len(protected))  # register starts with its highest bit
    crc = remainder(start, generator)
    assert len(crc) == width
    end = stuffed
    for n, bit in enumerate(counted + crc):
        if n % 4 == 0:
            end += "10"[int(end[-1])]
        end += bit
    tail = "01" + "1" * 7 + "111"
    fast = len(end) - len(before) + 1
    return len(before) + len(tail), fast, end + "1" + tail


standard, extended = st.integers(0, 0x7FF), st.integers(0, 0x1FFFFFFF)
runs = st.lists(st.sampled_from([0x00, 0xFF, 0x07, 0xF8, 0x1F, 0xE0, 0x0F, 0x83, 0xAA]), max_size=8).map(bytes)
short = st.binary(max_size=8) | runs


@settings(deadline=None, max_examples=400)
@given(standard, short)
@example(0, bytes(8))
@example(0x7FF, b"\xff" * 8)
def test_exact_length_is_that_of_the_drawn_frame(can_id, data):
    drawn = classical(can_id, data)
    assert exact_bits(can_id, data) == len(drawn)
    assert best_case_bits(len(data)) <= len(drawn) <= worst_case_bits(len(data))


@settings(deadline=None, max_examples=200)
@given(extended, short)
def test_exact_length_with_29_bits(can_id, data):
    drawn = classical(can_id, data, extended=True)
    assert exact_bits(can_id | EFF_FLAG, data) == len(drawn)


@given(standard, st.booleans())
def test_remote_requests_carry_no_data(can_id, wide):
    drawn = classical(can_id, b"", remote=True, extended=wide)
    assert exact_bits(can_id | RTR_FLAG | (EFF_FLAG if wide else 0), b"") == len(drawn)


lengths = st.sampled_from(FD_LENGTHS).flatmap(lambda n: st.binary(min_size=n, max_size=n))


@settings(deadline=None, max_examples=300)
@given(standard, lengths)
@example(0x555, b"")  # ESI and length code end in five zeros
@example(0x7FF, b"\xff" * 64)
@example(0, bytes(16))
def test_exact_fd_length_is_that_of_the_drawn_frame(can_id, data):
    nominal, fast, whole = flexible(can_id, data, extended=False)
    assert exact_fd_bits(can_id, data) == FrameLength(nominal, fast)
    assert nominal + fast == len(whole)
    worst, best = worst_case_fd_bits(len(data)), best_case_fd_bits(len(data))
    assert best.nominal <= nominal <= worst.nominal and best.data <= fast <= worst.data


@settings(deadline=None, max_examples=150)
@given(extended, lengths)
def test_exact_fd_length_with_29_bits(can_id, data):
    nominal, fast, _ = flexible(can_id, data, extended=True)
    assert exact_fd_bits(can_id | EFF_FLAG, data) == FrameLength(nominal, fast)


@settings(deadline=None)
@given(st.integers(0, 2**80 - 1), st.integers(1, 80))
def test_crc_is_the_remainder_of_a_division(value, n_bits):
    value &= (1 << n_bits) - 1
    assert crc15(value, n_bits) == int(remainder(field(value, n_bits), 0xC599), 2)


# --- published -----------------------------------------------------------------------------------------------------


def test_check_value_of_the_crc_catalogue():
    """CRC-15/CAN of "123456789" (the catalogue of parametrised CRC algorithms)."""
    assert crc15(int.from_bytes(b"123456789", "big"), 72) == 0x059E


def test_a_published_iso_can_fd_frame():
    """Bits of a frame that CANalyzer sent: 5AAh, eight bytes FFh, BRS (Stack Overflow 76863615)."""
    protected = (
        "0 10110101010 0 0 1 0 1 0 1000 111110111 1101111101 111101111 1011111011 1110111110 111110111 1101111101"
        " 111101111 1100"
    ).replace(" ", "")
    whole = flexible(0x5AA, b"\xff" * 8, extended=False)[2]
    assert whole.startswith(protected[:-4])
    # 12 stuff bits; 17 + 12 bits at the nominal rate, 1 + 4 + 64 + 4 + 17 + 6 + 1 and the stuff bits at the data rate
    assert exact_fd_bits(0x5AA, b"\xff" * 8) == FrameLength(29, 97 + 12)


@pytest.mark.parametrize("n", range(9))
def test_worst_cases_are_the_closed_forms_of_davis_equation_1(n):
    assert (best_case_bits(n), worst_case_bits(n)) == (47 + 8 * n, 55 + 10 * n)


@pytest.mark.parametrize("n", FD_LENGTHS)
def test_worst_fd_frame_is_the_closed_form_of_bordoloi_and_samii(n):
    """32 nominal bits and 28 + 5⌈(n − 16)/64⌉ + 10 n fast ones; ISO's stuff count adds 4 and a fixed stuff bit.

    The formula takes the data length code as free; a fixed one can save the last stuff bit.
    """
    formula = 28 + 5 * (-((16 - n) // 64)) + 10 * n + 5
    worst = worst_case_fd_bits(n)
    assert worst.nominal == 32
    assert formula - 1 <= worst.data <= formula


@pytest.mark.parametrize("n", FD_LENGTHS)
def test_fd_lengths_are_those_of_linux(n):
    """include/linux/can/length.h: header of 22, CRC field of 28 or 33, footer of 9, intermission of 3; its bound for
    stuffing is at most two bits wider, for it lets the whole frame be free."""
    crc_field = 28 if n <= 16 else 33
    best, worst = best_case_fd_bits(n), worst_case_fd_bits(n)
    assert best.nominal + best.data == 22 + 8 * n + crc_field + 9 + 3
    linux = 22 + 8 * n + (22 + 8 * n - 1) // 4 + crc_field + 9 + 3
    assert linux - 4 <= worst.nominal + worst.data <= linux


def test_worst_error_frame():
    """ISO 11898-1: flag 6 (12 superposed), delimiter 8, intermission 3, suspend transmission 8."""
    assert WORST_ERROR_BITS == 31


# --- worst cases are reached ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", range(9))
def test_the_worst_case_by_stuffing_the_adversarys_pattern(n):
    """1 + 4 equal bits, then groups of 4 that each begin with the stuff bit before them."""
    stuffable = 34 + 8 * n
    bits = ("00000" + "11110000" * 20)[:stuffable]
    assert worst_case_bits(n) == best_case_bits(n) + len(stuff(bits)) - stuffable


@pytest.mark.parametrize("n", [0, 1, 8, 20])
def test_the_fd_bound_is_reached(n):
    """By a search over identifiers and data; what no frame reaches would be a bound too wide."""
    found = FrameLength(0, 0)
    for can_id in (0x078, 0x07B, 0x043, 0x41E, 0x787, 0x01E, 0x000):
        for byte in (0x0F, 0xF0, 0x87, 0x78, 0xC3, 0x3C, 0xE1, 0x1E):
            length = exact_fd_bits(can_id, bytes([byte]) * n)
            found = FrameLength(max(found.nominal, length.nominal), max(found.data, length.data))
    assert found == worst_case_fd_bits(n)


@pytest.mark.parametrize("n", [-1, 9])
def test_impossible_lengths_are_refused(n):
    for function in (best_case_bits, worst_case_bits, best_case_fd_bits, worst_case_fd_bits):
        with pytest.raises(ProtocolError):
            function(n)


@pytest.mark.parametrize("can_id, data", [(0x800, b""), (-1, b""), (0x100, bytes(9)), (0x100 | RTR_FLAG, b"1")])
def test_frames_that_do_not_exist_are_refused(can_id, data):
    with pytest.raises(ProtocolError):
        exact_bits(can_id, data)


@pytest.mark.parametrize("can_id, data", [(0x800, b""), (0x100 | RTR_FLAG, b""), (0x100, bytes(9))])
def test_fd_frames_that_do_not_exist_are_refused(can_id, data):
    with pytest.raises(ProtocolError):
        exact_fd_bits(can_id, data)
