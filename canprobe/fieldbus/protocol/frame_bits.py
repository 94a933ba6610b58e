"""Bits of a CAN frame on the wire: the exact number for given contents, the least and the most that can be.

Lengths run from start of frame to the end of the intermission, so that frames laid end to end fill the bus. A stuff
bit follows five equal bits, stuff bits included; in a classical frame up to the end of the CRC sequence, in an FD frame
up to the end of the data field, whose CRC field has stuff bits at fixed places instead. FD frames switch the bit rate.

Source: ISO 11898-1:2015 (frame formats, bit stuffing, CRC field, error frame, interframe space); worst cases as in
Davis, Burns, Bril, Lukkien 2007, and, for FD, Bordoloi and Samii, "The frame packing problem for CAN-FD",
RTSS 2014, whose formula lacks the stuff count that ISO added in 2015 (4 bits and a fixed stuff bit).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

from canprobe.errors import ProtocolError
from canprobe.fieldbus.protocol.frames import EFF_FLAG, EFF_MASK, RTR_FLAG

NS_PER_S = 1_000_000_000
ERROR_FLAG_BITS = 6
ERROR_DELIMITER_BITS = 8
INTERMISSION_BITS = 3
SUSPEND_BITS = 8  # an error-passive node waits so long after its own frame
WORST_ERROR_BITS = 2 * ERROR_FLAG_BITS + ERROR_DELIMITER_BITS + INTERMISSION_BITS + SUSPEND_BITS
"""31, the overhead of one error besides the frame that has to be sent again: the flag of one node and those of the
others behind it, and an error-passive sender (Tindell and Burns 1994)."""

FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Data bytes of an FD frame by its data length code."""

_TAIL_BITS = 1 + 1 + 1 + 7 + INTERMISSION_BITS  # CRC delimiter, ACK slot, ACK delimiter, end of frame
_FD_TAIL_BITS = _TAIL_BITS - 1  # its CRC delimiter belongs to the data phase


@dataclass(frozen=True, slots=True)
class FrameLength:
    """Bits of an FD frame.

    Attributes:
        nominal: bits at the nominal bit rate.
        data: bits at the data bit rate, from ESI to the CRC delimiter. (In each of the two bits where the rate changes
            one half has one rate and one half the other, which adds up to one bit of both.)
    """

    nominal: int
    data: int


# Bit stuffing. The state of the wire is the level of the last bits and how many of them are equal; the fifth equal bit
# is followed by its stuff bit at once, so that there are 2 levels × 4 states.

_STUFF_RUN_BITS = 5


def _step(state: int, bit: int) -> tuple[int, int]:
    """State after one more bit, and the stuff bits that it causes."""
    level, run = divmod(state, _STUFF_RUN_BITS)
    run = run + 1 if bit == level else 1
    return (bit * _STUFF_RUN_BITS + run, 0) if run < _STUFF_RUN_BITS else ((1 - bit) * _STUFF_RUN_BITS + 1, 1)


_START_STATE = 1  # one dominant bit


def _feed(state: int, value: int, n_bits: int) -> tuple[int, int]:
    """State after the lowest `n_bits` of `value`, highest first, and the stuff bits that they cause."""
    total = 0
    for place in range(n_bits - 1, -1, -1):
        state, stuffed = _step(state, value >> place & 1)
        total += stuffed
    return state, total


_Row = list[tuple[int, Any]]  # a row refers to rows


@cache
def _rows() -> dict[int, _Row]:
    """Stuff bits of a byte, and the row of the state after it, by state and byte."""
    rows: dict[int, _Row] = {level * _STUFF_RUN_BITS + run: [] for level in (0, 1) for run in range(1, _STUFF_RUN_BITS)}
    for state, row in rows.items():
        for byte in range(256):
            following, stuffed = _feed(state, byte, 8)
            row.append((stuffed, rows[following]))
    return rows


# CRC-15 of classical frames. Source: ISO 11898-1:2015, CRC sequence.

