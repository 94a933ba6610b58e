"""Rules for writing PDO communication and mapping parameters.

Source: CiA 301, "PDO mapping", objects 1400h to 1BFFh.
"""

from __future__ import annotations

from dataclasses import dataclass

from canprobe.fieldbus.eds.packaged import LONG_PDOS
from canprobe.fieldbus.node.core import check_cob_id
from canprobe.fieldbus.node.dictionary import Dictionary, Value, key_of
from canprobe.fieldbus.protocol.frames import INVALID_FLAG, MAX_SYNC_COUNT
from canprobe.fieldbus.protocol.pdo import MAX_FD_PDO_BITS, MAX_PDO_BITS, TO_MAPPING, PdoEntry, PdoSub
from canprobe.fieldbus.protocol.sdo import Abort, SdoAbort

_RESERVED_RPDO_TYPES = range(0xF1, 0xFE)
_RESERVED_TPDO_TYPES = range(0xF1, 0xFC)


@dataclass(frozen=True, slots=True)
class PdoRules:
    """Rules of one PDO.

    Attributes:
        dictionary: dictionary of the node.
        communication: index of the communication parameters.
        transmits: whether it is a TPDO; else it is an RPDO.
    """

    dictionary: Dictionary
    communication: int
    transmits: bool

    @property
    def mapping(self) -> int:
        """Index of the mapping parameters."""
        return self.communication + TO_MAPPING

    @property
    def valid(self) -> bool:
        """Whether the PDO exists now: bit 31 of its COB-ID is 0."""
        return not self.dictionary.number(self.communication, PdoSub.COB_ID, INVALID_FLAG) & INVALID_FLAG

    @property
    def long(self) -> bool:
        """Whether the device has PDOs of up to 64 bytes, and they were switched on."""
        dictionary = self.dictionary
        return self.transmits and dictionary.has_known(LONG_PDOS) and bool(dictionary.number(LONG_PDOS))

    def check_communication(self, subindex: int, value: Value) -> None:
        """Check a communication parameter. Raises SdoAbort for a value that the standard forbids now."""
        new, old = int(value), self.dictionary.number(self.communication, subindex)
        if subindex == PdoSub.COB_ID:
            check_cob_id(new, old)
        elif subindex == PdoSub.TYPE:
            if new in (_RESERVED_TPDO_TYPES if self.transmits else _RESERVED_RPDO_TYPES):
                raise SdoAbort(Abort.VALUE)
        elif subindex in (PdoSub.INHIBIT_TIME, PdoSub.SYNC_START):
            too_big = subindex == PdoSub.SYNC_START and new > MAX_SYNC_COUNT
            if too_big or (self.valid and new != old):
                raise SdoAbort(Abort.VALUE)

    def check_mapping(self, subindex: int, value: Value) -> None:
        """Check a mapping parameter. Raises SdoAbort for a mapping that is impossible, or cannot be changed now."""
        new, old = int(value), self.dictionary.number(self.mapping, subindex)
        if new == old:
            return
        if self.valid or (subindex and self.dictionary.number(self.mapping, 0)):
            raise SdoAbort(Abort.UNSUPPORTED_ACCESS)
        if subindex == 0:
            self.entries(new)
        elif new:
            self.entry(new)

    def entries(self, count: int | None = None, fixed: bool = False) -> tuple[PdoEntry, ...]:
        """The first `count` mapped entries; None: all. Raises SdoAbort when they make no PDO."""
        total = self.dictionary.number(self.mapping, 0) if count is None else count
        if total and key_of(self.mapping, total) not in self.dictionary:
            raise SdoAbort(Abort.MAPPING_LENGTH)
        found = tuple(self.entry(self.dictionary.number(self.mapping, sub), fixed) for sub in range(1, total + 1))
        if sum(entry.bits for entry in found) > (MAX_FD_PDO_BITS if self.long else MAX_PDO_BITS):
            raise SdoAbort(Abort.MAPPING_LENGTH)
        return found

    def present(self) -> tuple[PdoEntry, ...]:
        """All mapped entries; empty where the mapping is impossible."""
        try:
            return self.entries(fixed=True)
        except SdoAbort:
            return ()

    def entry(self, word: int, fixed: bool = False) -> PdoEntry:
        """Entry of a mapping word. Raises SdoAbort when its object is missing, not mappable or of another length.

        A fixed mapping may hold any object, as an EDS often does not list as mappable what it maps.
        """
        target = self.dictionary.entries.get(word >> 8)
        mappable = target is not None and (fixed or (target.in_tpdo if self.transmits else target.in_rpdo))
        if target is None or not mappable or target.real or not target.fits_pdo(word & 0xFF):
            raise SdoAbort(Abort.NOT_MAPPABLE)
        return PdoEntry.from_word(word, target.signed, target.name)
