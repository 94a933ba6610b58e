"""What may be written to PDO communication and mapping parameters, and when.

Source: CiA 301, objects 1400h–1BFFh (RPDO and TPDO communication and mapping parameter), "PDO mapping".
"""

from __future__ import annotations

from dataclasses import dataclass

from canprobe.eds import LONG_PDOS, LONG_PDOS_NAME
from canprobe.emulator.aborts import Abort, SdoAbort
from canprobe.emulator.dictionary import Dictionary
from canprobe.emulator.entries import Entry, Value, key_of
from canprobe.protocol.frames import is_restricted
from canprobe.protocol.pdo import FD_MAX_BITS, MAX_BITS, PdoEntry

INVALID = 1 << 31
COB_ID, TYPE, INHIBIT, EVENT, START = 1, 2, 3, 5, 6
_UNUSED_BITS = 0x3FFFF800  # reserved, 29-bit frame, upper 18 bits of its identifier
_RESERVED_RPDO = range(0xF1, 0xFE)
_RESERVED_TPDO = range(0xF1, 0xFC)
DUMMIES = range(0x0001, 0x0008)


@dataclass(frozen=True, slots=True)
class PdoRules:
    """Rules of one PDO.

    Attributes:
        dictionary: the node's.
        communication, mapping: indices of its two parameter records.
        transmits: TPDO or RPDO.
    """

    dictionary: Dictionary
    communication: int
    mapping: int
    transmits: bool

    @property
    def valid(self) -> bool:
        """Whether the PDO exists now (bit 31 of its COB-ID is 0)."""
        return not self.dictionary.number(self.communication, COB_ID, INVALID) & INVALID

    @property
    def long(self) -> bool:
        """Whether PDOs of up to 64 bytes were switched on, in a device that has them."""
        entry = self.dictionary.entries.get(key_of(LONG_PDOS, 0)) if self.transmits else None
        return entry is not None and entry.name == LONG_PDOS_NAME and bool(self.dictionary.number(LONG_PDOS))

    def check_communication(self, subindex: int, value: Value) -> None:
        """Raises SdoAbort for a value that the standard forbids now."""
        new, old = int(value), self.dictionary.number(self.communication, subindex)
        if subindex == COB_ID:
            self._check_cob_id(new, old)
        elif subindex == TYPE:
            if new in (_RESERVED_TPDO if self.transmits else _RESERVED_RPDO):
                raise SdoAbort(Abort.VALUE)
        elif subindex in (INHIBIT, START):
            too_big = subindex == START and new > 240
            if too_big or (self.valid and new != old):
                raise SdoAbort(Abort.VALUE)

    def _check_cob_id(self, new: int, old: int) -> None:
        stays_valid = not (new | old) & INVALID
        if new & _UNUSED_BITS or (stays_valid and (new ^ old) & 0x7FF):
            raise SdoAbort(Abort.VALUE)
        if not new & INVALID and is_restricted(new & 0x7FF):
            raise SdoAbort(Abort.VALUE)

    def check_mapping(self, subindex: int, value: Value) -> None:
        """Raises SdoAbort for a mapping that cannot be, or cannot be changed now."""
        new, old = int(value), self.dictionary.number(self.mapping, subindex)
        if new == old:
            return
        if self.valid or (subindex and self.dictionary.number(self.mapping, 0)):
            raise SdoAbort(Abort.UNSUPPORTED_ACCESS)
        if subindex == 0:
            self.entries(new)
        elif new:
            self.entry(new)

    def entries(self, count: int | None = None) -> tuple[PdoEntry, ...]:
        """The first `count` mapped entries (all: None). Raises SdoAbort when they do not make a PDO."""
        total = self.dictionary.number(self.mapping, 0) if count is None else count
        if total and key_of(self.mapping, total) not in self.dictionary:
            raise SdoAbort(Abort.MAPPING_LENGTH)
        found = tuple(self.entry(self.dictionary.number(self.mapping, sub)) for sub in range(1, total + 1))
        if sum(entry.bits for entry in found) > (FD_MAX_BITS if self.long else MAX_BITS):
            raise SdoAbort(Abort.MAPPING_LENGTH)
        return found

    def entry(self, word: int) -> PdoEntry:
        """One mapping word. Raises SdoAbort when its object does not exist, may not be mapped or has another length."""
        target = self.dictionary.entries.get(word >> 8)
        if target is None or not self._mappable(target) or target.bits != word & 0xFF:
            raise SdoAbort(Abort.NOT_MAPPABLE)
        return PdoEntry.from_word(word, target.signed, target.name)

    def _mappable(self, target: Entry) -> bool:
        if target.real or not target.bits:
            return False
        return target.in_tpdo if self.transmits else target.in_rpdo