_CRC15_POLYNOMIAL = 0x4599


def crc15(value: int, n_bits: int) -> int:
    """CRC of the lowest `n_bits` of `value`, highest first, by the polynomial 4599h from a register of 0."""
    register = 0
    for place in range(n_bits - 1, -1, -1):
        feedback = (register >> 14 ^ value >> place) & 1
        register = register << 1 & 0x7FFF ^ feedback * _CRC15_POLYNOMIAL
    return register


_CRC15_OF_BYTE = [crc15(byte, 8) for byte in range(256)]


# Classical frames.


def best_case_bits(n_data: int) -> int:
    """Bits of a classical frame without one stuff bit, 11-bit identifier: 47 + 8 n.

    Raises:
        ProtocolError: the number of data bytes is not 0..8.
    """
    return _stuffed_part(n_data) + _TAIL_BITS


def worst_case_bits(n_data: int) -> int:
    """Bits of a classical frame with every stuff bit there can be, 11-bit identifier: 55 + 10 n.

    Raises:
        ProtocolError: the number of data bytes is not 0..8.

    Source: Davis et al. 2007 (maximum number of stuff bits).
    """
    stuffed = _stuffed_part(n_data)
    return stuffed + (stuffed - 1) // 4 + _TAIL_BITS


def _stuffed_part(n_data: int) -> int:
    if not 0 <= n_data <= 8:
        raise ProtocolError(f"a CAN frame carries 0..8 data bytes, not {n_data}")
    return 34 + 8 * n_data


def exact_bits(can_id: int, data: bytes) -> int:
    """Bits of this very classical frame, with its CRC and its stuff bits.

    Args:
        can_id: identifier with `EFF_FLAG` for 29 bits and `RTR_FLAG` for a remote request, whose length code is 0 here.
        data: 0..8 bytes; none in a remote request.

    Raises:
        ProtocolError: no classical frame has such an identifier or length.
    """
    return _length_of(can_id, len(data))(data)


@lru_cache(maxsize=4096)
def _length_of(can_id: int, n_data: int) -> Callable[[bytes], int]:
    """The function that measures frames of one identifier and length; it has computed their header before."""
    if n_data > (0 if can_id & RTR_FLAG else 8):
        raise ProtocolError(f"{can_id:X}: no classical frame has {n_data} data bytes")
    header, n_header = _header(can_id, n_data)
    state, stuffed = _feed(_START_STATE, header, n_header - 1)
    bits = n_header + stuffed + 8 * n_data + 15 + _TAIL_BITS
    first, start, effects = _rows()[state], crc15(header, n_header), _CRC15_OF_BYTE

    def length(data: bytes) -> int:
        register, total, row = start, bits, first
        for byte in data:
            register = register << 8 & 0x7FFF ^ effects[register >> 7 ^ byte]
            stuffed, row = row[byte]
            total += stuffed
        # the CRC as two bytes: a bit that differs from the one before it fills them up and causes no stuff bit
        stuffed, row = row[register >> 7]
        last: int = row[register << 1 & 0xFE | ~register & 1][0]
        return total + stuffed + last

    return length


def _header(can_id: int, code: int) -> tuple[int, int]:
    """Value and number of the bits from the start of frame to the data length code."""
    remote = 1 if can_id & RTR_FLAG else 0
    identifier = can_id & ~(EFF_FLAG | RTR_FLAG)
    if can_id & EFF_FLAG and 0 <= identifier <= EFF_MASK:
        return (identifier >> 18) << 27 | 0b11 << 25 | (identifier & 0x3FFFF) << 7 | remote << 6 | code, 39
    if 0 <= identifier <= 0x7FF:
        return identifier << 7 | remote << 6 | code, 19
    raise ProtocolError(f"{can_id:X} is no CAN identifier; one of 29 bits carries the flag {EFF_FLAG:X}")


# FD frames. Their CRC and stuff count have stuff bits at fixed places, so that they do not change the length.


