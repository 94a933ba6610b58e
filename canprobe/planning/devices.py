"""What the devices can, read from their EDS files, and the PDOs that a scene maps on them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from canprobe.eds.packaged import has_long_pdos, has_window_size, load_eds
from canprobe.planning.model import Direction, Identity, NodeKind, PlannedPdo, SyncPlan
from canprobe.planning.traffic import frame_bits
from canprobe.protocol.frames import is_restricted
from canprobe.protocol.pdo import PdoEntry, PdoLayout
from canprobe.protocol.tactile import WINDOW, window_words
from canprobe.scene.setup import Array, Setup

# What a device can, read from its EDS: objects, PDOs, mapping, dummies, identity.

_COMMUNICATION: dict[Direction, int] = {"rpdo": 0x1400, "tpdo": 0x1800}
_MAPPING: dict[Direction, int] = {"rpdo": 0x1600, "tpdo": 0x1A00}
_SIGNED_TYPES = (0x02, 0x03, 0x04, 0x10, 0x12, 0x13, 0x14, 0x15)


@dataclass(frozen=True, slots=True)
class Abilities:
    """One device as its EDS describes it.

    Attributes:
        eds: name or path, for messages.
        od: canopen's object dictionary.
    """

    eds: str
    od: Any

    @classmethod
    def of(cls, eds: str, node_id: int) -> Abilities:
        """Read an EDS.

        Raises:
            EdsError: when it is missing or not usable.
        """
        return cls(eds, load_eds(eds, node_id))

    @property
    def identity(self) -> Identity:
        """Vendor, product and revision of 1018h."""
        return Identity(*(self._default(0x1018, subindex) for subindex in (1, 2, 3)))

    @property
    def bitrates(self) -> tuple[int, ...]:
        """Bit rates that it has, bit/s; empty where its EDS lists none."""
        return tuple(sorted(self.od.device_information.allowed_baudrates))

    def has(self, index: int, subindex: int = 0) -> bool:
        """Whether the object exists."""
        return self._variable(index, subindex) is not None

    def entry(self, index: int, subindex: int, direction: Direction) -> PdoEntry | None:
        """The object as a mapping entry, None where the device cannot map it in this direction."""
        variable = self._variable(index, subindex)
        if variable is None or not variable.pdo_mappable:
            return None
        allowed = ("ro", "rw", "rwr", "const") if direction == "tpdo" else ("wo", "rw", "rww")
        if variable.access_type not in allowed:
            return None
        return PdoEntry(index, subindex, len(variable), variable.data_type in _SIGNED_TYPES, variable.name)

    def dummy(self, data_type: int, bits: int) -> PdoEntry | None:
        """A dummy entry, None where DummyUsage does not allow it."""
        return PdoEntry(data_type, 0, bits, name="dummy") if data_type in self.od else None

    def pdo_numbers(self, direction: Direction) -> tuple[int, ...]:
        """Numbers of the PDOs that the device has, 1 for 1400h or 1800h."""
        base = _COMMUNICATION[direction]
        return tuple(number for number in range(1, 513) if base + number - 1 in self.od)

    def mapping_problem(self, direction: Direction, number: int, words: tuple[int, ...]) -> str | None:
        """Why this PDO cannot carry this mapping, None where it can."""
        index = _MAPPING[direction] + number - 1
        if _COMMUNICATION[direction] + number - 1 not in self.od or not self.has(index):
            return f"has no {direction.upper()}{number}"
        if self._variable(index, 0).access_type == "rw":
            capacity = self._highest(index)
            return None if len(words) <= capacity else f"{direction.upper()}{number} maps at most {capacity} objects"
        if self.fixed_mapping(direction, number) != words:
            fixed = ", ".join(f"{word:08X}h" for word in self.fixed_mapping(direction, number))
            return f"{direction.upper()}{number} has the fixed mapping {fixed or 'none'}"
        return None

    def fixed_mapping(self, direction: Direction, number: int) -> tuple[int, ...]:
        """The mapping that the EDS gives as default."""
        index = _MAPPING[direction] + number - 1
        return tuple(self._default(index, sub) or 0 for sub in range(1, (self._default(index, 0) or 0) + 1))

    def _default(self, index: int, subindex: int) -> int | None:
        variable = self._variable(index, subindex)
        value = None if variable is None else variable.default
        return value if isinstance(value, int) else None

    def _variable(self, index: int, subindex: int) -> Any:
        if index not in self.od:
            return None
        found = self.od[index]
        if not hasattr(found, "subindices"):
            return found if subindex == 0 else None
        return found[subindex] if subindex in found.subindices or 0 < subindex <= self._highest(index) else None

    def _highest(self, index: int) -> int:
        """Highest sub-index; an array may list only its first member and stand for all (CiA 306, CompactSubObj)."""
        found = self.od[index]
        listed: int = max(found.subindices, default=0)
        if type(found).__name__ != "ODArray" or 0 not in found.subindices:
            return listed
        return max(listed, min(found.subindices[0].default or 0, 254))


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
        0x607A: "target position",
        0x60C2: "interpolation time period",
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
        if index not in device.od
    ]


def missing_bitrate(device: Abilities, kind: NodeKind, setup: Setup) -> list[str]:
    """That the device does not have the bus's bit rate, where its EDS lists them."""
    if not device.bitrates or setup.bus.bitrate in device.bitrates:
        return []
    section = "arm" if kind == "drive" else "sensor"
    has = ", ".join(map(str, device.bitrates))
    return [f"bus.bitrate = {setup.bus.bitrate}: {section}.eds = {device.eds} has {has} bit/s"]


