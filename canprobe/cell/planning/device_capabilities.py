"""Capabilities of a device by its EDS: objects, PDOs, mapping, dummies, identity; and what it lacks as a node."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from canprobe.cell.planning.model import EVERY_SYNC
from canprobe.cell.planning.node_configuration import Direction, Identity, NodeKind
from canprobe.cell.scene.setup import Setup
from canprobe.fieldbus.eds.description import Description
from canprobe.fieldbus.eds.packaged import load_eds
from canprobe.fieldbus.protocol.frames import INVALID_FLAG
from canprobe.fieldbus.protocol.pdo import PdoEntry

COMMUNICATION: dict[Direction, int] = {"rpdo": 0x1400, "tpdo": 0x1800}
MAPPING: dict[Direction, int] = {"rpdo": 0x1600, "tpdo": 0x1A00}
OWN_BITS = 0x6000_0000
"""Bits 29 and 30 of a COB-ID, which the device sets: the frame format, and that it answers no remote frame (RTR)."""
MOST_ENTRIES = 64
_MOST_AXES = 8
_IDENTIFIER = 0x7FF


@dataclass(frozen=True, slots=True)
class DeviceCapabilities:
    """Capabilities of one device as a node of the cell, by its EDS.

    Attributes:
        eds: its name or path, for messages.
        description: the content of the EDS.
    """

    eds: str
    description: Description

    @classmethod
    def of(cls, eds: str, node_id: int) -> DeviceCapabilities:
        """Read an EDS.

        Raises:
            EdsError: when the EDS is missing or not usable.
        """
        return cls(eds, Description(load_eds(eds, node_id)))

    @property
    def od(self) -> Any:
        """Object dictionary of the package canopen."""
        return self.description.od

    @property
    def identity(self) -> Identity:
        """Vendor, product and revision of 1018h; None where the file states none, or the 0 of a field left empty."""
        return Identity(*(self.number(0x1018, subindex) or None for subindex in (1, 2, 3)))

    def has(self, index: int, subindex: int = 0) -> bool:
        """Whether the object exists."""
        return self.description.entry(index, subindex) is not None

    @property
    def axes(self) -> tuple[int, ...]:
        """Axes of a drive, counted from 1: their controlwords are in the EDS, 800h apart. Source: CiA 402-1."""
        return tuple(axis for axis in range(1, _MOST_AXES + 1) if self.has(0x6040 + 0x800 * (axis - 1)))

    def number(self, index: int, subindex: int = 0) -> int | None:
        """The integer that the entry holds at boot; None where it is missing or not stated."""
        entry = self.description.entry(index, subindex)
        return entry.initial if entry is not None and isinstance(entry.initial, int) else None

    def takes(self, index: int, subindex: int, value: int) -> bool:
        """Whether the entry holds a value at boot, or can be given it."""
        entry = self.description.entry(index, subindex)
        return entry is not None and (entry.initial == value or (entry.writable and entry.allows(value)))

    def entry(self, index: int, subindex: int, direction: Direction) -> PdoEntry | None:
        """The object as a mapping entry, None where the device cannot map it in this direction."""
        entry = self.description.entry(index, subindex)
        if entry is None or not (entry.in_tpdo if direction == "tpdo" else entry.in_rpdo):
            return None
        return PdoEntry(index, subindex, entry.pdo_bits, entry.signed, entry.name)

    def dummy(self, data_type: int, bits: int) -> PdoEntry | None:
        """A dummy entry, None where DummyUsage does not allow it."""
        return PdoEntry(data_type, 0, bits, name="dummy") if data_type in self.description.dummies else None

    def pdo_numbers(self, direction: Direction) -> tuple[int, ...]:
        """Numbers of the PDOs that the device has, 1 for 1400h or 1800h."""
        numbers = self.description.rpdos if direction == "rpdo" else self.description.tpdos
        return tuple(number for number in numbers if self.has(MAPPING[direction] + number - 1))

    @property
    def switchable_pdos(self) -> list[tuple[Direction, int]]:
        """The PDOs that can be switched off."""
        has = [(direction, number) for direction in COMMUNICATION for number in self.pdo_numbers(direction)]
        return [one for one in has if self.fixed_cob_id(*one) is None]

    def capacity(self, direction: Direction, number: int) -> int:
        """Number of objects that may be mapped to a PDO; 0: its mapping is fixed."""
        index = MAPPING[direction] + number - 1
        count = self.description.entry(index)
        if count is None or not count.writable:
            return 0
        entries = (self.description.entry(index, subindex) for subindex in range(1, MOST_ENTRIES + 1))
        return sum(1 for _ in itertools.takewhile(lambda entry: entry is not None and entry.writable, entries))

    def fixed_mapping(self, direction: Direction, number: int) -> tuple[int, ...]:
        """The mapping that the EDS gives as default."""
        index = MAPPING[direction] + number - 1
        return tuple(self.number(index, sub) or 0 for sub in range(1, (self.number(index) or 0) + 1))

    def mapped_entry(self, word: int) -> PdoEntry:
        """An object of a fixed mapping, whether the EDS calls it mappable or not."""
        entry = self.description.entry(word >> 16, word >> 8 & 0xFF)
        return PdoEntry.from_word(word, entry is not None and entry.signed, entry.name if entry is not None else "")

    def can_cycle(self, direction: Direction, number: int) -> bool:
        """Whether a PDO exists or can be switched on, and follows every SYNC or can be made to."""
        index = COMMUNICATION[direction] + number - 1
        cob_id = self.description.entry(index, 1)
        off = cob_id is None or (not cob_id.writable and (self.number(index, 1) or INVALID_FLAG) & INVALID_FLAG)
        return not off and self.takes(index, 2, EVERY_SYNC)

    def fixed_cob_id(self, direction: Direction, number: int) -> int | None:
        """The identifier of a PDO that exists and whose COB-ID cannot be changed; None where it can."""
        index = COMMUNICATION[direction] + number - 1
        entry, value = self.description.entry(index, 1), self.number(index, 1)
        if entry is None or entry.writable or value is None or value & INVALID_FLAG:
            return None
        return value & _IDENTIFIER

    def own_bits(self, direction: Direction, number: int) -> int:
        """Bits 29 and 30 of the COB-ID of a PDO."""
        return (self.number(COMMUNICATION[direction] + number - 1, 1) or 0) & OWN_BITS


_EVERY_NODE: Mapping[int, str] = {
    0x1000: "device type",
    0x1005: "COB-ID of SYNC",
    0x1017: "producer heartbeat",
    0x1018: "identity",
}
SECTIONS: Mapping[NodeKind, str] = {"drive": "arm", "tactile": "sensor", "encoder": "carrier"}
"""Sections of a scene that name the EDS files."""
_OF_KIND: Mapping[NodeKind, Mapping[int, str]] = {
    "drive": {
        0x6040: "controlword",
        0x6041: "statusword",
        0x6060: "modes of operation",
        0x6061: "modes of operation display",
        0x6064: "position actual value",
    },
    "tactile": {0x2000: "tactile mode"},
    "encoder": {0x6004: "position value"},
}


def lacks(device: DeviceCapabilities, kind: NodeKind, setup: Setup) -> Iterator[str]:
    """One line for every object that the EDS lacks, and for a bit rate that is not among those which it lists."""
    for index, what in {**_EVERY_NODE, **_OF_KIND[kind]}.items():
        if index not in device.od.indices:
            yield (
                f"{SECTIONS[kind]}.eds = {device.eds}: object {index:04X}h ({what}) is missing; scene {setup.name}"
                " needs it"
            )
    bitrates = device.description.bitrates
    if bitrates and setup.bus.bitrate not in bitrates:
        has = ", ".join(map(str, bitrates))
        yield f"bus.bitrate = {setup.bus.bitrate}: {SECTIONS[kind]}.eds = {device.eds} has {has} bit/s"