def best_case_fd_bits(n_data: int) -> FrameLength:
    """Bits of an FD frame without one dynamic stuff bit, 11-bit identifier.

    Raises:
        ProtocolError: no FD frame has this length.
    """
    _fd_code(n_data)
    return FrameLength(17 + _FD_TAIL_BITS, _fd_data_phase(n_data))


@lru_cache(maxsize=16)
def worst_case_fd_bits(n_data: int) -> FrameLength:
    """Bits of an FD frame with every stuff bit that identifier and data can cause, 11-bit identifier.

    Raises:
        ProtocolError: no FD frame has this length.
    """
    data_phase = f"10{_fd_code(n_data):04b}" + "x" * (8 * n_data)  # from BRS to the last data bit
    nominal, fast = _most_stuff_bits("0" + "x" * 11 + "00101"), _most_stuff_bits(data_phase[:-1])
    return FrameLength(17 + nominal + _FD_TAIL_BITS, _fd_data_phase(n_data) + fast)


def exact_fd_bits(can_id: int, data: bytes) -> FrameLength:
    """Bits of this very FD frame.

    Args:
        can_id: identifier with `EFF_FLAG` for 29 bits.
        data: data bytes, as many as an FD frame can have.

    Raises:
        ProtocolError: no FD frame has such an identifier or length, or it is a remote request.
    """
    code, (header, n_header) = _fd_code(len(data)), _fd_header(can_id)
    state, nominal = _feed(_START_STATE, header, n_header - 1)
    # the last bit before the CRC field causes no stuff bit: the field begins with one, whatever came before
    state, fast = _feed(state, code, 5) if data else _feed(state, code >> 1, 4)
    row = _rows()[state]
    for byte in data[:-1]:
        stuffed, row = row[byte]
        fast += stuffed
    if data:
        last = data[-1] & 0xFE
        fast += row[last | ~last >> 1 & 1][0]  # a bit that differs from the one before it
    return FrameLength(n_header + nominal + _FD_TAIL_BITS, _fd_data_phase(len(data)) + fast)


def _fd_code(n_data: int) -> int:
    try:
        return FD_LENGTHS.index(n_data)
    except ValueError:
        raise ProtocolError(f"an FD frame carries {', '.join(map(str, FD_LENGTHS))} data bytes, not {n_data}") from None


def _fd_header(can_id: int) -> tuple[int, int]:
    """Value and number of the bits from the start of frame to BRS."""
    identifier = can_id & ~EFF_FLAG
    if can_id & EFF_FLAG and 0 <= identifier <= EFF_MASK:
        return ((identifier >> 18) << 20 | 0b11 << 18 | identifier & 0x3FFFF) << 4 | 0b0101, 36
    if 0 <= can_id <= 0x7FF:
        return can_id << 5 | 0b00101, 17
    raise ProtocolError(f"{can_id:X} is no identifier of an FD frame; there are no remote requests in CAN FD")


def _fd_data_phase(n_data: int) -> int:
    """Bits of ESI, DLC, data, stuff count, CRC, fixed stuff bits and CRC delimiter."""
    crc, fixed = (17, 6) if n_data <= 16 else (21, 7)
    return 1 + 4 + 8 * n_data + 4 + crc + fixed + 1


def _most_stuff_bits(pattern: str) -> int:
    """The most stuff bits in a field that begins after a bit of the other level, over every choice of its free bits.

    Args:
        pattern: bits of the field, `0` and `1`, with `x` for a free one.
    """
    reached = {(1 - int(pattern[0])) * _STUFF_RUN_BITS + 1: 0}
    for symbol in pattern:
        following: dict[int, int] = {}
        for state, count in reached.items():
            for bit in (0, 1) if symbol == "x" else (int(symbol),):
                new, stuffed = _step(state, bit)
                following[new] = max(following.get(new, 0), count + stuffed)
        reached = following
    return max(reached.values())
