"""Plan → what is written into each node in bring-up."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from canprobe.cell.bringup import Given, NodeSetup, Write
from canprobe.eds.packaged import (
    FULL_SCALE,
    LONG_PDOS,
    MISSED_SYNCS,
    WINDOW_SIZE,
    has_full_scale,
    has_long_pdos,
    has_missed_syncs,
    has_window_size,
    load_eds,
)
from canprobe.planning.model import (
    HEARTBEAT_CONSUMED_MS,
    HEARTBEAT_PRODUCED_MS,
    MASTER_NODE_ID,
    Direction,
    Plan,
    PlannedNode,
    PlannedPdo,
)
from canprobe.planning.traffic import CLASSIC_BYTES
from canprobe.protocol.cia402 import OperationMode
from canprobe.protocol.tactile import TactileMode
from canprobe.robot.chain import Array
from canprobe.robot.model import ArmModel

INVALID = 1 << 31
COMMUNICATION: dict[Direction, int] = {"rpdo": 0x1400, "tpdo": 0x1800}
MAPPING: dict[Direction, int] = {"rpdo": 0x1600, "tpdo": 0x1A00}
SYNC_START_VALUE = 1
EMCY_INHIBIT_100US = 1000
"""At most ten emergencies a second from a node: one for every late SYNC would make the next SYNC late too."""
TARE = 0x65726174  # "tare", as 1010h has "save"
FOLLOWING_WINDOW_DEG = 5.0
FOLLOWING_TIMEOUT_MS = 50
ROUNDING_COUNTS = 2
"""By which two targets may be rounded apart."""
QUICK_STOP_AND_DISABLE = 2  # 605Ah: slow down on the quick stop ramp, then switch on disabled
ABORT_QUICK_STOP = 3  # 6007h: quick stop when the connection is lost


def make_setups(plan: Plan) -> tuple[NodeSetup, ...]:
    """What every planned node must be and become, drives first."""
    return tuple(_setup(plan, node) for node in plan.nodes)


def _setup(plan: Plan, node: PlannedNode) -> NodeSetup:
    dictionary = load_eds(node.eds, node.node_id)
    specific = _drive_writes(plan, node) if node.kind == "drive" else _sensor_writes(plan, dictionary)
    wanted = [*_common_writes(plan), *specific]
    return NodeSetup(
        node_id=node.node_id,
        name=node.role,
        eds=node.eds,
        dictionary=dictionary,
        identity={sub: value for sub, value in enumerate(node.identity.numbers, start=1) if value is not None},
        writes=(*_pdo_writes(plan, node, dictionary), *(w for w in wanted if w.index in dictionary)),
        given=_sensor_given(plan, dictionary) if node.kind == "tactile" else (),
        lacks=tuple(sorted({w.index for w in wanted if w.index not in dictionary})),
    )


def _common_writes(plan: Plan) -> list[Write]:
    counter = [Write(0x1006, 0, 0), Write(0x1019, 0, plan.sync.overflow)] if plan.sync.overflow else []
    return [
        *counter,  # 1019h may only change while 1006h is 0
        Write(0x1006, 0, plan.sync.period_us),
        Write(0x1015, 0, EMCY_INHIBIT_100US),
        Write(0x1017, 0, HEARTBEAT_PRODUCED_MS),
        Write(0x1016, 1, MASTER_NODE_ID << 16 | HEARTBEAT_CONSUMED_MS),
    ]


def _pdo_writes(plan: Plan, node: PlannedNode, dictionary: Any) -> list[Write]:
    writes = []
    if any(pdo.layout.length > CLASSIC_BYTES for pdo in plan.pdos_of(node.node_id, "tpdo")):
        writes.append(Write(LONG_PDOS, 0, 1))
    elif has_long_pdos(dictionary):
        writes.append(Write(LONG_PDOS, 0, 0))
    for direction, number in node.switched_off:
        index = COMMUNICATION[direction] + number - 1
        writes.append(Write(index, 1, (dictionary[index][1].default or 0) | INVALID))
    for direction in COMMUNICATION:
        for pdo in plan.pdos_of(node.node_id, direction):
            writes += _one_pdo(pdo, dictionary)
    return writes


def _one_pdo(pdo: PlannedPdo, dictionary: Any) -> list[Write]:
    communication = COMMUNICATION[pdo.direction] + pdo.number - 1
    mapping = MAPPING[pdo.direction] + pdo.number - 1
    writes = [Write(communication, 1, pdo.cob_id | INVALID), Write(communication, 2, pdo.transmission_type)]
    if pdo.event_timer_ms:
        writes.append(Write(communication, 5, pdo.event_timer_ms))
    if pdo.direction == "tpdo" and 1 < pdo.transmission_type <= 240 and 6 in dictionary[communication]:
        writes.append(Write(communication, 6, SYNC_START_VALUE))
    if dictionary[mapping][0].access_type == "rw":
        writes.append(Write(mapping, 0, 0))
        writes += [Write(mapping, sub, entry.word) for sub, entry in enumerate(pdo.entries, start=1)]
        writes.append(Write(mapping, 0, len(pdo.entries)))
    return [*writes, Write(communication, 1, pdo.cob_id)]


def _drive_writes(plan: Plan, node: PlannedNode) -> list[Write]:
    setup, arm = plan.setup, plan.setup.arm
    assert arm is not None and plan.sync.interpolation_100us is not None
    model, axis = arm.model, arm.node_ids.index(node.node_id)
    low, high = software_limits(model)
    window = round(abs(float(model.units_per_q[axis, axis] * model.radian[axis])) * np.radians(FOLLOWING_WINDOW_DEG))
    dictionary = load_eds(node.eds, node.node_id)
    return [
        *([Write(MISSED_SYNCS, 0, arm.missed_syncs)] if has_missed_syncs(dictionary) else []),
        Write(0x6060, 0, OperationMode.CYCLIC_SYNC_POSITION),
        Write(0x60C2, 1, plan.sync.interpolation_100us),
        Write(0x60C2, 2, -4),
        Write(0x6065, 0, window),
        Write(0x6066, 0, FOLLOWING_TIMEOUT_MS),
        Write(0x607F, 0, motor_speed_limit(model, axis, setup.limits.speed_share, plan.sync.period_ns)),
        Write(0x607D, 1, int(low[axis])),
        Write(0x607D, 2, int(high[axis])),
        Write(0x605A, 0, QUICK_STOP_AND_DISABLE),
        Write(0x6007, 0, ABORT_QUICK_STOP),
    ]


def motor_speed_limit(model: ArmModel, axis: int, share: float, period_ns: int) -> int:
    """Drive units/s beyond which it must not follow a target: all joints that move the motor, at their limits.

    Args:
        model: the arm.
        axis: of the motor, 0-based.
        share: of the joints' speed limits.
        period_ns: of the cycle; a target is a whole number of drive units.
    """
    fastest = float(np.abs(model.units_per_q[axis]) @ model.qd_max) * share
    return math.ceil(fastest + ROUNDING_COUNTS * 1e9 / period_ns)


def software_limits(model: ArmModel) -> tuple[Array, Array]:
    """Extremes of each drive (n,) and (n,), units, over the joints' ranges; the coupled ones span both joints'."""
    a, b, zero = model.units_per_q * model.q_min, model.units_per_q * model.q_max, model.zero_units
    return np.floor(np.minimum(a, b).sum(axis=1) + zero), np.ceil(np.maximum(a, b).sum(axis=1) + zero)


def _sensor_writes(plan: Plan, dictionary: Any) -> list[Write]:
    sensor = plan.setup.array
    assert sensor is not None
    writes = [Write(0x2000, 0, TactileMode[sensor.mode.upper()])]
    if sensor.mode == "window" and has_window_size(dictionary):
        writes.append(Write(WINDOW_SIZE, 0, int(sensor.window)))
    # nothing touches the array yet; a listening cell knows no such moment
    if plan.setup.touch is not None:
        writes.append(Write(0x2003, 0, TARE, read_back=False))
    return writes


def _sensor_given(plan: Plan, dictionary: Any) -> tuple[Given, ...]:
    """An array of another full scale would have its force read wrong by the ratio of the two."""
    sensor = plan.setup.array
    assert sensor is not None
    if not has_full_scale(dictionary):
        return ()
    pascals = round(sensor.full_scale)
    return (Given(FULL_SCALE, 0, pascals, "sensor.full_scale_kpa", "force would be read wrong by their ratio"),)
