"""The configuration of each node: what it must be, and the writes that make it so.

The configuration of a node is an explicit list: one `Write` is an object, its value and the purpose. The order matters:
PDOs first, then the objects of every node, then those of a drive or the array.

A write is *required*, or it is *wished* and says what its absence means. What the EDS excludes (no such object,
read-only with another value, limits) is left out where it is wished, `NodeConfiguration.left_out`, and makes the plan
impossible where it is required. What the EDS allows and the device refuses is for bring-up.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

from canprobe.cell.planning.device_capabilities import COMMUNICATION, MAPPING, OWN_BITS, DeviceCapabilities
from canprobe.cell.planning.model import (
    HEARTBEAT_CONSUMED_MS,
    HEARTBEAT_PRODUCED_MS,
    MASTER_NODE_ID,
    PlannedPdo,
    SyncPlan,
)
from canprobe.cell.planning.node_configuration import (
    Direction,
    FixedEntry,
    Interpolation,
    NodeConfiguration,
    NodeKind,
    Write,
)
from canprobe.cell.planning.pdos import BusPlan
from canprobe.cell.planning.sync import SYNC_PERIOD, choose_mode, follows_sync_period, homing_problems, interpolations
from canprobe.cell.planning.units import (
    FOLLOWING_WINDOW,
    POLARITY,
    POSITION_LIMITS,
    PROFILE_DECELERATION,
    PROFILE_SPEED_LIMIT,
    ROUNDING_COUNTS,
    PlannedAxis,
    profile_values,
    software_limits,
)
from canprobe.cell.scene.setup import Array, Carrier, Drive, HomingParameters, Node, Setup
from canprobe.fieldbus.eds.description import DescribedEntry
from canprobe.fieldbus.eds.packaged import FULL_SCALE, LONG_PDOS, MISSED_SYNCS, WINDOW_SIZE, has_known
from canprobe.fieldbus.eds.values import name_of
from canprobe.fieldbus.protocol.cia402 import INTERPOLATION_TIME, MODE, OperationMode
from canprobe.fieldbus.protocol.frames import CLASSIC_BYTES, INVALID_FLAG
from canprobe.fieldbus.protocol.pdo import MAX_SYNC_TYPE
from canprobe.fieldbus.protocol.si_unit import ACCELERATION_UNIT_INDEX, VELOCITY_UNIT_INDEX
from canprobe.fieldbus.protocol.tactile import TactileMode
from canprobe.mechanics.robot.model import coupled_joints, drive_position_at, joints_to_units

SYNC_START_VALUE = 1
EMCY_INHIBIT_100US = 1000
"""At most ten emergencies a second from a node: one for every late SYNC would make the next SYNC late too."""
PROFILE_TYPE = 0x6086
HOME_OFFSET = 0x607C
HOMES_HERE = frozenset({35, 37})
"""Homing methods that take the present position."""
TARE_COMMAND = 0x2003
TARE = 0x65726174  # "tare", as 1010h has "save"
FOLLOWING_TIMEOUT_MS = 50
QUICK_STOP_AND_DISABLE = 2  # 605Ah: slow down on the quick stop ramp, then switch on disabled
GO_PRE_OPERATIONAL = 0  # 1029h:01
STARTUP, NOT_BY_ITSELF = 0x1F80, 1 << 2  # CiA 302-2: the device does not become operational without its master
OPERATING_PARAMETERS, TOTAL_RANGE = 0x6000, 0x6002  # CiA 406
ABORT_QUICK_STOP = 3  # 6007h: quick stop when the connection is lost


def configure(bus: BusPlan, kind: NodeKind, name: str, node: Node) -> NodeConfiguration:
    """Make the configuration of a node.

    A required write that its device cannot take is a problem of the plan; a wished one is not available.
    """
    device = bus.devices[node.node_id]
    planned = {(pdo.direction, pdo.number): pdo for pdo in bus.pdos if pdo.node_id == node.node_id}
    switched_off = tuple(one for one in device.switchable_pdos if one not in planned)
    used = [pdo for _, pdo in sorted(planned.items()) if pdo.used]
    if isinstance(node, Array):
        own, given = _array_writes(bus.setup, node, device), _array_given(node, device)
    elif isinstance(node, Carrier):
        own, given = iter(()), _as_in_eds(device, _ENCODER_OTHERWISE)
    else:
        own, given = _drive_writes(bus.sync, bus.axis_of(node.node_id)), _as_in_eds(device, _DRIVE_OTHERWISE)
    wanted = [*_pdo_writes(device, used, switched_off), *_common_writes(bus.sync, device), *own]
    writes, left_out = _possible(bus, device, wanted)
    found = NodeConfiguration(
        node_id=node.node_id,
        kind=kind,
        name=name,
        eds=node.eds,
        dictionary=device.od,
        identity=replace(device.identity, serial_number=node.serial),
        emulated=node.emulated,
        channel=node.channel,
        switched_off=switched_off,
        writes=writes,
        given=given,
        left_out=left_out,
        counts_range=device.number(TOTAL_RANGE) or 1 << 32,
    )
    return _with_drive(found, bus, bus.axis_of(node.node_id)) if isinstance(node, Drive) else found


def _with_drive(found: NodeConfiguration, bus: BusPlan, axis: PlannedAxis) -> NodeConfiguration:
    """The configuration with mode, homing and units of a drive."""
    device, times = axis.device, interpolations(axis.device, bus.sync.period_us)
    others = [_interpolation_writes(device, time) for time in times[1:]]
    homing, not_homing = _possible(bus, device, _homing_writes(axis))
    if homing:
        bus.problems += _unhomed(axis)
    return replace(
        found,
        left_out=(*found.left_out, *not_homing),
        mode=choose_mode(device),
        interpolation=times,
        otherwise=tuple(tuple(write for write in one if _excluded(device, write) is None) for one in others),
        homing=homing,
        turn=axis.turn,
        speed_unit=axis.unit(VELOCITY_UNIT_INDEX) or 1.0,
    )


Writes = tuple[Write, ...]


def _possible(bus: BusPlan, device: DeviceCapabilities, writes: Iterable[Write]) -> tuple[Writes, Writes]:
    """The writes that a device can take by its EDS, and the wished ones that it cannot, the first of each entry."""
    possible: list[Write] = []
    left_out: dict[tuple[int, int], tuple[Write, str]] = {}
    for write in writes:
        why = _excluded(device, write)
        if why is None:
            possible.append(write)
        elif write.absence is not None:
            left_out.setdefault((write.index, write.subindex), (write, why))
        elif why:
            problem = f"{device.eds}: {write.place} = {write.value} ({write.purpose}) is needed: {why}"
            bus.problems.append(problem)
    lost = [(write, why) for write, why in left_out.values() if why]
    for write, why in lost:
        what = f"{write.purpose} ({write.place})"
        bus.not_available.append((what, f"{device.eds}: {why}: {write.absence}"))
    return tuple(possible), tuple(write for write, _ in lost)


def _excluded(device: DeviceCapabilities, write: Write) -> str | None:
    """Why a device cannot take a write; empty where the entry always holds the value, None where it can."""
    entry = device.description.entry(write.index, write.subindex)
    if entry is None or (write.purpose == _MISSED_SYNCS and not has_known(device.od, MISSED_SYNCS)):
        return "no such object"
    if not entry.is_integer:
        return f"its data type is {name_of(entry.data_type)}, not an integer"
    if not entry.writable:
        same = entry.initial == write.value
        return "" if same else f"it is {entry.access}{'' if entry.initial is None else f', {entry.initial!r}'}"
    if not entry.allows(write.value):
        return f"it takes {_ends(entry)}"
    return None


def _ends(entry: DescribedEntry) -> str:
    if entry.low is None:
        return f"values of {entry.bits} bits" if entry.high is None else f"at most {entry.high}"
    return f"at least {entry.low}" if entry.high is None else f"{entry.low} to {entry.high}"


def _pdo_writes(
    device: DeviceCapabilities, used: Sequence[PlannedPdo], switched_off: Sequence[tuple[Direction, int]]
) -> Iterator[Write]:
    if has_known(device.od, LONG_PDOS):
        long = any(pdo.layout.length > CLASSIC_BYTES for pdo in used if pdo.direction == "tpdo")
        yield Write(LONG_PDOS, 0, int(long), "PDOs of up to 64 bytes")
    for direction, number in switched_off:
        index, name = COMMUNICATION[direction] + number - 1, f"{direction.upper()} {number}"
        cob_id = (device.number(index, 1) or 0) | INVALID_FLAG
        absence = "it is sent besides" if direction == "tpdo" else "it listens besides"
        yield Write(index, 1, cob_id, f"{name} is not used", absence, own_bits=OWN_BITS)
    for pdo in used:
        yield from _one_pdo(pdo, device)


def _one_pdo(pdo: PlannedPdo, device: DeviceCapabilities) -> Iterator[Write]:
    communication = COMMUNICATION[pdo.direction] + pdo.number - 1
    mapping = MAPPING[pdo.direction] + pdo.number - 1
    name, cob_id = f"{pdo.direction.upper()} {pdo.number}", pdo.cob_id | device.own_bits(pdo.direction, pdo.number)
    if not pdo.fixed_id:
        off = f"{name} off while it is changed"
        yield Write(communication, 1, cob_id | INVALID_FLAG, off, "it stays on", own_bits=OWN_BITS)
    yield Write(communication, 2, pdo.transmission_type, f"transmission type of {name}")
    if pdo.event_timer_ms:
        absence = "the device does not notice that its controlword stays away"
        yield Write(communication, 5, pdo.event_timer_ms, f"event timer of {name}", absence)
    if pdo.direction == "tpdo" and 1 < pdo.transmission_type <= MAX_SYNC_TYPE and device.has(communication, 6):
        yield Write(communication, 6, SYNC_START_VALUE, f"first SYNC of {name}")
    if device.capacity(pdo.direction, pdo.number):
        yield Write(mapping, 0, 0, f"mapping of {name} off while it is changed", "it stays on")
        for sub, entry in enumerate(pdo.entries, start=1):
            yield Write(mapping, sub, entry.word, f"mapping of {name}")
        yield Write(mapping, 0, len(pdo.entries), f"mapping of {name} on")
    if not pdo.fixed_id:
        yield Write(communication, 1, cob_id, f"COB-ID of {name}", own_bits=OWN_BITS)


_UNTIMED = "the device does not know how long a cycle is"


def _common_writes(sync: SyncPlan, device: DeviceCapabilities) -> Iterator[Write]:
    if sync.overflow:
        yield Write(SYNC_PERIOD, 0, 0, "1019h may only change while this is 0", _UNTIMED)
        yield Write(0x1019, 0, sync.overflow, "overflow of the SYNC counter")
    yield Write(SYNC_PERIOD, 0, sync.period_us, "period of SYNC", None if follows_sync_period(device) else _UNTIMED)
    yield Write(0x1015, 0, EMCY_INHIBIT_100US, "shortest time between two emergencies", _EMERGENCIES)
    yield Write(0x1017, 0, HEARTBEAT_PRODUCED_MS, "period of the node's heartbeat")
    yield Write(0x1016, 1, MASTER_NODE_ID << 16 | HEARTBEAT_CONSUMED_MS, "the node notices a dead master", _DEAF)
    yield Write(0x1029, 1, GO_PRE_OPERATIONAL, "NMT state of a node that has lost its master", _BY_DEFAULT)
    if device.has(STARTUP):  # a device without it is not asked
        value, others = (device.number(STARTUP) or 0) | NOT_BY_ITSELF, 0xFFFFFFFF & ~NOT_BY_ITSELF
        yield Write(STARTUP, 0, value, "the node waits for its start", _SELF_STARTING, own_bits=others)


_EMERGENCIES = "a faulty device may fill the bus with emergencies"
_DEAF = "the device will not notice a dead master"
_BY_DEFAULT = "it goes pre-operational, which is the default of CiA 301, or does what the device has"
_SELF_STARTING = "the device may become operational before it is configured"
_MISSED_SYNCS = "SYNCs after which the drive stops by itself"
_FAST = "the drive itself limits its speed as the device has it, or not at all"


def _drive_writes(sync: SyncPlan, axis: PlannedAxis) -> Iterator[Write]:
    device, arm, mode = axis.device, axis.setup.needed_arm(), choose_mode(axis.device)
    assert mode is not None  # else the plan has said no
    low, high = (int(ends[axis.number]) for ends in software_limits(arm.model))
    following = "a drive that does not follow is noticed as the device has it"
    lag = "a drive that lags is given as long as the device has it"
    stops = "the drive guards the ends of the joint as the device has it, or not at all"
    quick = "a quick stop goes and ends as the device has it"
    lost = "a drive that loses its master does what the device has"
    yield Write(MISSED_SYNCS, 0, arm.missed_syncs, _MISSED_SYNCS, "a drive may go on without SYNC")
    yield Write(MODE, 0, mode, "mode of operation")
    if mode is OperationMode.INTERPOLATED_POSITION:
        yield Write(0x60C0, 0, 0, "linear interpolation", "the device interpolates in its way")
    for time in interpolations(device, sync.period_us)[:1]:
        yield from _interpolation_writes(device, time)
    if mode is OperationMode.PROFILE_POSITION:
        for (index, subindex), value in profile_values(axis).items():
            # a drive without 6084h decelerates as it accelerates (CiA 402-2)
            if index != PROFILE_DECELERATION or device.has(index):
                yield Write(index, subindex, value, "profile position within the limits of [joints]")
        yield Write(PROFILE_TYPE, 0, 0, "trapezoidal speed", "it accelerates as the device has it")
    yield Write(FOLLOWING_WINDOW, 0, axis.following_window, "following error window", following)
    yield Write(0x6066, 0, FOLLOWING_TIMEOUT_MS, "following error time-out", lag)
    if unit := axis.unit(VELOCITY_UNIT_INDEX):
        limit = math.ceil(axis.fastest + ROUNDING_COUNTS * 1e9 / sync.period_ns)  # a target is a whole number of units
        yield Write(PROFILE_SPEED_LIMIT, 0, math.ceil(limit / unit), "highest speed of the motor", _FAST)
    yield Write(POSITION_LIMITS, 1, low, "lowest position", stops)
    yield Write(POSITION_LIMITS, 2, high, "highest position", stops)
    yield Write(0x605A, 0, QUICK_STOP_AND_DISABLE, "what a quick stop does", quick)
    yield Write(0x6007, 0, ABORT_QUICK_STOP, "what a lost connection does", lost)


def _homing_writes(axis: PlannedAxis) -> Iterator[Write]:
    """Writes before homing. At home a drive counts -607Ch, or 0 where it has none. Source: CiA 402-2, "Homing mode"."""
    if (zero := axis.drive.zero) is None:
        return
    units = abs(float(axis.model.units_per_q[axis.number, axis.number]))
    speed = units / (axis.unit(VELOCITY_UNIT_INDEX) or 1.0)
    acceleration = units / (axis.unit(ACCELERATION_UNIT_INDEX) or 1.0)
    ramp = "homing accelerates as the device has it"
    still = f"method {zero.method} does without" if zero.method in HOMES_HERE else None
    yield Write(0x6098, 0, zero.method, "homing method")
    yield Write(0x6099, 1, max(1, round(zero.speed * speed)), "speed of the search for the switch", still)
    yield Write(0x6099, 2, max(1, round(zero.zero_speed * speed)), "speed of the search for the zero", still)
    yield Write(0x609A, 0, max(1, round(zero.acceleration * acceleration)), "acceleration in homing", ramp)
    if axis.device.has(HOME_OFFSET):
        yield Write(HOME_OFFSET, 0, -round(_home_units(axis, zero)), "home offset")


def _home_units(axis: PlannedAxis, zero: HomingParameters) -> float:
    """Position of a drive at home, units, with the other joints in the start posture."""
    others = joints_to_units(axis.model, axis.setup.needed_arm().q_start)
    return float(drive_position_at(axis.model, axis.number, zero.home, others))


def _unhomed(axis: PlannedAxis) -> Iterator[str]:
    """Why a drive cannot be homed: its modes, joints on which its zero depends, or no 607Ch where home is not 0."""
    if (zero := axis.drive.zero) is None:
        return
    yield from homing_problems(axis.device)
    number, joints, coupled = axis.number, axis.model.joints, coupled_joints(axis.model, axis.number)
    for other in sorted(coupled):
        its, name = axis.setup.drives[other].zero, joints[other].name
        if its is None or (its.order, other) < (zero.order, number):
            continue
        way = f"joints.{name}.homing_order must be lower than {zero.order}"
        if number in coupled_joints(axis.model, other):
            way = "each depends on the other: one of them needs an absolute encoder"
        yield f"the zero of {joints[number].name} depends on {name}, which is homed later: {way}"
    if axis.device.has(HOME_OFFSET):
        return
    name, lack = joints[number].name, f"{axis.device.eds}: no such object: 607Ch (home offset)"
    if coupled:
        yield f"{lack}, and what the motor of {name} counts at home depends on other joints: it cannot be homed"
    elif round(home := _home_units(axis, zero)):
        counts = round(axis.model.zero_units[number] - home)
        yield f"{lack}: the drive counts 0 at home, and the cell {home:.0f}: set joints.{name}.zero_counts = {counts}"


def _interpolation_writes(device: DeviceCapabilities, time: Interpolation) -> list[Write]:
    """A device without 60C2h:02 counts in milliseconds."""
    unit = [Write(INTERPOLATION_TIME, 2, time.index, "unit of the interpolation time")]
    value = Write(INTERPOLATION_TIME, 1, time.value, "interpolation time")
    return [value, *(unit if device.has(INTERPOLATION_TIME, 2) else [])]


def _array_writes(setup: Setup, array: Array, device: DeviceCapabilities) -> Iterator[Write]:
    yield Write(0x2000, 0, TactileMode[array.mode.upper()], "what the array sends")
    if array.mode == "window" and has_known(device.od, WINDOW_SIZE):
        yield Write(WINDOW_SIZE, 0, int(array.window), "taxels along the window")
    if setup.tares:
        yield Write(TARE_COMMAND, 0, TARE, "tare", read_back=False)


_DRIVE_OTHERWISE = {
    POLARITY: "it would count the other way round than the cell's sign says; set 607Eh back in the drive",
    VELOCITY_UNIT_INDEX: "limits of speed would be wrong by the ratio of the units; set 60A9h back in the drive, or"
    " take the drive's value into the EDS",
}
"""The cell states in `sign` how a drive counts; 607Eh would turn that round. Speeds are written in unit 60A9h."""
_ENCODER_OTHERWISE = {
    OPERATING_PARAMETERS: "it may count the other way round; set 6000h back in the encoder",
    TOTAL_RANGE: "its counts begin again at 0 elsewhere; set 6002h back in the encoder, or take its value into the EDS",
}


def _as_in_eds(device: DeviceCapabilities, otherwise: Mapping[int, str]) -> tuple[FixedEntry, ...]:
    """Entries that must hold what the EDS says, by what is wrong otherwise."""
    return tuple(
        FixedEntry(index, 0, device.number(index) or 0, "as its EDS says", text)
        for index, text in otherwise.items()
        if device.has(index)
    )


def _array_given(array: Array, device: DeviceCapabilities) -> tuple[FixedEntry, ...]:
    """The full scale that the array must hold: with another one the force would be wrong by their ratio."""
    if not has_known(device.od, FULL_SCALE):
        return ()
    pascals, key = round(array.pad.full_scale_pa), "sensor.full_scale_kpa"
    otherwise = f"force would be read wrong by their ratio; put right {key}"
    return (FixedEntry(FULL_SCALE, 0, pascals, f"as the scene's {key} says", otherwise),)