# Identifiers of PDOs in the order of their deadlines, and what is wrong with a set of them.
#
# The bus gives way to the lower identifier. With priorities in the order of the deadlines a message that can wait never
# stands before one that cannot. Source: Davis et al. 2007 (priority assignment); restricted identifiers: CiA 301.

_POOL = range(0x181, 0x580)
"""Identifiers below SYNC, emergencies and TIME and above SDO and heartbeats; restricted ones are left out."""


def order_by_deadline(pdos: Sequence[PlannedPdo]) -> list[PlannedPdo]:
    """The same PDOs with identifiers in the order of their deadlines.

    At equal deadlines feedback has priority over commands; otherwise the order stays. An RPDO that several drives read
    keeps one identifier.
    """
    free = (cob_id for cob_id in _POOL if not is_restricted(cob_id))
    first = {pdo.cob_id: pdo for pdo in reversed(pdos)}
    ordered = sorted(first.values(), key=lambda pdo: (pdo.deadline_ns, pdo.direction == "rpdo", pdo.cob_id))
    chosen = {pdo.cob_id: cob_id for pdo, cob_id in zip(ordered, free, strict=False)}
    return [
        replace(pdo, layout=PdoLayout(chosen[pdo.cob_id], pdo.entries, pdo.transmission_type, fd=pdo.layout.fd))
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


# Which PDOs a scene needs, with the default identifiers of the cell, as far as the devices' EDS files allow.

STATUSWORD, CONTROLWORD = (0x6041, 0), (0x6040, 0)
POSITION, TARGET_POSITION = (0x6064, 0), (0x607A, 0)
TORQUE = (0x6077, 0)
DUMMY_INTEGER32 = 0x0004

DRIVE_TPDO1, DRIVE_RPDO1, DRIVE_RPDO2 = 0x180, 0x200, 0x300
TACTILE_TPDO1 = 0x511  # 180h + 16 would beat every RPDO; below them all it waits for none of the drives' frames
TACTILE_DEADLINE_CYCLES = 2
RESENT_MS, LOST_MS = 100, 250
"""How often a PDO that is sent on a change comes at the slowest, and when its receiver takes it for lost."""
EVERY_SYNC = 1
ON_EVENT = 255

HEADER, WINDOW_TAXELS, IMAGE_TAXELS, FEATURES = (0x2120, 0), 0x2110, 0x2100, 0x2130
IMAGE_WORDS = 32
FD_WORDS = (8, 6, 4, 3, 2, 1)
"""Objects of 8 bytes that fill a CAN FD frame without a byte left over."""


@dataclass(slots=True)
class PdoPlanning:
    """PDOs found so far, with what was wrong and what a device could not give.

    Attributes:
        setup: of the scene.
        sync: the cycle.
        devices: what each node can.
    """

    setup: Setup
    sync: SyncPlan
    devices: Mapping[int, Abilities]
    pdos: list[PlannedPdo] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    not_available: list[tuple[str, str]] = field(default_factory=list)

    def entries(self, node_id: int, direction: Direction, *objects: tuple[int, int]) -> list[PdoEntry]:
        """The objects as entries; what the device cannot map becomes a problem."""
        device, found = self.devices[node_id], []
        for index, subindex in objects:
            entry = device.entry(index, subindex, direction)
            if entry is None:
                why = f"is not mappable to a {direction.upper()}" if device.has(index, subindex) else "is missing"
                self.problems.append(f"node {node_id}: {device.eds}: object {index:04X}h:{subindex:02X} {why}")
            else:
                found.append(entry)
        return found

    def add(
        self,
        node_id: int,
        direction: Direction,
        number: int,
        layout: PdoLayout,
        *,
        kind: NodeKind = "drive",
        cycles: int = 1,
    ) -> None:
        """Take a PDO if the device can have it; one that SYNC triggers has `cycles` cycles to get through."""
        device = self.devices[node_id]
        problem = device.mapping_problem(direction, number, layout.mapping_words())
        if problem is not None:
            wanted = ", ".join(f"{entry.index:04X}h:{entry.subindex:02X}" for entry in layout.entries)
            self.problems.append(
                f"node {node_id}: {device.eds} {problem}; needed: {wanted}; use a device or an EDS that can map it"
            )
            return
        on_event = layout.transmission_type == ON_EVENT
        self.pdos.append(
            PlannedPdo(
                node_id=node_id,
                direction=direction,
                number=number,
                layout=layout,
                rate_hz=1000 / RESENT_MS if on_event else self.sync.rate_hz / layout.transmission_type,
                bits_worst=frame_bits(layout.length, self.setup.bus),
                deadline_ns=RESENT_MS * 1_000_000 if on_event else cycles * self.sync.period_ns,
                event_timer_ms=LOST_MS if on_event else 0,
                kind=kind,
            )
        )


def plan_drive_pdos(planning: PdoPlanning) -> None:
    """Feedback and targets of the drives: one PDO each way, or two targets sharing one RPDO."""
    arm, devices = planning.setup.arm, planning.devices
    if arm is None:
        return
    for node_id in arm.node_ids:
        _plan_feedback(planning, node_id)
    without = [devices[node_id].eds for node_id in arm.node_ids if devices[node_id].dummy(DUMMY_INTEGER32, 32) is None]
    for eds in without if arm.grouped else ():
        why = f"{eds}: DummyUsage excludes {DUMMY_INTEGER32:04X}h, so each drive keeps its own target RPDO"
        planning.not_available.append(("two targets in one RPDO", why))
    for axis, node_id in enumerate(arm.node_ids):
        if not arm.grouped or without:
            entries = planning.entries(node_id, "rpdo", CONTROLWORD, TARGET_POSITION)
            planning.add(node_id, "rpdo", 1, PdoLayout(DRIVE_RPDO1 + node_id, tuple(entries), EVERY_SYNC))
            continue
        # the controlword alone on change and again every 100 ms; the target in this drive's half of its pair's RPDO, a
        # dummy in the half of the other, whose first drive owns the identifier
        entries = planning.entries(node_id, "rpdo", CONTROLWORD)
        planning.add(node_id, "rpdo", 1, PdoLayout(DRIVE_RPDO1 + node_id, tuple(entries), ON_EVENT))
        first = arm.node_ids[axis - axis % 2]
        entries, dummy = planning.entries(node_id, "rpdo", TARGET_POSITION), devices[node_id].dummy(DUMMY_INTEGER32, 32)
        if entries and dummy is not None:
            halves = (*entries, dummy) if node_id == first else (dummy, *entries)
            planning.add(node_id, "rpdo", 2, PdoLayout(DRIVE_RPDO2 + first, halves, EVERY_SYNC))


def _plan_feedback(planning: PdoPlanning, node_id: int) -> None:
    """Statusword and position, and the torque where the device can send it too."""
    device = planning.devices[node_id]
    entries = planning.entries(node_id, "tpdo", STATUSWORD, POSITION)
    torque = device.entry(*TORQUE, "tpdo")
    problem: str | None = f"6077h is {'not mappable to a TPDO' if device.has(*TORQUE) else 'missing'}"
    if torque is not None:
        problem = device.mapping_problem("tpdo", 1, tuple(entry.word for entry in (*entries, torque)))
    if problem is not None:
        planning.not_available.append(("motor torque (torque_permille of log.npz)", f"{device.eds}: {problem}"))
    elif torque is not None:
        entries.append(torque)
    planning.add(node_id, "tpdo", 1, PdoLayout(DRIVE_TPDO1 + node_id, tuple(entries), EVERY_SYNC))


def plan_tactile_pdos(planning: PdoPlanning, ratio: int) -> None:
    """Header and payload of a tactile frame, all triggered by every `ratio`-th SYNC."""
    array, fd = planning.setup.array, planning.setup.bus.fd
    if array is None:
        return
    device = planning.devices[array.node_id]
    long = fd and has_long_pdos(device.od)
    if fd and not long:
        why = f"{device.eds} has no PDOs of up to 64 bytes (2007h); tactile_array_fd.eds is of an array that has"
        planning.not_available.append(("CAN FD frames from the sensor", why))
    if array.mode == "window" and not has_window_size(device.od):
        why = f"{device.eds} has no window size (2008h), so the window keeps {WINDOW}×{WINDOW} taxels"
        planning.not_available.append(("another window", why))
        if array.window != WINDOW:
            planning.problems.append(f"node {array.node_id}: {why}: sensor.window = {WINDOW}, not {array.window}")
    header, *rest = tactile_objects(array)
    parcels = [[header]]  # the header alone, then an object each, or as many as 64 bytes hold
    while rest:
        size = next(words for words in FD_WORDS if words <= len(rest)) if long else 1
        parcels.append(rest[:size])
        rest = rest[size:]
    for number, objects in enumerate(parcels, start=1):
        if entries := planning.entries(array.node_id, "tpdo", *objects):
            layout = PdoLayout(TACTILE_TPDO1 + number - 1, tuple(entries), ratio, fd=long)
            cycles = min(TACTILE_DEADLINE_CYCLES, ratio)
            planning.add(array.node_id, "tpdo", number, layout, kind="tactile", cycles=cycles)


def tactile_objects(array: Array) -> tuple[tuple[int, int], ...]:
    """The objects of a tactile frame, its header first."""
    if array.mode == "features":
        return (FEATURES, 1), (FEATURES, 2)
    if array.mode == "image":
        return HEADER, *((IMAGE_TAXELS, half) for half in range(1, IMAGE_WORDS + 1))
    return HEADER, *((WINDOW_TAXELS, word) for word in range(1, window_words(int(array.window)) + 1))
