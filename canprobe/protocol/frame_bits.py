"""How many bits a CAN frame takes on the wire: exact for given contents, and the best and worst that can be.

Lengths run from start of frame to the end of the intermission, so that frames laid end to end fill the bus. A stuff
bit follows five equal bits, stuff bits included; in a classical frame up to the end of the CRC sequence, in an FD frame
up to the end of the data field, whose CRC field has stuff bits at fixed places instead.

Source: ISO 11898-1:2015 (frame formats, bit stuffing, CRC field, error frame, interframe space); worst cases as in
Davis, Burns, Bril, Lukkien 2007, and, for FD, Bordoloi and Samii, "The frame packing problem for CAN-FD",
RTSS 2014, whose formula lacks the stuff count that ISO added in 2015 (4 bits and a fixed stuff bit).
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from struct import Struct

import numpy as np
from numpy.typing import NDArray

from canprobe.errors import ProtocolError
from canprobe.protocol.frames import EFF_FLAG, RTR_FLAG

# The three CRCs of CAN: bit by bit over integers, and tables for whole bytes where speed counts.
#
# Source: ISO 11898-1:2015, CRC sequence: generators of CRC-15 (classical), CRC-17 (FD, up to 16 bytes) and CRC-21 (FD,
# more than 16 bytes). The FD registers start with their highest bit set; before 2015 (Bosch CAN FD 1.0) they began at
# 0.


@dataclass(frozen=True, slots=True)
class Crc:
    """One CRC: bits enter most significant first, nothing is reflected, nothing is added at the end.

    Attributes:
        width: bits of the register.
        polynomial: generator without its highest power.
        start: of the register.
    """

    width: int
    polynomial: int
    start: int = 0

    def of(self, value: int, n_bits: int) -> int:
        """CRC of the lowest `n_bits` of `value`, highest first."""
        return self.add(self.start, value, n_bits)

    def add(self, register: int, value: int, n_bits: int) -> int:
        """The register after `n_bits` more."""
        top, mask = self.width - 1, (1 << self.width) - 1
        for place in range(n_bits - 1, -1, -1):
            feedback = (register >> top ^ value >> place) & 1
            register = register << 1 & mask
            if feedback:
                register ^= self.polynomial
        return register

    def byte_tables(self, places: int) -> tuple[tuple[int, ...], ...]:
        """What each byte does to the register, when `places` − 1, …, 1, 0 bytes follow it: the CRC is linear."""
        mask, shift = (1 << self.width) - 1, self.width - 8
        last = tuple(self.add(0, byte, 8) for byte in range(256))
        found = [last]
        for _ in range(places - 1):
            found.append(tuple((register << 8 & mask) ^ last[register >> shift] for register in found[-1]))
        return tuple(reversed(found))


CRC15 = Crc(15, 0x4599)
CRC17 = Crc(17, 0x1685B, 1 << 16)
CRC21 = Crc(21, 0x102899, 1 << 20)


# Stuff bits: after five equal bits, stuff bits included, the opposite one is sent.
#
# A stuffing is one integer: stuff bits so far × 16 + state, the state being the last level and how often it was sent.

RUN = 5
_STATES = 10


def _state(level: int, run: int) -> int:
    return level * 5 + run - 1  # run 1..5: after the fifth the stuff bit has been sent at once, so 5 never stays


def _step(state: int, bit: int) -> tuple[int, int]:
    """State after one more bit, and the stuff bits that it caused."""
    level, run = divmod(state, 5)
    run = run + 2 if bit == level else 1
    return (_state(bit, run), 0) if run < RUN else (_state(1 - bit, 1), 1)


START_OF_FRAME = _state(0, 1)
"""The stuffing after the first dominant bit."""


def feed(stuffing: int, value: int, n_bits: int) -> int:
    """The stuffing after the lowest `n_bits` of `value`, highest first."""
    state, count = stuffing & 15, stuffing >> 4
    for place in range(n_bits - 1, -1, -1):
        state, stuffed = _step(state, value >> place & 1)
        count += stuffed
    return count << 4 | state


COUNT_SHIFT = 6
Rows = tuple[Sequence[int], ...]
"""What some bits do, by what the bits before them did and by their value: stuff bits × 64 + state after them.

