"""What the devices can, read from their EDS files, and the identifiers of their PDOs."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from canprobe.cell.planning.model import EVERY_SYNC, Direction, Identity, NodeKind, PlannedPdo
from canprobe.cell.scene.setup import Setup
from canprobe.fieldbus.eds.description import Description
from canprobe.fieldbus.eds.packaged import load_eds
from canprobe.fieldbus.protocol.frames import is_restricted
from canprobe.fieldbus.protocol.pdo import PdoEntry, PdoLayout

# What a device can, read from its EDS: objects, PDOs, mapping, dummies, identity.

COMMUNICATION: dict[Direction, int] = {"rpdo": 0x1400, "tpdo": 0x1800}
MAPPING: dict[Direction, int] = {"rpdo": 0x1600, "tpdo": 0x1A00}
INVALID = 1 << 31
"""Of a COB-ID: the PDO is off."""
OWN_BITS = 0x6000_0000
"""Bits 29 and 30 of a COB-ID, which are the device's: its frame format, and that it sends nothing on request (RTR)."""
MOST_ENTRIES = 64
_MOST_AXES = 8
_IDENTIFIER = 0x7FF


@dataclass(frozen=True, slots=True)
class Abilities:
    """What one device can as a node of the cell, by its description.

    Attributes:
        eds: name or path, for messages.
        description: what its EDS states.
    """

    eds: str
    description: Description

    @classmethod
    def of(cls, eds: str, node_id: int) -> Abilities:
        """Read an EDS.

        Raises:
            EdsError: when it is missing or not usable.
        """
        return cls(eds, Description(load_eds(eds, node_id)))

    @property
    def od(self) -> Any:
        """canopen's object dictionary."""
        return self.description.od

    @property
    def identity(self) -> Identity:
        """Vendor, product and revision of 1018h; None where the file states none, or 0 as nobody filled it in."""
        return Identity(*(self.number(0x1018, subindex) or None for subindex in (1, 2, 3)))

    def has(self, index: int, subindex: int = 0) -> bool:
        """Whether the object exists."""
        return self.description.entry(index, subindex) is not None

    @property
    def axes(self) -> tuple[int, ...]:
        """Axes of a drive from 1: those whose controlword is described, 800h apart. Source: CiA 402-1."""
        return tuple(axis for axis in range(1, _MOST_AXES + 1) if self.has(0x6040 + 0x800 * (axis - 1)))

    def number(self, index: int, subindex: int = 0) -> int | None:
        """The integer that the entry holds at boot; None where it is missing or not stated."""
        entry = self.description.entry(index, subindex)
        return entry.initial if entry is not None and isinstance(entry.initial, int) else None

    def entry(self, index: int, subindex: int, direction: Direction) -> PdoEntry | None:
        """The object as a mapping entry, None where the device cannot map it in this direction."""
        entry = self.description.entry(index, subindex)
        if entry is None or not (entry.in_tpdo if direction == "tpdo" else entry.in_rpdo):
            return None
        return PdoEntry(index, subindex, entry.bits, entry.signed, entry.name)

    def dummy(self, data_type: int, bits: int) -> PdoEntry | None:
        """A dummy entry, None where DummyUsage does not allow it."""
        return PdoEntry(data_type, 0, bits, name="dummy") if data_type in self.description.dummies else None

    def pdo_numbers(self, direction: Direction) -> tuple[int, ...]:
        """Numbers of the PDOs that the device has, 1 for 1400h or 1800h."""
        numbers = self.description.rpdos if direction == "rpdo" else self.description.tpdos
        return tuple(number for number in numbers if self.has(MAPPING[direction] + number - 1))

    def capacity(self, direction: Direction, number: int) -> int:
        """How many objects may be mapped to a PDO; 0: its mapping is fixed."""
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
        cob_id, kind = self.description.entry(index, 1), self.description.entry(index, 2)
        off = cob_id is None or (not cob_id.writable and (self.number(index, 1) or INVALID) & INVALID)
        return (
            not off and kind is not None and (kind.initial == EVERY_SYNC or (kind.writable and kind.allows(EVERY_SYNC)))
        )

    def fixed_cob_id(self, direction: Direction, number: int) -> int | None:
        """The identifier of a PDO that exists and whose COB-ID cannot be changed; None where it can."""
        index = COMMUNICATION[direction] + number - 1
        entry, value = self.description.entry(index, 1), self.number(index, 1)
        if entry is None or entry.writable or value is None or value & INVALID:
            return None
        return value & _IDENTIFIER

    def own_bits(self, direction: Direction, number: int) -> int:
        """Bits 29 and 30 of the COB-ID of a PDO."""
        return (self.number(COMMUNICATION[direction] + number - 1, 1) or 0) & OWN_BITS


