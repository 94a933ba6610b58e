"""Plan → the configuration of each node: what it must be, and the writes that make it so.

The configuration of a node is an explicit list: one `Write` is an object, its value and the purpose. The order matters:
PDOs first, then the objects of every node, then those of a drive or the array.

A write is *required*, or it is *wished* and says what its absence means. What the EDS excludes (no such object,
read-only with another value, limits) is left out where it is wished, `NodeConfiguration.left_out`, and makes the plan
impossible where it is required, `NodeConfiguration.problems`. What the EDS allows and the device refuses is for
bring-up.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any

from canprobe.cell.planning.device_capabilities import COMMUNICATION, INVALID, MAPPING, OWN_BITS, DeviceCapabilities
from canprobe.cell.planning.model import (
    HEARTBEAT_CONSUMED_MS,
    HEARTBEAT_PRODUCED_MS,
    MASTER_NODE_ID,
    Interpolation,
    Plan,
    PlannedNode,
    PlannedPdo,
)
from canprobe.cell.planning.node_configuration import FixedEntry, LeftOut, NodeConfiguration, Write
from canprobe.cell.planning.sync import INTERPOLATION_TIME, SYNC_PERIOD, follows_sync_period, homing_problems
from canprobe.cell.planning.units import (
    FOLLOWING_WINDOW,
    POLARITY,
    POSITION_LIMITS,
    PROFILE_DECELERATION,
    PROFILE_SPEED_LIMIT,
    following_window,
    motor_speed_limit,
    profile_values,
    software_limits,
    speed_unit,
    turn_units,
)
from canprobe.cell.scene.setup import Arm, HomingParameters
from canprobe.fieldbus.eds.description import DescribedEntry, Description
from canprobe.fieldbus.eds.packaged import (
    FULL_SCALE,
    LONG_PDOS,
    MISSED_SYNCS,
    WINDOW_SIZE,
    has_known,
)
from canprobe.fieldbus.eds.values import name_of
from canprobe.fieldbus.protocol.cia402 import OperationMode
from canprobe.fieldbus.protocol.frames import CLASSIC_BYTES
from canprobe.fieldbus.protocol.pdo import MAX_SYNC_TYPE
from canprobe.fieldbus.protocol.si_unit import ACCELERATION_UNIT_INDEX, VELOCITY_UNIT_INDEX
from canprobe.fieldbus.protocol.tactile import TactileMode
from canprobe.mechanics.robot.model import coupled_joints, drive_position_at, joints_to_units

SYNC_START_VALUE = 1
EMCY_INHIBIT_100US = 1000
"""At most ten emergencies a second from a node: one for every late SYNC would make the next SYNC late too."""
MODE, PROFILE_TYPE = 0x6060, 0x6086
HOME_OFFSET = 0x607C
HOMES_HERE = frozenset({35, 37})
"""Homing methods that take the present position."""
TARE_COMMAND = 0x2003
TARE = 0x65726174  # "tare", as 1010h has "save"
FOLLOWING_TIMEOUT_MS = 50
QUICK_STOP_AND_DISABLE = 2  # 605Ah: slow down on the quick stop ramp, then switch on disabled
GO_PRE_OPERATIONAL = 0  # 1029h:01
STARTUP, NOT_BY_ITSELF = 0x1F80, 1 << 2  # CiA 302-2: the device does not become operational without its master
ABORT_QUICK_STOP = 3  # 6007h: quick stop when the connection is lost


def make_configurations(plan: Plan) -> tuple[NodeConfiguration, ...]:
    """Make the configuration of every planned node, drives first."""
    return tuple(_setup(plan, node) for node in plan.nodes)


def _setup(plan: Plan, node: PlannedNode) -> NodeConfiguration:
    device = DeviceCapabilities(node.eds, Description(node.dictionary))
    arm = plan.setup.arm if node.kind == "drive" else None
    axis = arm.node_ids.index(node.node_id) if arm is not None else 0
    drive = arm.drives[axis] if arm is not None else None
    own = _array_writes(plan, device) if arm is None else _drive_writes(plan, node, arm, axis, device)
    wanted = [*_pdo_writes(plan, node, device), *_common_writes(plan, device), *own]
    writes, left_out, problems = _possible(device, wanted)
    times = [_interpolation_writes(device, time) for time in node.interpolation[1:]]
    homing, not_homing, no_homing = _possible(device, _homing_writes(arm, axis, device) if arm is not None else ())
    if homing and arm is not None and drive is not None and drive.zero is not None:
        no_homing += _unhomed(arm, axis, drive.zero, device)
    return NodeConfiguration(
        node_id=node.node_id,
        name=node.role,
        channel=node.channel,
        eds=node.eds,
        dictionary=device.od,
        identity={sub: value for sub, value in enumerate(node.identity.numbers, start=1) if value is not None},
        writes=tuple(writes),
        given=_array_given(plan, device.od) if node.kind == "tactile" else _drive_given(device),
        otherwise=tuple(tuple(_possible(device, other)[0]) for other in times),
        left_out=(*left_out, *not_homing),
        problems=(*problems, *no_homing),
        mode=node.mode,
        homing=tuple(homing),
        turn=None if drive is None else turn_units(device, drive.turn_units, drive.gear),
        speed_unit=1.0 if drive is None else speed_unit(device, drive, VELOCITY_UNIT_INDEX) or 1.0,
    )


def _possible(device: DeviceCapabilities, writes: Iterable[Write]) -> tuple[list[Write], list[LeftOut], list[str]]:
    """The writes that a device can take by its EDS, the wished ones that it cannot, and why not a required one."""
    possible: list[Write] = []
    left_out: dict[tuple[int, int], LeftOut] = {}
    problems: list[str] = []
    for write in writes:
        why = _excluded(device, write)
        if why is None:
            possible.append(write)
        elif write.absence is not None:
            left_out.setdefault((write.index, write.subindex), LeftOut(write, why))
        elif why:
            problems.append(f"{device.eds}: {write.place} = {write.value} ({write.purpose}) is needed: {why}")
    return possible, [one for one in left_out.values() if one.why], problems


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


def _pdo_writes(plan: Plan, node: PlannedNode, device: DeviceCapabilities) -> list[Write]:
    writes = []
    if has_known(device.od, LONG_PDOS):
        long = any(pdo.layout.length > CLASSIC_BYTES for pdo in plan.pdos_of(node.node_id, "tpdo"))
        writes.append(Write(LONG_PDOS, 0, int(long), "PDOs of up to 64 bytes"))
    for direction, number in node.switched_off:
        index, name = COMMUNICATION[direction] + number - 1, f"{direction.upper()} {number}"
        cob_id = (device.number(index, 1) or 0) | INVALID
        absence = "it is sent besides" if direction == "tpdo" else "it listens besides"
        writes.append(Write(index, 1, cob_id, f"{name} is not used", absence, own_bits=OWN_BITS))
    for direction in COMMUNICATION:
        for pdo in plan.pdos_of(node.node_id, direction):
            writes += _one_pdo(pdo, device)
    return writes


def _one_pdo(pdo: PlannedPdo, device: DeviceCapabilities) -> list[Write]:
    communication = COMMUNICATION[pdo.direction] + pdo.number - 1
    mapping = MAPPING[pdo.direction] + pdo.number - 1
    name, cob_id = f"{pdo.direction.upper()} {pdo.number}", pdo.cob_id | pdo.own_bits
    writes = []
    if not pdo.fixed_id:
        off = f"{name} off while it is changed"
        writes.append(Write(communication, 1, cob_id | INVALID, off, "it stays on", own_bits=OWN_BITS))
    writes.append(Write(communication, 2, pdo.transmission_type, f"transmission type of {name}"))
    if pdo.event_timer_ms:
        absence = "the device does not notice that its controlword stays away"
        writes.append(Write(communication, 5, pdo.event_timer_ms, f"event timer of {name}", absence))
    if pdo.direction == "tpdo" and 1 < pdo.transmission_type <= MAX_SYNC_TYPE and device.has(communication, 6):
        writes.append(Write(communication, 6, SYNC_START_VALUE, f"first SYNC of {name}"))
    if device.capacity(pdo.direction, pdo.number):
        entries = enumerate(pdo.entries, start=1)
        writes.append(Write(mapping, 0, 0, f"mapping of {name} off while it is changed", "it stays on"))
        writes += [Write(mapping, sub, entry.word, f"mapping of {name}") for sub, entry in entries]
        writes.append(Write(mapping, 0, len(pdo.entries), f"mapping of {name} on"))
    return (
        writes if pdo.fixed_id else [*writes, Write(communication, 1, cob_id, f"COB-ID of {name}", own_bits=OWN_BITS)]
    )


_UNTIMED = "the device does not know how long a cycle is"


def _common_writes(plan: Plan, device: DeviceCapabilities) -> list[Write]:
    counter = [
        Write(SYNC_PERIOD, 0, 0, "1019h may only change while this is 0", _UNTIMED),
        Write(0x1019, 0, plan.sync.overflow, "overflow of the SYNC counter"),
    ]
    value, others = (device.number(STARTUP) or 0) | NOT_BY_ITSELF, 0xFFFFFFFF & ~NOT_BY_ITSELF
    waits = Write(STARTUP, 0, value, "the node waits for its start", _SELF_STARTING, own_bits=others)
    return [
        *(counter if plan.sync.overflow else []),
        Write(SYNC_PERIOD, 0, plan.sync.period_us, "period of SYNC", None if follows_sync_period(device) else _UNTIMED),
        Write(0x1015, 0, EMCY_INHIBIT_100US, "shortest time between two emergencies", _EMERGENCIES),
        Write(0x1017, 0, HEARTBEAT_PRODUCED_MS, "period of the node's heartbeat"),
        Write(0x1016, 1, MASTER_NODE_ID << 16 | HEARTBEAT_CONSUMED_MS, "the node notices a dead master", _DEAF),
        Write(0x1029, 1, GO_PRE_OPERATIONAL, "NMT state of a node that has lost its master", _BY_DEFAULT),
        *([waits] if device.has(STARTUP) else []),  # a device without it is not asked
    ]


_EMERGENCIES = "a faulty device may fill the bus with emergencies"
_DEAF = "the device will not notice a dead master"
_BY_DEFAULT = "it goes pre-operational, which is the default of CiA 301, or does what the device has"
_SELF_STARTING = "the device may become operational before it is configured"
_MISSED_SYNCS = "SYNCs after which the drive stops by itself"
_FAST = "the drive itself limits its speed as the device has it, or not at all"


def _drive_writes(plan: Plan, node: PlannedNode, arm: Arm, axis: int, device: DeviceCapabilities) -> list[Write]:
    assert node.mode is not None
    model = arm.model
    low, high = software_limits(model)
    limit = motor_speed_limit(model, axis, plan.setup.limits.speed_share, plan.sync.period_ns)
    unit = speed_unit(device, arm.drives[axis], VELOCITY_UNIT_INDEX)
    fastest = "highest speed of the motor"
    speed = [Write(PROFILE_SPEED_LIMIT, 0, math.ceil(limit / unit), fastest, _FAST)] if unit else []
    interpolated = node.mode is OperationMode.INTERPOLATED_POSITION
    following = "a drive that does not follow is noticed as the device has it"
    lag = "a drive that lags is given as long as the device has it"
    stops = "the drive guards the ends of the joint as the device has it, or not at all"
    quick = "a quick stop goes and ends as the device has it"
    lost = "a drive that loses its master does what the device has"
    return [
        Write(MISSED_SYNCS, 0, arm.missed_syncs, _MISSED_SYNCS, "a drive may go on without SYNC"),
        Write(MODE, 0, node.mode, "mode of operation"),
        *([Write(0x60C0, 0, 0, "linear interpolation", "the device interpolates in its way")] if interpolated else []),
        *(_interpolation_writes(device, node.interpolation[0]) if node.interpolation else []),
        *(_profile_writes(plan, node, device) if node.mode is OperationMode.PROFILE_POSITION else []),
        Write(FOLLOWING_WINDOW, 0, following_window(model, axis), "following error window", following),
        Write(0x6066, 0, FOLLOWING_TIMEOUT_MS, "following error time-out", lag),
        *speed,
        Write(POSITION_LIMITS, 1, int(low[axis]), "lowest position", stops),
        Write(POSITION_LIMITS, 2, int(high[axis]), "highest position", stops),
        Write(0x605A, 0, QUICK_STOP_AND_DISABLE, "what a quick stop does", quick),
        Write(0x6007, 0, ABORT_QUICK_STOP, "what a lost connection does", lost),
    ]


def _profile_writes(plan: Plan, node: PlannedNode, device: DeviceCapabilities) -> Iterator[Write]:
    """Writes of profile position: it may not be faster than its joints, and stops as late as it decelerates.

    A drive without 6084h decelerates as it accelerates. Source: CiA 402-2, object 6084h.
    """
    for (index, subindex), value in profile_values(plan.setup, node.node_id, device).items():
        if index != PROFILE_DECELERATION or device.has(index):
            yield Write(index, subindex, value, "profile position within the limits of [joints]")
    yield Write(PROFILE_TYPE, 0, 0, "trapezoidal speed", "it accelerates as the device has it")


def _homing_writes(arm: Arm, axis: int, device: DeviceCapabilities) -> list[Write]:
    """Writes before homing. At home a drive counts -607Ch, or 0 where it has none. Source: CiA 402-2, "Homing mode"."""
    drive, units = arm.drives[axis], abs(float(arm.model.units_per_q[axis, axis]))
    if (zero := drive.zero) is None:
        return []
    speed = units / (speed_unit(device, drive, VELOCITY_UNIT_INDEX) or 1.0)
    acceleration = units / (speed_unit(device, drive, ACCELERATION_UNIT_INDEX) or 1.0)
    ramp = "homing accelerates as the device has it"
    still = f"method {zero.method} does without" if zero.method in HOMES_HERE else None
    offset = -round(_home_units(arm, axis, zero))
    return [
        Write(0x6098, 0, zero.method, "homing method"),
        Write(0x6099, 1, max(1, round(zero.speed * speed)), "speed of the search for the switch", still),
        Write(0x6099, 2, max(1, round(zero.zero_speed * speed)), "speed of the search for the zero", still),
        Write(0x609A, 0, max(1, round(zero.acceleration * acceleration)), "acceleration in homing", ramp),
        *([Write(HOME_OFFSET, 0, offset, "home offset")] if device.has(HOME_OFFSET) else []),
    ]


def _home_units(arm: Arm, axis: int, zero: HomingParameters) -> float:
    """Position of a drive at home, units, with the other joints in the start posture."""
    return float(drive_position_at(arm.model, axis, zero.home, joints_to_units(arm.model, arm.q_start)))


def _unhomed(arm: Arm, axis: int, zero: HomingParameters, device: DeviceCapabilities) -> Iterator[str]:
    """Why a drive cannot be homed: its modes, joints on which its zero depends, or no 607Ch where home is not 0."""
    yield from homing_problems(device)
    joints, coupled = arm.model.joints, coupled_joints(arm.model, axis)
    for other in sorted(coupled):
        its, name = arm.drives[other].zero, joints[other].name
        if its is None or (its.order, other) < (zero.order, axis):
            continue
        way = f"joints.{name}.homing_order must be lower than {zero.order}"
        if axis in coupled_joints(arm.model, other):
            way = "each depends on the other: one of them needs an absolute encoder"
        yield f"the zero of {joints[axis].name} depends on {name}, which is homed later: {way}"
    if device.has(HOME_OFFSET):
        return
    name, lack = joints[axis].name, f"{device.eds}: no such object: 607Ch (home offset)"
    if coupled:
        yield f"{lack}, and what the motor of {name} counts at home depends on other joints: it cannot be homed"
    elif round(home := _home_units(arm, axis, zero)):
        counts = round(arm.model.zero_units[axis] - home)
        yield f"{lack}: the drive counts 0 at home, and the cell {home:.0f}: set joints.{name}.zero_counts = {counts}"


def _interpolation_writes(device: DeviceCapabilities, time: Interpolation) -> list[Write]:
    """A device without 60C2h:02 counts in milliseconds."""
    unit = [Write(INTERPOLATION_TIME, 2, time.index, "unit of the interpolation time")]
    value = Write(INTERPOLATION_TIME, 1, time.value, "interpolation time")
    return [value, *(unit if device.has(INTERPOLATION_TIME, 2) else [])]


def _array_writes(plan: Plan, device: DeviceCapabilities) -> list[Write]:
    array = plan.setup.array
    assert array is not None
    writes = [Write(0x2000, 0, TactileMode[array.mode.upper()], "what the array sends")]
    if array.mode == "window" and has_known(device.od, WINDOW_SIZE):
        writes.append(Write(WINDOW_SIZE, 0, int(array.window), "taxels along the window"))
    if plan.setup.tares:
        writes.append(Write(TARE_COMMAND, 0, TARE, "tare", read_back=False))
    return writes


def _drive_given(device: DeviceCapabilities) -> tuple[FixedEntry, ...]:
    """The cell states in `sign` how a drive counts; 607Eh would turn that round. Speeds are written in unit 60A9h."""
    otherwise = {
        POLARITY: "it would count the other way round than the cell's sign says; set 607Eh back in the drive",
        VELOCITY_UNIT_INDEX: "limits of speed would be wrong by the ratio of the units; set 60A9h back in the drive, or"
        " take the drive's value into the EDS",
    }
    return tuple(
        FixedEntry(index, 0, device.number(index) or 0, "as its EDS says", text)
        for index, text in otherwise.items()
        if device.has(index)
    )


def _array_given(plan: Plan, dictionary: Any) -> tuple[FixedEntry, ...]:
    """The full scale that the array must hold: with another one the force would be wrong by their ratio."""
    array = plan.setup.array
    assert array is not None
    if not has_known(dictionary, FULL_SCALE):
        return ()
    pascals = round(array.pad.full_scale_pa)
    key = "sensor.full_scale_kpa"
    otherwise = f"force would be read wrong by their ratio; put right {key}"
    return (FixedEntry(FULL_SCALE, 0, pascals, f"as the scene's {key} says", otherwise),)
