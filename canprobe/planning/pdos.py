"""Which PDOs a scene needs, with the default identifiers of the cell, as far as the devices' EDS files allow."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from canprobe.eds import has_window_size
from canprobe.planning.abilities import Abilities
from canprobe.planning.model import Direction, PlannedPdo, SyncPlan
from canprobe.planning.wire_bits import frame_bits
from canprobe.protocol.pdo import PdoEntry, PdoLayout
from canprobe.protocol.tactile import WINDOW, window_words
from canprobe.protocol.timing import worst_case_bits
from canprobe.scene_setup import Array, Setup

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
