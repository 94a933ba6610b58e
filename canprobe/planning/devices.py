"""What the devices can, read from their EDS files, and the PDOs that a scene maps on them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from canprobe.eds.packaged import has_long_pdos, has_window_size, load_eds
from canprobe.planning.model import Direction, Identity, NodeKind, PlannedPdo, SyncPlan
from canprobe.planning.traffic import frame_bits
from canprobe.protocol.frame_bits import worst_case_bits
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
    def has_long_pdos(self) -> bool:
        """Whether it can send PDOs of up to 64 bytes."""
        return has_long_pdos(self.od)

    @property
    def bitrates(self) -> tuple[int, ...]:
        """Bit rates that it has, bit/s; empty where its EDS tells none."""
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
        if number not in self.pdo_numbers(direction) or not self.has(index):
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
MOST_BITRATE = 1_000_000
"""Of classical CAN, bit/s: the most that an EDS file can list."""


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
    """That the device does not have the bus's bit rate, where its EDS tells which it has."""
    beyond = setup.bus.bitrate > MOST_BITRATE  # no scene file may say so: a study's bus that no CAN is
    if not device.bitrates or setup.bus.bitrate in device.bitrates or beyond:
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

    At one deadline feedback goes before commands, then as before. An RPDO that several drives read
    keeps one identifier.
    """
    free = (cob_id for cob_id in _POOL if not is_restricted(cob_id))
    first = {pdo.cob_id: pdo for pdo in reversed(pdos)}
    ordered = sorted(first.values(), key=lambda pdo: (pdo.deadline_ns, pdo.direction == "rpdo", pdo.cob_id))
    chosen = {pdo.cob_id: cob_id for pdo, cob_id in zip(ordered, free, strict=False)}
    return [_with_id(pdo, chosen[pdo.cob_id]) for pdo in pdos]


def _with_id(pdo: PlannedPdo, cob_id: int) -> PlannedPdo:
    layout = pdo.layout
    return replace(pdo, layout=PdoLayout(cob_id, layout.entries, layout.transmission_type, fd=layout.fd))


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
CONTROLWORD_RESENT_MS = 100
CONTROLWORD_LOST_MS = 250
EVERY_SYNC = 1
ON_EVENT = 255

HEADER, WINDOW_TAXELS, IMAGE_TAXELS, FEATURES = (0x2120, 0), 0x2110, 0x2100, 0x2130
IMAGE_WORDS = 32
FD_WORDS = (8, 6, 4, 3, 2, 1)
"""Objects of 8 bytes that fill a CAN FD frame without a byte left over."""


@dataclass(slots=True)
class PdoPlanning:
    """PDOs found so far, with what was wrong and what a device could not give."""

    pdos: list[PlannedPdo] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    not_available: list[tuple[str, str]] = field(default_factory=list)

    def add(self, device: Abilities, pdo: PlannedPdo) -> None:
        """Take a PDO if the device can have it."""
        problem = device.mapping_problem(pdo.direction, pdo.number, pdo.layout.mapping_words())
        if problem is not None:
            wanted = ", ".join(f"{entry.index:04X}h:{entry.subindex:02X}" for entry in pdo.entries)
            self.problems.append(
                f"node {pdo.node_id}: {device.eds} {problem}; needed: {wanted}; use a device or an EDS that can map it"
            )
        else:
            self.pdos.append(pdo)

    def entries(
        self, device: Abilities, node_id: int, direction: Direction, objects: Iterable[tuple[int, int]]
    ) -> list[PdoEntry]:
        """The objects as entries; what the device cannot map becomes a problem."""
        found = []
        for index, subindex in objects:
            entry = device.entry(index, subindex, direction)
            if entry is None:
                why = f"is not mappable to a {direction.upper()}" if device.has(index, subindex) else "is missing"
                self.problems.append(f"node {node_id}: {device.eds}: object {index:04X}h:{subindex:02X} {why}")
            else:
                found.append(entry)
        return found


def plan_drive_pdos(planning: PdoPlanning, setup: Setup, sync: SyncPlan, devices: Mapping[int, Abilities]) -> None:
    """Feedback and targets of six drives: one PDO each way, or two targets sharing one RPDO."""
    arm = setup.arm
    if arm is None:
        return
    for node_id in arm.node_ids:
        _plan_feedback(planning, node_id, sync, devices[node_id])
    grouped = arm.grouped and all(devices[node_id].dummy(DUMMY_INTEGER32, 32) for node_id in arm.node_ids)
    if arm.grouped and not grouped:
        eds = arm.drives[0].eds
        why = f"{eds}: DummyUsage excludes {DUMMY_INTEGER32:04X}h, so each drive keeps a target RPDO of its own"
        planning.not_available.append(("two targets in one RPDO", why))
    for axis, node_id in enumerate(arm.node_ids):
        if grouped:
            _plan_controlword(planning, node_id, devices[node_id])
            first = arm.node_ids[axis - axis % 2]
            _plan_shared_target(planning, node_id, first, sync, devices[node_id])
        else:
            objects = (CONTROLWORD, TARGET_POSITION)
            entries = planning.entries(devices[node_id], node_id, "rpdo", objects)
            layout = PdoLayout(DRIVE_RPDO1 + node_id, tuple(entries), EVERY_SYNC)
            planning.add(devices[node_id], _synchronous(node_id, "rpdo", 1, layout, sync))


def _plan_feedback(planning: PdoPlanning, node_id: int, sync: SyncPlan, device: Abilities) -> None:
    entries = planning.entries(device, node_id, "tpdo", (STATUSWORD, POSITION))
    torque = device.entry(*TORQUE, "tpdo")
    problem: str | None = f"6077h is {'not mappable to a TPDO' if device.has(*TORQUE) else 'missing'}"
    if torque is not None:
        problem = device.mapping_problem("tpdo", 1, tuple(entry.word for entry in (*entries, torque)))
    if problem is not None:
        planning.not_available.append(("motor torque (torque_permille of log.npz)", f"{device.eds}: {problem}"))
    elif torque is not None:
        entries.append(torque)
    layout = PdoLayout(DRIVE_TPDO1 + node_id, tuple(entries), EVERY_SYNC)
    planning.add(device, _synchronous(node_id, "tpdo", 1, layout, sync))


def _plan_controlword(planning: PdoPlanning, node_id: int, device: Abilities) -> None:
    """The controlword alone, on change and again every 100 ms."""
    entries = planning.entries(device, node_id, "rpdo", (CONTROLWORD,))
    layout = PdoLayout(DRIVE_RPDO1 + node_id, tuple(entries), ON_EVENT)
    planning.add(
        device,
        PlannedPdo(
            node_id=node_id,
            direction="rpdo",
            number=1,
            layout=layout,
            rate_hz=1000 / CONTROLWORD_RESENT_MS,
            bits_worst=worst_case_bits(layout.length),
            deadline_ns=CONTROLWORD_RESENT_MS * 1_000_000,
            event_timer_ms=CONTROLWORD_LOST_MS,
        ),
    )


def _plan_shared_target(planning: PdoPlanning, node_id: int, first: int, sync: SyncPlan, device: Abilities) -> None:
    """The target in this drive's half of its pair's RPDO, a dummy in the half of the other; `first` owns the id."""
    entries = planning.entries(device, node_id, "rpdo", (TARGET_POSITION,))
    dummy = device.dummy(DUMMY_INTEGER32, 32)
    if entries and dummy is not None:
        halves = (*entries, dummy) if node_id == first else (dummy, *entries)
        layout = PdoLayout(DRIVE_RPDO2 + first, halves, EVERY_SYNC)
        planning.add(device, _synchronous(node_id, "rpdo", 2, layout, sync))


def plan_tactile_pdos(planning: PdoPlanning, setup: Setup, sync: SyncPlan, ratio: int, device: Abilities) -> None:
    """Header and payload of a tactile frame, all triggered by every `ratio`-th SYNC."""
    sensor = setup.array
    if sensor is None:
        return
    cycles = min(TACTILE_DEADLINE_CYCLES, ratio)
    long = setup.bus.fd and device.has_long_pdos
    if setup.bus.fd and not long:
        why = f"{device.eds} has no PDOs of up to 64 bytes (2007h); tactile_array_fd.eds is of an array that has"
        planning.not_available.append(("CAN FD frames from the sensor", why))
    _plan_window(planning, sensor, device)
    for number, found in enumerate(_parcels(tactile_objects(sensor), long), start=1):
        entries = planning.entries(device, sensor.node_id, "tpdo", found)
        if entries:
            layout = PdoLayout(TACTILE_TPDO1 + number - 1, tuple(entries), ratio, fd=long)
            bits = frame_bits(layout.length, setup.bus)
            pdo = _synchronous(sensor.node_id, "tpdo", number, layout, sync, cycles=cycles, bits=bits)
            planning.add(device, replace(pdo, kind="tactile"))


def tactile_objects(sensor: Array) -> tuple[tuple[int, int], ...]:
    """The objects of a tactile frame, its header first."""
    if sensor.mode == "features":
        return (FEATURES, 1), (FEATURES, 2)
    if sensor.mode == "image":
        return HEADER, *((IMAGE_TAXELS, half) for half in range(1, IMAGE_WORDS + 1))
    return HEADER, *((WINDOW_TAXELS, word) for word in range(1, window_words(int(sensor.window)) + 1))


def _plan_window(planning: PdoPlanning, sensor: Array, device: Abilities) -> None:
    """A sensor whose window cannot be set has one of 8×8 taxels."""
    if sensor.mode != "window" or has_window_size(device.od):
        return
    why = f"{device.eds} has no window size (2008h), so the window keeps {WINDOW}×{WINDOW} taxels"
    planning.not_available.append(("another window", why))
    if sensor.window != WINDOW:
        planning.problems.append(f"node {sensor.node_id}: {why}: sensor.window = {WINDOW}, not {sensor.window}")


def _parcels(objects: Sequence[tuple[int, int]], long: bool) -> list[Sequence[tuple[int, int]]]:
    """Which objects go together into a PDO: the header alone, then one each, or as many as 64 bytes hold."""
    header, *rest = objects
    parcels: list[Sequence[tuple[int, int]]] = [(header,)]
    while rest:
        size = next(words for words in FD_WORDS if words <= len(rest)) if long else 1
        parcels.append(rest[:size])
        rest = rest[size:]
    return parcels


def _synchronous(
    node_id: int,
    direction: Direction,
    number: int,
    layout: PdoLayout,
    sync: SyncPlan,
    *,
    cycles: int = 1,
    bits: int | None = None,
) -> PlannedPdo:
    """A PDO on every n-th SYNC, n its transmission type, that has `cycles` cycles to get through."""
    return PlannedPdo(
        node_id=node_id,
        direction=direction,
        number=number,
        layout=layout,
        rate_hz=sync.rate_hz / layout.transmission_type,
        bits_worst=worst_case_bits(layout.length) if bits is None else bits,
        deadline_ns=cycles * sync.period_ns,
    )
