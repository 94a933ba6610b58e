"""What is known of the device under examination: its description, and what it answered before the first point."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from canprobe.fieldbus.bus.sdo import decode_text
from canprobe.fieldbus.eds.description import DescribedEntry, Description
from canprobe.fieldbus.eds.reading import is_drive
from canprobe.fieldbus.protocol.cia402 import STATUSWORD
from canprobe.fieldbus.protocol.frames import INVALID_FLAG
from canprobe.fieldbus.protocol.pdo import RPDOS, TO_MAPPING, TPDOS, is_mapping
from canprobe.fieldbus.protocol.sdo import Place
from canprobe.fieldbus.tools.conform.permits import WriteList
from canprobe.fieldbus.tools.conform.sdo_client import SdoClient
from canprobe.fieldbus.tools.reports.report import IDENTITY

DRIVE_PROFILE = 402
_AXIS_STEP = 0x800
_VARIABLES = (*range(0x1000, 0x1003), *range(0x1005, 0x100B), 0x100C, 0x100D, 0x1012, 0x1014, 0x1015, 0x1017, 0x1019)
_RECORDS = (0x1003, 0x1016, 0x1018, 0x1020, 0x1028, 0x1029, 0x1200, 0x1201)
TEXTS = (0x1008, 0x1009, 0x100A)
"""Device name, hardware version and software version."""
_MAX_ENTRIES = 64
_UNDESCRIBED_PDOS = 32
"""PDOs of each direction that are looked for where no EDS names them."""
_FACTS = dict(zip(IDENTITY, (*((0x1018, n) for n in range(1, 5)), *((index, 0) for index in TEXTS)), strict=True))


@dataclass(slots=True)
class ExaminedDevice:
    """The device.

    Attributes:
        node_id: its id.
        description: statements of its EDS; None without one.
        values: bytes of the entries that it gave, by entry.
        statuswords: indices of the statuswords of all axes, where it is a CiA 402 drive.
    """

    node_id: int
    description: Description | None = None
    values: dict[Place, bytes] = field(default_factory=dict)
    statuswords: list[int] = field(default_factory=list)

    def read_all(self, bench: SdoClient, written: WriteList) -> None:
        """Read the communication objects that the standard or the EDS names, and what the user lets be written."""
        for index in _VARIABLES:
            self._read(bench, (index, 0))
        for index in (*_RECORDS, *self._pdo_indices()):
            self._read_record(bench, index)
        for entry in self.entries():
            if entry.readable and not self.has(*entry.place) and (entry.index < 0x2000 or written.permits(entry.place)):
                self._read(bench, entry.place)
        if self.profile == DRIVE_PROFILE or (self.description is not None and is_drive(self.description.od)):
            for axis in range(8):
                index = STATUSWORD + axis * _AXIS_STEP
                if self._read(bench, (index, 0)) is None:
                    break
                self.statuswords.append(index)

    def _pdo_indices(self) -> list[int]:
        if self.description is not None:
            comm = [RPDOS[n - 1] for n in self.description.rpdos] + [TPDOS[n - 1] for n in self.description.tpdos]
        else:
            comm = [area[n] for area in (RPDOS, TPDOS) for n in range(_UNDESCRIBED_PDOS)]
        return [index for pdo in comm for index in (pdo, pdo + TO_MAPPING)]

    def _read_record(self, bench: SdoClient, index: int) -> None:
        if not (count := self._read(bench, (index, 0))):
            return
        if is_mapping(index):  # its sub-index 0 counts the entries in use only
            for subindex in range(1, _MAX_ENTRIES + 1):
                if self._read(bench, (index, subindex)) is None:
                    return
        for subindex in range(1, min(count[0], _MAX_ENTRIES) + 1):
            self._read(bench, (index, subindex))

    def _read(self, bench: SdoClient, place: Place) -> bytes | None:
        if place not in self.values and (value := bench.present(place)) is not None:
            entry = self.described(*place)
            size = 0 if entry is None else -(-entry.bits // 8)
            padded = size and len(value) > size and not any(value[size:])  # an answer without a size has four bytes
            self.values[place] = value[:size] if padded else value
        return self.values.get(place)

    def has(self, index: int, subindex: int = 0) -> bool:
        """Whether the device gave this entry."""
        return (index, subindex) in self.values

    def number(self, index: int, subindex: int = 0, default: int = 0) -> int:
        """The value that the device gave, as an unsigned number; the default where it gave none."""
        value = self.values.get((index, subindex))
        return default if value is None else int.from_bytes(value, "little")

    def entries(self) -> Iterator[DescribedEntry]:
        """The entries that the EDS describes, without dummies; none without an EDS."""
        if self.description is not None:
            yield from (entry for entry in self.description.entries() if entry.index >= 0x1000)

    def described(self, index: int, subindex: int = 0) -> DescribedEntry | None:
        """Description of an entry; None where there is no EDS or it does not describe it."""
        return None if self.description is None else self.description.entry(index, subindex)

    def writable(self, index: int, subindex: int = 0) -> bool:
        """Whether the entry is there and the EDS, if there is one, lets it be written."""
        entry = self.described(index, subindex)
        return self.has(index, subindex) and (entry is None or entry.writable)

    @property
    def profile(self) -> int:
        """Number of the device profile in 1000h, such as 402."""
        return self.number(0x1000) & 0xFFFF

    @property
    def is_drive(self) -> bool:
        """Whether it is a CiA 402 drive."""
        return bool(self.statuswords)

    def pdos(self, area: range) -> list[int]:
        """Indices of the communication parameters of the PDOs in an area."""
        return sorted(index for index, subindex in self.values if subindex == 1 and index in area)

    def valid_pdos(self, area: range) -> dict[int, int]:
        """Indices of the communication parameters of the valid PDOs in an area, by identifier."""
        return {cob_id: pdo for pdo in self.pdos(area) if (cob_id := self.cob_id(pdo)) is not None}

    def mapping(self, pdo: int) -> list[int]:
        """Mapped entries of a PDO, each index << 16 | subindex << 8 | bits."""
        return [self.number(pdo + TO_MAPPING, n) for n in range(1, self.number(pdo + TO_MAPPING) + 1)]

    def cob_id(self, pdo: int) -> int | None:
        """Identifier of a PDO; None while it is not valid."""
        value = self.number(pdo, 1, INVALID_FLAG)
        return None if value & INVALID_FLAG else value & 0x7FF

    def facts(self) -> dict[str, str]:
        """Identity of the device, as reports name it."""
        found = {name: self.values[place] for name, place in _FACTS.items() if place in self.values}
        return {
            name: f"{int.from_bytes(value, 'little'):#x}" if _FACTS[name][0] == 0x1018 else decode_text(value)
            for name, value in found.items()
        }

    @property
    def identity(self) -> str:
        """The numbers of 1018h as one text."""
        return ":".join(f"{self.number(0x1018, n):#x}" for n in (1, 2, 3, 4))
