"""PDO layouts: a mapping compiled once, then packed and unpacked in half a microsecond."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum

from canprobe.errors import ProtocolError
from canprobe.fieldbus.protocol.frame_bits import FD_LENGTHS

RPDOS, TPDOS = range(0x1400, 0x1600), range(0x1800, 0x1A00)
"""Indices of the communication parameters of PDOs; the mapping of each lies `TO_MAPPING` above."""
TO_MAPPING = 0x200
PDO_OBJECTS = range(0x1400, 0x1C00)
"""Indices of the communication and mapping parameters of all PDOs."""
NO_RTR_FLAG = 1 << 30
"""Bit 30 of the COB-ID of a TPDO: a remote request is not answered."""
MAX_SYNC_TYPE = 240
"""Highest transmission type that goes by SYNC; a TPDO of a type from 1 on is sent at each SYNC of that number."""
MAX_PDO_BITS = 64
MAX_FD_PDO_BITS = 512
"""Most bits of a PDO in a CAN FD frame. Source: CiA 1301."""
_STRUCT_CODES = {8: "b", 16: "h", 32: "i", 64: "q"}


class PdoSub(IntEnum):
    """Sub-indices of the communication parameters. Source: CiA 301, objects 1400h, 1800h."""

    COB_ID = 1
    TYPE = 2
    INHIBIT_TIME = 3
    EVENT_TIMER = 5
    SYNC_START = 6


@dataclass(frozen=True, slots=True)
class PdoEntry:
    """One mapped object. An index of 0007h or less is a dummy: room on the wire without a value.

    Attributes:
        index: object index; 0001h..0007h are CiA 301's dummy types.
        subindex: sub-index.
        bits: length on the wire, 1..64.
        signed: whether the value is in two's complement.
        name: name of the object, for people and logs.
    """

    index: int
    subindex: int
    bits: int
    signed: bool = False
    name: str = ""

    @property
    def is_dummy(self) -> bool:
        """Whether this entry only takes up room."""
        return self.index <= 0x0007

    @property
    def word(self) -> int:
        """The mapping parameter value, as sub-index 1..64 of 1600h or 1A00h holds it."""
        return self.index << 16 | self.subindex << 8 | self.bits

    @classmethod
    def from_word(cls, word: int, signed: bool = False, name: str = "") -> PdoEntry:
        """Make an entry from a mapping parameter value (index, sub-index, length in bits)."""
        return cls(word >> 16 & 0xFFFF, word >> 8 & 0xFF, word & 0xFF, signed, name)


class _BitCodec:
    """Packs the entries that struct cannot pack: any width and alignment, least significant bit first."""

    __slots__ = ("_fields", "_length")

    def __init__(self, entries: tuple[PdoEntry, ...], length: int) -> None:
        self._length = length
        self._fields: list[tuple[int, int, int, int]] = []  # shift, mask, sign bit, lowest
        shift = 0
        for entry in entries:
            if not entry.is_dummy:
                sign = 1 << entry.bits - 1 if entry.signed else 0
                self._fields.append((shift, (1 << entry.bits) - 1, sign, -sign))
            shift += entry.bits

    def pack(self, *values: int) -> bytes:
        if len(values) != len(self._fields):
            raise struct.error(f"expected {len(self._fields)} values")
        word = 0
        for value, (shift, mask, sign, lowest) in zip(values, self._fields, strict=True):
            if not lowest <= value <= mask + lowest:
                raise struct.error(f"{value} does not fit {lowest}..{mask + lowest} (sign bit {sign:#x})")
            word |= (int(value) & mask) << shift
        return word.to_bytes(self._length, "little")

    def unpack(self, data: bytes) -> tuple[int, ...]:
        if len(data) != self._length:
            raise struct.error(f"expected {self._length} bytes")
        word = int.from_bytes(data, "little")
        return tuple(((word >> shift & mask) ^ sign) - sign for shift, mask, sign, _ in self._fields)


def is_mapping(index: int) -> bool:
    """Whether an index is that of the mapping parameters of a PDO."""
    return index in PDO_OBJECTS and bool(index & TO_MAPPING)


def _struct_format(entries: tuple[PdoEntry, ...], length: int) -> str | None:
    """The struct format of a byte-aligned mapping, filled up to `length`, or None where bits have to be moved."""
    codes = ["<"]
    for entry in entries:
        if entry.is_dummy and entry.bits % 8 == 0:
            codes.append(f"{entry.bits // 8}x")
        elif entry.bits in _STRUCT_CODES and not entry.is_dummy:
            code = _STRUCT_CODES[entry.bits]
            codes.append(code if entry.signed else code.upper())
        else:
            return None
    filler = length - struct.calcsize("".join(codes))
    return "".join(codes) + (f"{filler}x" if filler else "")


@dataclass(frozen=True, slots=True)
class PdoLayout:
    """One PDO: identifier, mapping and transmission type, compiled at construction.

    Values stand for `signals`, the entries that are not dummies, in their order: a dummy takes no value when
    packing (its bytes are zero) and gives none when unpacking.

    Attributes:
        cob_id: 11-bit identifier.
        entries: mapped objects, in the order of the wire.
        transmission_type: 0..240 synchronous, 252/253 by RTR, 254/255 by event (CiA 301).
        fd: whether the mapping may have up to 512 bits; above 64 the frame is one of CAN FD, filled up with zeros to a
            length that FD has.
        length: data bytes of the frame.
        raw_pack, raw_unpack: `pack` and `unpack` for callers that exclude errors or look into them later; they raise
            struct.error or TypeError, which names no PDO.

    Raises:
        ProtocolError: an entry has no length, or all together have more bits than a frame.
    """

    cob_id: int
    entries: tuple[PdoEntry, ...]
    transmission_type: int = 1
    fd: bool = False
    length: int = field(init=False)
    raw_pack: Callable[..., bytes] = field(init=False, repr=False, compare=False)
    raw_unpack: Callable[[bytes], tuple[int, ...]] = field(init=False, repr=False, compare=False)

    def __reduce__(self) -> tuple[type[PdoLayout], tuple[object, ...]]:
        """Pickle the arguments alone, as the compiled functions cannot go to another process."""
        return type(self), (self.cob_id, self.entries, self.transmission_type, self.fd)

    def __post_init__(self) -> None:
        entries = tuple(self.entries)
        bits = sum(entry.bits for entry in entries)
        most = MAX_FD_PDO_BITS if self.fd else MAX_PDO_BITS
        if any(not 1 <= entry.bits <= MAX_PDO_BITS for entry in entries) or bits > most:
            raise ProtocolError(
                f"PDO {self.cob_id:#05x}: mapping of {bits} bits; expected at most {most}, and none without a length"
            )
        length = next(size for size in FD_LENGTHS if 8 * size >= bits)
        form = _struct_format(entries, length)
        codec = _BitCodec(entries, length) if form is None else struct.Struct(form)
        object.__setattr__(self, "entries", entries)
        object.__setattr__(self, "length", length)
        object.__setattr__(self, "raw_pack", codec.pack)
        object.__setattr__(self, "raw_unpack", codec.unpack)

    @property
    def synchronous(self) -> bool:
        """Whether its content acts, or is sampled, at a SYNC."""
        return self.transmission_type <= MAX_SYNC_TYPE

    @property
    def signals(self) -> tuple[PdoEntry, ...]:
        """The entries that carry a value, in the order of `pack` and `unpack`."""
        return tuple(entry for entry in self.entries if not entry.is_dummy)

    def pack(self, *values: int) -> bytes:
        """Pack one value per signal.

        Raises:
            ProtocolError: the number of values is wrong, or a value does not fit its entry.
        """
        try:
            return self.raw_pack(*values)
        except (struct.error, TypeError) as error:
            raise ProtocolError(f"PDO {self.cob_id:#05x}: cannot pack {values}: {error}") from None

    def unpack(self, data: bytes) -> tuple[int, ...]:
        """Unpack exactly `length` bytes into one value per signal.

        Raises:
            ProtocolError: the data have another length. (A slave accepts longer RPDOs: cut them before.)
        """
        try:
            return self.raw_unpack(data)
        except struct.error:
            raise ProtocolError(f"PDO {self.cob_id:#05x}: expected {self.length} bytes, got {len(data)}") from None