Sums of ten such numbers and more keep their stuff bits apart from the states. The first row is that of a state alone.
"""


def state_of(stuffing: int) -> int:
    """The row with which to go on after `feed`."""
    return stuffing & 15


@cache
def byte_rows() -> Rows:
    """Of 8 bits."""
    return _aliased([array("H", row.tolist()) for row in _bits(8)])


@cache
def word_rows() -> Rows:
    """Of 16 bits, highest first."""
    first = _bits(8)
    both = (first >> COUNT_SHIFT << COUNT_SHIFT)[:, :, None] + first[first & _STATE]
    return _aliased([array("H", row.tobytes()) for row in both])


@cache
def last_rows() -> Rows:
    """Of 15 bits that nothing follows: their stuff bits alone."""
    first = _bits(8)
    both = (first >> COUNT_SHIFT)[:, :, None] + (_bits(7) >> COUNT_SHIFT)[first & _STATE]
    return _aliased([row.astype(np.uint8).tobytes() for row in both])


_STATE = (1 << COUNT_SHIFT) - 1


def _bits(n: int) -> NDArray[np.uint16]:
    """By state and value."""
    fed = np.array([[feed(state, value, n) for value in range(1 << n)] for state in range(_STATES)], np.uint16)
    return (fed >> 4 << COUNT_SHIFT | fed & 15).astype(np.uint16)


def _aliased(rows: Sequence[Sequence[int]]) -> Rows:
    """Each row wherever its state is, whatever was counted before it."""
    most = 16 // (RUN - 1)
    return tuple(rows[min(at & _STATE, _STATES - 1)] for at in range((most << COUNT_SHIFT) + _STATES))


@cache
def cut_into_words(n_data: int) -> tuple[Callable[[bytes], tuple[int, ...]], tuple[Rows, ...]]:
    """How data is cut into words, an odd byte last, and the rows of each."""
    pairs, odd = divmod(n_data, 2)
    return Struct(f">{pairs}H{odd}B").unpack, (word_rows(),) * pairs + (byte_rows(),) * odd


def most_stuff_bits(pattern: str) -> int:
    """The most stuff bits in a field that begins after a bit of the other level, over every choice of its free bits.

    Args:
        pattern: `0`, `1` and `x` for a free bit.
    """
    reached = {_state(1 - level, 1): 0 for level in (0, 1) if pattern[:1] in ("x", str(level))}
    for symbol in pattern:
        following: dict[int, int] = {}
        for state, count in reached.items():
            for bit in (0, 1) if symbol == "x" else (int(symbol),):
                new, stuffed = _step(state, bit)
                following[new] = max(following.get(new, 0), count + stuffed)
        reached = following
    return max(reached.values(), default=0)


# How many bits a CAN frame takes on the wire: exact for given contents, and the best and worst that can be.

ERROR_FLAG_BITS = 6
ERROR_DELIMITER_BITS = 8
INTERMISSION_BITS = 3
SUSPEND_BITS = 8  # an error-passive node waits so long after its own frame
RECOVERY_RECESSIVE_BITS = 128 * 11  # a node that is bus off listens for so many before it comes back

FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""Data bytes of an FD frame by its data length code."""

_TAIL = 1 + 1 + 1 + 7 + INTERMISSION_BITS  # CRC delimiter, ACK slot, ACK delimiter, end of frame
_FD_TAIL = _TAIL - 1  # its CRC delimiter belongs to the data phase