# What a device cannot take its part without: objects, with what they are needed for, and the bus's bit rate.

_EVERY_NODE: Mapping[int, str] = {
    0x1000: "device type",
    0x1005: "COB-ID of SYNC",
    0x1017: "producer heartbeat",
    0x1018: "identity",
}
_OF_KIND: Mapping[NodeKind, Mapping[int, str]] = {
    "drive": {
        0x6040: "controlword",
        0x6041: "statusword",
        0x6060: "modes of operation",
        0x6061: "modes of operation display",
        0x6064: "position actual value",
    },
    "tactile": {0x2000: "tactile mode"},
}


def missing_objects(device: Abilities, kind: NodeKind, setup: Setup) -> list[str]:
    """One line for every object that the EDS lacks."""
    needed = {**_EVERY_NODE, **_OF_KIND[kind]}
    section = "arm" if kind == "drive" else "sensor"
    return [
        f"{section}.eds = {device.eds}: object {index:04X}h ({what}) is missing; scene {setup.name} needs it"
        for index, what in needed.items()
        if index not in device.od.indices
    ]


def missing_bitrate(device: Abilities, kind: NodeKind, setup: Setup) -> list[str]:
    """That the device does not have the bus's bit rate, where its EDS lists them."""
    bitrates = device.description.bitrates
    if not bitrates or setup.bus.bitrate in bitrates:
        return []
    section = "arm" if kind == "drive" else "sensor"
    has = ", ".join(map(str, bitrates))
    return [f"bus.bitrate = {setup.bus.bitrate}: {section}.eds = {device.eds} has {has} bit/s"]


# Identifiers of PDOs in the order of their deadlines, and what is wrong with a set of them.
#
# The bus gives way to the lower identifier. With priorities in the order of the deadlines a message that can wait never
# stands before one that cannot. Source: Davis et al. 2007 (priority assignment); restricted identifiers: CiA 301.

_POOL = range(0x181, 0x580)
"""Identifiers below SYNC, emergencies and TIME and above SDO and heartbeats; restricted ones are left out."""


def order_by_deadline(pdos: Sequence[PlannedPdo], devices: Iterable[Abilities] = ()) -> list[PlannedPdo]:
    """The same PDOs with identifiers in the order of their deadlines.

    At equal deadlines feedback has priority over commands; otherwise the order stays. An RPDO that several drives read
    keeps one identifier, and so does a PDO whose COB-ID cannot be changed.

    Args:
        pdos: of all nodes.
        devices: whose RPDOs may listen to an identifier for ever, which no other PDO gets then.
    """
    fixed = {pdo.cob_id for pdo in pdos if pdo.fixed_id}
    fixed |= {
        id_ for one in devices for n in one.pdo_numbers("rpdo") if (id_ := one.fixed_cob_id("rpdo", n)) is not None
    }
    free = (cob_id for cob_id in _POOL if not is_restricted(cob_id) and cob_id not in fixed)
    first = {pdo.cob_id: pdo for pdo in reversed(pdos) if not pdo.fixed_id}
    ordered = sorted(first.values(), key=lambda pdo: (pdo.deadline_ns, pdo.direction == "rpdo", pdo.cob_id))
    chosen = {pdo.cob_id: cob_id for pdo, cob_id in zip(ordered, free, strict=False)}
    return [
        pdo
        if pdo.fixed_id
        else replace(pdo, layout=PdoLayout(chosen[pdo.cob_id], pdo.entries, pdo.transmission_type, fd=pdo.layout.fd))
        for pdo in pdos
    ]


def identifier_problems(pdos: Iterable[PlannedPdo]) -> list[str]:
    """Restricted identifiers, and identifiers that two producers would send. Source: CiA 301.

    An RPDO's producer is the master, so several drives may read one; a TPDO's identifier belongs to its node alone.
    """
    problems, owners = [], dict[int, PlannedPdo]()
    for pdo in pdos:
        name = f"node {pdo.node_id} {pdo.direction.upper()}{pdo.number}"
        if is_restricted(pdo.cob_id):
            problems.append(f"{name}: COB-ID {pdo.cob_id:03X}h is restricted (CiA 301); choose another node id")
        other = owners.setdefault(pdo.cob_id, pdo)
        if other is not pdo and "tpdo" in (pdo.direction, other.direction):
            problems.append(
                f"{name}: COB-ID {pdo.cob_id:03X}h is used by node {other.node_id} "
                f"{other.direction.upper()}{other.number} too; choose other node ids"
            )
    return problems
