"""The PDOs that a scene needs and the devices' EDS files allow, with the default identifiers of the cell.

A PDO whose mapping can be changed is mapped; else one or several are taken whose fixed mappings have the objects. What
else a fixed RPDO carries gets a safe value; what else a fixed TPDO carries is not read. A TPDO that is not needed and
cannot be switched off is planned as traffic. `BusPlan` is what the steps of the planning pass on, these the first.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from canprobe.cell.planning.device_capabilities import COMMUNICATION, DeviceCapabilities
from canprobe.cell.planning.model import (
    EVERY_SYNC,
    Choice,
    CycleBudget,
    PlannedBus,
    PlannedFrames,
    PlannedPdo,
    SyncPlan,
)
from canprobe.cell.planning.node_configuration import Direction, NodeKind
from canprobe.cell.planning.sync import TARGETS, Place, choose_mode, is_profiled
from canprobe.cell.planning.units import PlannedAxis, profile_values
from canprobe.cell.planning.wire_time import frame_bits
from canprobe.cell.scene.setup import Array, Setup
from canprobe.fieldbus.eds.packaged import LONG_PDOS, WINDOW_SIZE, has_known
from canprobe.fieldbus.protocol.frames import INVALID_FLAG, is_restricted
from canprobe.fieldbus.protocol.pdo import MAX_PDO_BITS, MAX_SYNC_TYPE, PdoEntry, PdoLayout
from canprobe.fieldbus.protocol.tactile import DEFAULT_WINDOW, image_words, window_words

STATUSWORD, CONTROLWORD = (0x6041, 0), (0x6040, 0)
POSITION = (0x6064, 0)
TORQUE = (0x6077, 0)
MODE = (0x6060, 0)
ENCODER_POSITION = (0x6004, 0)
STATES = frozenset((0x1001, 0x603F, 0x6041, 0x6061))
"""Objects that change with the state of a drive and not with its motion."""
DUMMY_INTEGER32 = 0x0004

DRIVE_TPDOS, DRIVE_RPDOS = (0x180, 0x280, 0x380, 0x480), (0x200, 0x300, 0x400, 0x500)
"""Bases of COB-IDs in the order of use: the first PDO of a drive in use has the first, whatever its number."""
TACTILE_TPDO1 = 0x511
"""First COB-ID of the array's PDOs: 180h + 16 would have priority over every RPDO; this one delays no drive's frame.
RPDO4 of nodes 17 to 49 have these by default: where there are such nodes, the array gets others."""
_LAST_COB_ID, _FIRST_COB_ID = 0x57F, 0x481
TACTILE_DEADLINE_CYCLES = 2
RESENT_MS, LOST_MS = 100, 250
"""Longest time between two PDOs that are sent on change, and the time after which the receiver reports a loss."""
ON_EVENT = 255

HEADER, WINDOW_TAXELS, IMAGE_TAXELS, FEATURES = (0x2120, 0), 0x2110, 0x2100, 0x2130
FD_WORDS = (8, 6, 4, 3, 2, 1)
"""Objects of 8 bytes that fill a CAN FD frame without a byte left over."""


Mapped = tuple[PdoEntry, ...]
"""Objects that a PDO maps."""


@dataclass(slots=True)
class BusPlan:
    """The bus part of a plan, which each step of the planning completes.

    Attributes:
        setup: closed setup: no key is "auto".
        devices: what each node can do, by node id.
        sync: rate and period of SYNC.
        channels: ids of the nodes on each bus, by channel.
        choices: values of the keys that were open.
        pdos: PDOs of all nodes.
        raw: frames of an array that is no CANopen node.
        buses: the buses with their traffic.
        budget: time budget of one cycle; None before the traffic is planned.
        problems: what is wrong at any bit rate.
        overload: what the bit rate does not carry.
        not_available: what the devices lack, and what that means.
        untaken: other rates, as text and as the setup that has them, for each problem with a rate.
    """

    setup: Setup
    devices: Mapping[int, DeviceCapabilities]
    sync: SyncPlan
    channels: Mapping[str, tuple[int, ...]]
    choices: tuple[Choice, ...] = ()
    pdos: list[PlannedPdo] = field(default_factory=list)
    raw: list[PlannedFrames] = field(default_factory=list)
    buses: list[PlannedBus] = field(default_factory=list)
    budget: CycleBudget | None = None
    problems: list[str] = field(default_factory=list)
    overload: list[str] = field(default_factory=list)
    not_available: list[tuple[str, str]] = field(default_factory=list)
    untaken: dict[str, list[tuple[str, Setup]]] = field(default_factory=dict)

    def axis_of(self, node_id: int) -> PlannedAxis:
        """A drive with its device."""
        return PlannedAxis(self.setup, self.setup.needed_arm().node_ids.index(node_id), self.devices[node_id])

    def entries(self, node_id: int, direction: Direction, *objects: tuple[int, int]) -> list[PdoEntry]:
        """The objects as entries; what the device cannot map becomes a problem."""
        device = self.devices[node_id]
        found = {place: device.entry(*place, direction) for place in objects}
        for index, subindex in (place for place, entry in found.items() if entry is None):
            why = f"is not mappable to a {direction.upper()}" if device.has(index, subindex) else "is missing"
            self.problems.append(f"node {node_id}: {device.eds}: object {index:04X}h:{subindex:02X} {why}")
        return [entry for entry in found.values() if entry is not None]

    def unmapped(self, node_id: int, why: str, places: Iterable[Place]) -> None:
        """A problem of a node whose PDOs do not carry some objects."""
        wanted = ", ".join(f"{index:04X}h:{subindex:02X}" for index, subindex in places)
        end = f"needed: {wanted}; use a device or an EDS that can map it"
        self.problems.append(f"node {node_id}: {self.devices[node_id].eds} {why}; {end}")

    def add(
        self,
        node_id: int,
        direction: Direction,
        number: int,
        layout: PdoLayout,
        *,
        kind: NodeKind = "drive",
        cycles: int = 1,
        constants: tuple[tuple[Place, int], ...] = (),
    ) -> None:
        """Plan a PDO; one that SYNC triggers has `cycles` cycles to get through."""
        device = self.devices[node_id]
        on_event = layout.transmission_type == ON_EVENT
        fixed = device.fixed_cob_id(direction, number)
        if fixed is not None:
            layout = replace(layout, cob_id=fixed)
        self.pdos.append(
            PlannedPdo(
                node_id=node_id,
                direction=direction,
                number=number,
                channel=next(channel for channel, node_ids in self.channels.items() if node_id in node_ids),
                layout=layout,
                rate_hz=1000 / RESENT_MS if on_event else self.sync.rate_hz / layout.transmission_type,
                bits_worst=frame_bits(layout.length, self.setup.bus),
                deadline_ns=RESENT_MS * 1_000_000 if on_event else cycles * self.sync.period_ns,
                event_timer_ms=LOST_MS if on_event else 0,
                kind=kind,
                fixed_id=fixed is not None,
                constants=constants,
            )
        )

    def choose(self, node_id: int, direction: Direction, needed: Sequence[Place]) -> dict[int, Mapped]:
        """PDOs of a device that carry these objects between them, by number; none, and a problem, where there are none.

        One that carries nothing else comes first, by number; then one that carries more; then several.
        """
        device = self.devices[node_id]
        mappable = tuple(entry for place in needed if (entry := device.entry(*place, direction)) is not None)
        alone: dict[int, Mapped] = {}
        fixed: dict[int, Mapped] = {}
        for number in filter(lambda n: device.can_cycle(direction, n), device.pdo_numbers(direction)):
            capacity = device.capacity(direction, number)
            if not capacity:
                mapped = tuple(map(device.mapped_entry, device.fixed_mapping(direction, number)))
                sends = all(entry.bits and _exists(device, entry) for entry in mapped)
                if sends and 0 < sum(entry.bits for entry in mapped) <= MAX_PDO_BITS:
                    fixed[number] = mapped
                    if set(needed) <= _places(mapped):
                        alone[number] = mapped
            elif capacity >= len(needed) == len(mappable):
                alone[number] = mappable
        if alone:
            best = min(alone, key=lambda number: (len(alone[number]) > len(needed), number))
            return {best: alone[best]}
        carriers = [next((n for n, mapped in fixed.items() if place in _places(mapped)), None) for place in needed]
        if None not in carriers:
            return {number: mapped for number, mapped in fixed.items() if number in carriers}
        if len(self.entries(node_id, direction, *needed)) == len(needed):
            offered = "; ".join(_offered(device, direction, n, len(needed)) for n in device.pdo_numbers(direction))
            self.unmapped(node_id, offered or f"has no {direction.upper()}", needed)
        return {}

    def cob_id(self, node_id: int, direction: Direction, number: int, wanted: int) -> int:
        """An identifier for a PDO: not the wanted one where an RPDO that cannot be switched off listens to that."""
        device = self.devices[node_id]
        others = [n for n in device.pdo_numbers(direction) if n != number]
        if direction == "tpdo" or wanted not in [device.fixed_cob_id(direction, n) for n in others]:
            return wanted
        return (device.number(COMMUNICATION[direction] + number - 1, 1) or wanted) & 0x7FF


def _exists(device: DeviceCapabilities, entry: PdoEntry) -> bool:
    """Whether the object of a mapping is in the EDS, or is a dummy."""
    return entry.is_dummy or device.has(entry.index, entry.subindex)


def _places(mapped: Mapped) -> set[Place]:
    return {(entry.index, entry.subindex) for entry in mapped}


def _offered(device: DeviceCapabilities, direction: Direction, number: int, count: int) -> str:
    """Why a PDO does not carry the needed objects."""
    name = f"{direction.upper()}{number}"
    if not device.can_cycle(direction, number):
        return f"{name} cannot follow every SYNC"
    if capacity := device.capacity(direction, number):
        return f"{name} maps at most {capacity} objects"
    words = device.fixed_mapping(direction, number)
    fixed = ", ".join(f"{word:08X}h" for word in words) or "none"
    lost = [f"{entry.index:04X}h" for entry in map(device.mapped_entry, words) if not _exists(device, entry)]
    return f"{name} has the fixed mapping {fixed}" + (f", and the EDS has no {' or '.join(lost)}" if lost else "")


def plan_drive_pdos(bus: BusPlan) -> None:
    """Feedback and targets of the drives: one PDO each way where the device has it, or two targets sharing one RPDO."""
    arm = bus.setup.arm
    if arm is None:
        return
    for node_id in arm.node_ids:
        _plan_feedback(bus, node_id)
    without = {node_id: why for node_id in arm.node_ids if (why := _ungrouped(bus.devices[node_id]))}
    for node_id, why in without.items() if arm.grouped else ():
        text = f"{bus.devices[node_id].eds}: {why}, so each drive keeps its own target RPDO"
        bus.not_available.append(("two targets in one RPDO", text))
    beside: dict[str, list[int]] = {}  # two drives share an RPDO on one bus only
    for drive in arm.drives:
        mine = beside.setdefault(drive.channel, [])
        mine.append(drive.node_id)
        if not arm.grouped or without:
            _plan_commands(bus, drive.node_id)
        else:
            _plan_grouped(bus, drive.node_id, mine[(len(mine) - 1) // 2 * 2])
    for node_id in arm.node_ids:
        _plan_tolerated(bus, node_id)


def _plan_feedback(bus: BusPlan, node_id: int) -> None:
    """Statusword and position, and the torque where the device can send it too."""
    device, arm = bus.devices[node_id], bus.setup.needed_arm()
    chosen = bus.choose(node_id, "tpdo", (STATUSWORD, POSITION))
    if chosen and not any(TORQUE in _places(mapped) for mapped in chosen.values()) and arm.torque:
        (number, mapped), torque = next(iter(chosen.items())), device.entry(*TORQUE, "tpdo")
        if torque is not None and len(chosen) == 1 and device.capacity("tpdo", number) > len(mapped):
            chosen = {number: (*mapped, torque)}
        else:
            problem = f"6077h is {'not mappable to a TPDO' if device.has(*TORQUE) else 'missing'}"
            if torque is not None:
                problem = _offered(device, "tpdo", number, len(mapped) + 1)
            bus.not_available.append(("motor torque (torque_permille of log.npz)", f"{device.eds}: {problem}"))
    for base, (number, mapped) in zip(DRIVE_TPDOS, chosen.items(), strict=False):
        bus.add(node_id, "tpdo", number, PdoLayout(base + node_id, mapped, EVERY_SYNC))


def _plan_commands(bus: BusPlan, node_id: int) -> None:
    """Controlword and target, in one RPDO or several."""
    device = bus.devices[node_id]
    mode = choose_mode(device)
    assert mode is not None  # else the plan has said no
    targets = set(TARGETS.values())
    held = {MODE: int(mode), **(profile_values(bus.axis_of(node_id)) if is_profiled(device) else {})}
    chosen = bus.choose(node_id, "rpdo", (CONTROLWORD, TARGETS[mode]))
    for base, (number, mapped) in zip(DRIVE_RPDOS, chosen.items(), strict=False):
        constants: list[tuple[Place, int]] = []
        for entry in mapped:
            place = entry.index, entry.subindex
            if entry.is_dummy or place == CONTROLWORD or place in targets:
                continue
            value = held.get(place, device.number(*place))
            if value is None:
                bus.problems.append(
                    f"node {node_id}: {device.eds}: RPDO{number} also writes {place[0]:04X}h:{place[1]:02X}, whose"
                    " EDS entry has no default: state a safe DefaultValue there"
                )
            else:
                constants.append((place, value))
        layout = PdoLayout(bus.cob_id(node_id, "rpdo", number, base + node_id), mapped, EVERY_SYNC)
        bus.add(node_id, "rpdo", number, layout, constants=tuple(constants))


def _ungrouped(device: DeviceCapabilities) -> str | None:
    """Why a drive cannot share a target RPDO with another; None where it can."""
    if device.dummy(DUMMY_INTEGER32, 32) is None:
        return f"DummyUsage excludes {DUMMY_INTEGER32:04X}h"
    if is_profiled(device):
        return "profile position takes a target with the controlword beside it"
    for number, count in ((1, 1), (2, 2)):
        free = number in device.pdo_numbers("rpdo") and device.fixed_cob_id("rpdo", number) is None
        if not free or device.capacity("rpdo", number) < count:
            return f"RPDO{number} cannot be mapped with {count} object{'s' * (count > 1)}"
    return None


def _plan_grouped(bus: BusPlan, node_id: int, first: int) -> None:
    """The controlword alone on change and again every 100 ms; the target in this drive's half of its pair's RPDO.

    The half of the other drive is a dummy. The identifier is that of the pair's first drive.
    """
    device = bus.devices[node_id]
    mode = choose_mode(device)
    assert mode is not None  # else the plan has said no
    entries = bus.entries(node_id, "rpdo", CONTROLWORD)
    bus.add(node_id, "rpdo", 1, PdoLayout(DRIVE_RPDOS[0] + node_id, tuple(entries), ON_EVENT))
    entries, dummy = bus.entries(node_id, "rpdo", TARGETS[mode]), device.dummy(DUMMY_INTEGER32, 32)
    if entries and dummy is not None:
        halves = (*entries, dummy) if node_id == first else (dummy, *entries)
        bus.add(node_id, "rpdo", 2, PdoLayout(DRIVE_RPDOS[1] + first, halves, EVERY_SYNC))


def _plan_tolerated(bus: BusPlan, node_id: int) -> None:
    """Plan the TPDOs that are not needed and cannot be switched off.

    No EDS states how often one is sent on events. What only has a state is counted ten times a second; anything else,
    such as a position, changes in every cycle, unless the inhibit time allows less.
    """
    device, sync = bus.devices[node_id], bus.sync
    used = {pdo.number for pdo in bus.pdos if pdo.node_id == node_id and pdo.direction == "tpdo"}
    for number in device.pdo_numbers("tpdo"):
        cob_id = device.fixed_cob_id("tpdo", number)
        communication = COMMUNICATION["tpdo"] + number - 1
        kind = device.number(communication, 2) or EVERY_SYNC
        if cob_id is None or number in used or MAX_SYNC_TYPE < kind < ON_EVENT - 1:
            continue
        entries = tuple(map(device.mapped_entry, device.fixed_mapping("tpdo", number)))
        inhibit_100us = device.number(communication, 3) or 0
        on_event = kind > MAX_SYNC_TYPE
        rate = sync.rate_hz / kind
        if on_event:
            seldom = all(entry.index in STATES for entry in entries)
            rate = min(1000 / RESENT_MS if seldom else sync.rate_hz, 10_000 / (inhibit_100us or 1))
        why = f"{device.eds}: its COB-ID is read-only, so it is sent besides, counted with {rate:g} Hz"
        bus.not_available.append((f"TPDO{number} switched off", why))
        bus.add(node_id, "tpdo", number, PdoLayout(cob_id, entries, kind))
        added, period_ns = bus.pdos.pop(), round(1e9 / rate)
        bus.pdos.append(replace(added, used=False, rate_hz=rate, deadline_ns=period_ns, event_timer_ms=0))


def plan_encoder_pdo(bus: BusPlan) -> None:
    """The position of the carrier, at every SYNC."""
    if (carrier := bus.setup.carrier) is None:
        return
    node_id = carrier.node_id
    for number, mapped in bus.choose(node_id, "tpdo", (ENCODER_POSITION,)).items():
        bus.add(node_id, "tpdo", number, PdoLayout(DRIVE_TPDOS[0] + node_id, mapped, EVERY_SYNC), kind="encoder")
    _plan_tolerated(bus, node_id)


def plan_tactile_pdos(bus: BusPlan, ratio: int) -> None:
    """Header and payload of a tactile frame, all triggered by every `ratio`-th SYNC."""
    array, fd = bus.setup.array, bus.setup.bus.fd
    if array is None or array.raw is not None:
        return
    device = bus.devices[array.node_id]
    long = fd and has_known(device.od, LONG_PDOS)
    if fd and not long:
        why = f"{device.eds} has no PDOs of up to 64 bytes (2007h); tactile_array_fd.eds is of an array that has"
        bus.not_available.append(("CAN FD frames from the sensor", why))
    if array.mode == "window" and not has_known(device.od, WINDOW_SIZE):
        why = f"{device.eds} has no window size (2008h), so the window keeps {DEFAULT_WINDOW}×{DEFAULT_WINDOW} taxels"
        bus.not_available.append(("another window", why))
        if array.window != DEFAULT_WINDOW:
            bus.problems.append(f"node {array.node_id}: {why}: sensor.window = {DEFAULT_WINDOW}, not {array.window}")
    if (lacking := _lacking_words(device, array)) is not None:
        bus.problems.append(f"node {array.node_id}: {lacking}")
        return
    header, *rest = tactile_objects(array)
    parcels = [[header]]  # the header alone, then an object each, or as many as 64 bytes hold
    while rest:
        size = next(words for words in FD_WORDS if words <= len(rest)) if long else 1
        parcels.append(rest[:size])
        rest = rest[size:]
    cob_ids = _tactile_cob_ids(bus, len(parcels))
    for number, objects in enumerate(parcels, start=1):
        entries = bus.entries(array.node_id, "tpdo", *objects)
        if entries and _maps(bus, array.node_id, number, entries):
            layout = PdoLayout(cob_ids[number - 1], tuple(entries), ratio, fd=long)
            cycles = min(TACTILE_DEADLINE_CYCLES, ratio)
            bus.add(array.node_id, "tpdo", number, layout, kind="tactile", cycles=cycles)


def _lacking_words(device: DeviceCapabilities, array: Array) -> str | None:
    """Problem where the EDS has too few objects for the taxels of the array file; else None."""
    words, needed = device.number(IMAGE_TAXELS), image_words(array.pad.taxels)
    if words is None or words >= needed:  # one without the object cannot send images, which is said of each of them
        return None
    taxels = f"{array.pad.rows} × {array.pad.columns} taxels"
    return (
        f"{device.eds} has {words} objects of 8 taxels (2100h), and the {taxels} of the array {array.name} need"
        f" {needed}: it is the EDS of another array, or sensor.rows and sensor.columns are wrong"
    )


def _tactile_cob_ids(bus: BusPlan, count: int) -> list[int]:
    """The lowest free identifiers from `TACTILE_TPDO1` on, ascending; lower ones where those are not enough."""
    taken = {pdo.cob_id for pdo in bus.pdos}
    for device in bus.devices.values():
        words = [device.number(COMMUNICATION["rpdo"] + number - 1, 1) for number in device.pdo_numbers("rpdo")]
        taken |= {word & 0x7FF for word in words if word is not None and not word & INVALID_FLAG}
    places = (*range(TACTILE_TPDO1, _LAST_COB_ID + 1), *range(TACTILE_TPDO1 - 1, _FIRST_COB_ID - 1, -1))
    free = (cob_id for cob_id in places if cob_id not in taken and not is_restricted(cob_id))
    return sorted(itertools.islice(free, count))


def _maps(bus: BusPlan, node_id: int, number: int, entries: Sequence[PdoEntry]) -> bool:
    """Whether a TPDO of the array carries these entries; a problem where it does not."""
    device = bus.devices[node_id]
    words = tuple(entry.word for entry in entries)
    if number not in device.pdo_numbers("tpdo"):
        problem = f"has no TPDO{number}"
    elif device.capacity("tpdo", number) >= len(words) or device.fixed_mapping("tpdo", number) == words:
        return True
    else:
        problem = _offered(device, "tpdo", number, len(words))
    bus.unmapped(node_id, problem, ((entry.index, entry.subindex) for entry in entries))
    return False


def tactile_objects(array: Array) -> tuple[tuple[int, int], ...]:
    """The objects of a tactile frame, its header first."""
    if array.mode == "features":
        return (FEATURES, 1), (FEATURES, 2)
    if array.mode == "image":
        return HEADER, *((IMAGE_TAXELS, word) for word in range(1, image_words(array.pad.taxels) + 1))
    return HEADER, *((WINDOW_TAXELS, word) for word in range(1, window_words(int(array.window)) + 1))