@dataclass(frozen=True, slots=True)
class FrameLength:
    """A frame's bits.

    Attributes:
        nominal: at the nominal bit rate.
        data: at the data bit rate: of an FD frame with bit-rate switch from ESI to the CRC delimiter, else 0. (The bits
            in which the rate changes are each half one and half the other, which adds up to one of both.)
    """

    nominal: int
    data: int = 0

    @property
    def total(self) -> int:
        """All bits."""
        return self.nominal + self.data

    def time_ns(self, bitrate: int, data_bitrate: int | None = None) -> int:
        """Time on the wire, ns, rounded up.

        Args:
            bitrate: nominal, bit/s.
            data_bitrate: of the data phase, bit/s; None: the nominal one.
        """
        fast = data_bitrate or bitrate
        return -(-(self.nominal * fast + self.data * bitrate) * 1_000_000_000 // (bitrate * fast))


def best_case_bits(n_data: int, *, extended: bool = False) -> int:
    """Bits of a classical frame without one stuff bit: 47 + 8 n, or 67 + 8 n with a 29-bit identifier.

    A remote frame is as long as one without data.

    Raises:
        ProtocolError: not 0..8 data bytes.
    """
    return _stuffed_part(n_data, extended) + _TAIL


def worst_case_bits(n_data: int, *, extended: bool = False) -> int:
    """Bits of a classical frame with every stuff bit there can be: 55 + 10 n, or 80 + 10 n with a 29-bit identifier.

    Raises:
        ProtocolError: not 0..8 data bytes.

    Source: Davis et al. 2007 (maximum number of stuff bits).
    """
    stuffed = _stuffed_part(n_data, extended)
    return stuffed + (stuffed - 1) // 4 + _TAIL


def _stuffed_part(n_data: int, extended: bool) -> int:
    if not 0 <= n_data <= 8:
        raise ProtocolError(f"a CAN frame carries 0..8 data bytes, not {n_data}")
    return (54 if extended else 34) + 8 * n_data


def exact_bits(can_id: int, data: bytes, *, dlc: int | None = None) -> int:
    """Bits of this very classical frame, with its CRC and its stuff bits.

    Args:
        can_id: with `EFF_FLAG` for 29 bits and `RTR_FLAG` for a remote request.
        data: 0..8 bytes; none in a remote request.
        dlc: data length code where it is not the length of `data`: of a remote request.

    Raises:
        ProtocolError: an identifier or a length that no frame has.
    """
    return _length_of(can_id, len(data), dlc)(data)


_Length = Callable[[bytes], int]


@lru_cache(maxsize=4096)
def _length_of(can_id: int, n_data: int, dlc: int | None) -> _Length:
    """What measures the frames of one identifier and one length; it knows the header and its part of the CRC."""
    code = n_data if dlc is None else dlc
    if not 0 <= code <= 15 or n_data != (0 if can_id & RTR_FLAG else min(code, 8)):
        raise ProtocolError(f"{can_id:X}: no classical frame has {n_data} data bytes and the length code {code}")
    value, n_bits = _arbitration(can_id, code)
    stuffing = feed(START_OF_FRAME, value, n_bits - 1)
    bits = n_bits + (stuffing >> 4) + 8 * n_data + 15 + _TAIL
    crc = CRC15.of(value << 8 * n_data, n_bits + 8 * n_data)
    return (_of_four_words if n_data == 8 else _of_words)(n_data, bits, crc, state_of(stuffing))


def _arbitration(can_id: int, code: int) -> tuple[int, int]:
    """Start of frame to DLC: value and number of bits."""
    remote = 1 if can_id & RTR_FLAG else 0
    identifier = can_id & ~(EFF_FLAG | RTR_FLAG)
    if can_id & EFF_FLAG and 0 <= identifier <= 0x1FFFFFFF:
        return (identifier >> 18) << 27 | 0b11 << 25 | (identifier & 0x3FFFF) << 7 | remote << 6 | code, 39
    if 0 <= identifier <= 0x7FF:
        return identifier << 7 | remote << 6 | code, 19
    raise ProtocolError(f"{can_id:X} is no CAN identifier; one of 29 bits carries the flag {EFF_FLAG:X}")


def _of_words(n_data: int, bits: int, crc: int, state: int) -> _Length:
    """Length with data of any length; `bits` and `crc` are those of the frame with data of 0, without its stuffing."""
    cut, rows = cut_into_words(n_data)
    words, last = tuple(zip(rows, _crc15_words(n_data), strict=True)), last_rows()

    def length(data: bytes) -> int:
        register, total, step = crc, 0, state
        for value, (row, effect) in zip(cut(data), words, strict=True):
            register ^= effect[value]
            step = row[step][value]
            total += step
        return bits + (total >> COUNT_SHIFT) + last[step][register]

    return length


def _of_four_words(n_data: int, bits: int, crc: int, state: int) -> _Length:
    """The same for 8 bytes, the usual PDO, in half of the time."""
    cut, _ = cut_into_words(n_data)
    rows, last = word_rows(), last_rows()
    first = rows[state]
    at_a, at_b, at_c, at_d = _crc15_words(n_data)

    def length(data: bytes) -> int:
        a, b, c, d = cut(data)
        after_a = first[a]
        after_b = rows[after_a][b]
        after_c = rows[after_b][c]
        after_d = rows[after_c][d]
        stuffed = (after_a + after_b + after_c + after_d) >> COUNT_SHIFT
        return bits + stuffed + last[after_d][crc ^ at_a[a] ^ at_b[b] ^ at_c[c] ^ at_d[d]]

    return length


@cache
def _crc15_words(n_data: int) -> tuple[Sequence[int], ...]:
    """What each word of so many bytes does to the CRC, an odd byte last."""
    places = CRC15.byte_tables(8)[8 - n_data :]
    words = tuple(_crc15_pair(n_data - at - 2) for at in range(0, n_data - 1, 2))
    return words + places[n_data - n_data % 2 :]


@cache
def _crc15_pair(behind: int) -> Sequence[int]:
    """What two bytes do to the CRC that have so many more behind them."""
    first, second = (np.array(table, np.uint16) for table in CRC15.byte_tables(behind + 2)[:2])
    return array("H", np.bitwise_xor.outer(first, second).tobytes())


def fd_dlc(n_data: int) -> int:
    """Data length code of an FD frame.

    Raises:
        ProtocolError: an FD frame cannot have this length.
    """
    try:
        return FD_LENGTHS.index(n_data)
    except ValueError:
        raise ProtocolError(f"an FD frame carries {', '.join(map(str, FD_LENGTHS))} data bytes, not {n_data}") from None


def exact_fd_bits(can_id: int, data: bytes, *, brs: bool = True, esi: bool = False) -> FrameLength:
    """Bits of this very FD frame.

    The CRC and the stuff count do not change the length: their stuff bits have fixed places.

    Args:
        can_id: with `EFF_FLAG` for 29 bits.
        data: of a length that FD has.
        brs: the data phase has its own bit rate.
        esi: the sender is error-passive.

    Raises:
        ProtocolError: a remote request, an identifier or a length that no FD frame has.
    """
    value, n_bits = _fd_arbitration(can_id, brs)
    stuffing = feed(START_OF_FRAME, value, n_bits - 1)
    before = stuffing >> 4
    # the last bit before the CRC field is left out: the field begins with a stuff bit, whatever came before
    rest = ((esi << 4 | fd_dlc(len(data))) << 8 * len(data) | int.from_bytes(data, "big")) >> 1
    stuffing = feed(stuffing, rest >> 8 * len(data), 4)
    step, total = state_of(stuffing), 0
    cut, rows = cut_into_words(len(data))
    for word, row in zip(cut((rest & (1 << 8 * len(data)) - 1).to_bytes(len(data), "big")), rows, strict=True):
        step = row[step][word]
        total += step >> COUNT_SHIFT
    count = (stuffing >> 4) - before + total
    nominal, fast = n_bits + before + _FD_TAIL, _fd_data_phase(len(data)) + count
    return FrameLength(nominal, fast) if brs else FrameLength(nominal + fast)


def worst_case_fd_bits(n_data: int, *, extended: bool = False, brs: bool = True, esi: bool = False) -> FrameLength:
    """Bits of an FD frame with every stuff bit that identifier and data can cause.

    Raises:
        ProtocolError: an FD frame cannot have this length.
    """
    return _fd_bound(n_data, extended, brs, esi)


def best_case_fd_bits(n_data: int, *, extended: bool = False, brs: bool = True) -> FrameLength:
    """Bits of an FD frame without one dynamic stuff bit.

    Raises:
        ProtocolError: an FD frame cannot have this length.
    """
    fd_dlc(n_data)
    nominal, fast = (36 if extended else 17) + _FD_TAIL, _fd_data_phase(n_data)
    return FrameLength(nominal, fast) if brs else FrameLength(nominal + fast)


def _fd_arbitration(can_id: int, brs: bool) -> tuple[int, int]:
    """Start of frame to BRS: value and number of bits."""
    identifier = can_id & ~EFF_FLAG
    if can_id & EFF_FLAG and 0 <= identifier <= 0x1FFFFFFF:
        return ((identifier >> 18) << 20 | 0b11 << 18 | identifier & 0x3FFFF) << 4 | 0b0100 | brs, 36
    if 0 <= can_id <= 0x7FF:
        return can_id << 5 | 0b00100 | brs, 17
    raise ProtocolError(f"{can_id:X} is no identifier of an FD frame; there are no remote requests in CAN FD")


def _fd_data_phase(n_data: int) -> int:
    """ESI, DLC, data, stuff count, CRC, fixed stuff bits, CRC delimiter."""
    crc, fixed = (17, 6) if n_data <= 16 else (21, 7)
    return 1 + 4 + 8 * n_data + 4 + crc + fixed + 1


@lru_cache(maxsize=256)
def _fd_bound(n_data: int, extended: bool, brs: bool, esi: bool) -> FrameLength:
    code = f"{fd_dlc(n_data):04b}"
    arbitration = "0" + ("x" * 11 + "11" + "x" * 18 + "0" if extended else "x" * 11 + "00") + f"10{brs:d}"
    rest = f"{esi:d}{code}" + "x" * (8 * n_data)
    best = best_case_fd_bits(n_data, extended=extended, brs=brs)
    if not brs:
        return FrameLength(best.nominal + most_stuff_bits((arbitration + rest)[:-1]))
    return FrameLength(best.nominal + most_stuff_bits(arbitration), best.data + most_stuff_bits(("1" + rest)[:-1]))


def error_bits(*, flag: int = ERROR_FLAG_BITS, suspend: bool = False) -> int:
    """Bits from the first of an error flag to the end of the intermission: 17, or up to 31.

    Args:
        flag: 6, up to 12 where the others answer the first flag with theirs.
        suspend: the sender is error-passive and waits before it tries again.

    Raises:
        ProtocolError: a flag is 6 to 12 bits long.
    """
    if not ERROR_FLAG_BITS <= flag <= 2 * ERROR_FLAG_BITS:
        raise ProtocolError(f"superposed error flags are 6..12 bits long, not {flag}")
    return flag + ERROR_DELIMITER_BITS + INTERMISSION_BITS + (SUSPEND_BITS if suspend else 0)


WORST_ERROR_BITS = error_bits(flag=2 * ERROR_FLAG_BITS, suspend=True)
"""31, the overhead of one error besides the frame that has to be sent again (Tindell and Burns 1994)."""
