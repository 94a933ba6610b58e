"""Plan → what each node must be, and the list of writes that configure it.

The configuration of a node is an explicit list: one `Write` is an object, its value and the purpose. The order matters:
PDOs first, then what all nodes have, then what a drive or the array needs. Objects that the device's EDS lacks are left
out and listed in `NodeSetup.lacks`.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from canopen import ObjectDictionary

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
MOST_DAYS, DAY_MS = 0xFFFF, 86_400_000


@dataclass(frozen=True, slots=True)
class Write:
    """One entry that bring-up writes and reads back.

    Attributes:
        index, subindex: the entry.
        value: integer value.
        purpose: what the device needs it for.
        read_back: False for commands, whose entry answers another value than the written one.
    """

    index: int
    subindex: int
    value: int
    purpose: str
    read_back: bool = True


@dataclass(frozen=True, slots=True)
class Given:
    """One entry that the device cannot change and the scene relies on.

    Attributes:
        index, subindex: the entry.
        value: that it must hold.
        key: of the scene that states the value.
        otherwise: what would be wrong.
    """

    index: int
    subindex: int
    value: int
    key: str
    otherwise: str


@dataclass(frozen=True, slots=True)
class NodeSetup:
    """What one node must be and become.

    Attributes:
        node_id: the node.
        name: for messages, such as ``joint 3``.
        eds: name of its EDS file, for messages.
        dictionary: its object dictionary, from the EDS.
        identity: expected values of 1018h by sub-index; an absent sub-index is not checked.
        writes: its configuration, in order.
        given: what it must hold by itself.
        lacks: objects that the cell would have set and that this make of device does not have.
    """

    node_id: int
    name: str
    eds: str
    dictionary: ObjectDictionary
    identity: dict[int, int]
    writes: tuple[Write, ...]
    given: tuple[Given, ...] = ()
    lacks: tuple[int, ...] = ()

    @property
    def configuration_date(self) -> dict[int, int]:
        """What 1020h holds where the node has this configuration: days since 1984, milliseconds after midnight.

        They follow from the values, so that any change of them, of the EDS or of the scene, gives another date.
        """
        values = [(write.index, write.subindex, write.value) for write in self.writes if write.read_back]
        text = repr((self.eds, self.identity, values)).encode()
        return {1: 1 + zlib.crc32(text) % MOST_DAYS, 2: 1 + zlib.adler32(text) % DAY_MS}


def make_setups(plan: Plan) -> tuple[NodeSetup, ...]:
    """What every planned node must be and become, drives first."""
    return tuple(_setup(plan, node) for node in plan.nodes)


def _setup(plan: Plan, node: PlannedNode) -> NodeSetup:
    dictionary = load_eds(node.eds, node.node_id)
    of_kind = _drive_writes if node.kind == "drive" else _array_writes
    wanted = [*_common_writes(plan), *of_kind(plan, node, dictionary)]
    return NodeSetup(
        node_id=node.node_id,
        name=node.role,
        eds=node.eds,
        dictionary=dictionary,
        identity={sub: value for sub, value in enumerate(node.identity.numbers, start=1) if value is not None},
        writes=(*_pdo_writes(plan, node, dictionary), *(w for w in wanted if w.index in dictionary)),
        given=_array_given(plan, dictionary) if node.kind == "tactile" else (),
        lacks=tuple(sorted({w.index for w in wanted if w.index not in dictionary})),
    )


def _pdo_writes(plan: Plan, node: PlannedNode, dictionary: Any) -> list[Write]:
    writes = []
    if has_long_pdos(dictionary):
        long = any(pdo.layout.length > CLASSIC_BYTES for pdo in plan.pdos_of(node.node_id, "tpdo"))
        writes.append(Write(LONG_PDOS, 0, int(long), "PDOs of up to 64 bytes"))
    for direction, number in node.switched_off:
        index = COMMUNICATION[direction] + number - 1
        cob_id = (dictionary[index][1].default or 0) | INVALID
        writes.append(Write(index, 1, cob_id, f"{direction.upper()} {number} is not used"))
    for direction in COMMUNICATION:
        for pdo in plan.pdos_of(node.node_id, direction):
            writes += _one_pdo(pdo, dictionary)
    return writes


def _one_pdo(pdo: PlannedPdo, dictionary: Any) -> list[Write]:
    communication = COMMUNICATION[pdo.direction] + pdo.number - 1
    mapping = MAPPING[pdo.direction] + pdo.number - 1
    name = f"{pdo.direction.upper()} {pdo.number}"
    writes = [
        Write(communication, 1, pdo.cob_id | INVALID, f"{name} off while it is changed"),
        Write(communication, 2, pdo.transmission_type, f"transmission type of {name}"),
    ]
    if pdo.event_timer_ms:
        writes.append(Write(communication, 5, pdo.event_timer_ms, f"event timer of {name}"))
    if pdo.direction == "tpdo" and 1 < pdo.transmission_type <= 240 and 6 in dictionary[communication]:
        writes.append(Write(communication, 6, SYNC_START_VALUE, f"first SYNC of {name}"))
    if dictionary[mapping][0].access_type == "rw":
        entries = enumerate(pdo.entries, start=1)
        writes.append(Write(mapping, 0, 0, f"mapping of {name} off while it is changed"))
        writes += [Write(mapping, sub, entry.word, f"mapping of {name}") for sub, entry in entries]
        writes.append(Write(mapping, 0, len(pdo.entries), f"mapping of {name} on"))
    return [*writes, Write(communication, 1, pdo.cob_id, f"COB-ID of {name}")]


def _common_writes(plan: Plan) -> list[Write]:
    counter = [
        Write(0x1006, 0, 0, "1019h may only change while this is 0"),
        Write(0x1019, 0, plan.sync.overflow, "overflow of the SYNC counter"),
    ]
    return [
        *(counter if plan.sync.overflow else []),
        Write(0x1006, 0, plan.sync.period_us, "period of SYNC"),
        Write(0x1015, 0, EMCY_INHIBIT_100US, "shortest time between two emergencies"),
        Write(0x1017, 0, HEARTBEAT_PRODUCED_MS, "period of the node's heartbeat"),
        Write(0x1016, 1, MASTER_NODE_ID << 16 | HEARTBEAT_CONSUMED_MS, "the node notices a dead master"),
    ]


def _drive_writes(plan: Plan, node: PlannedNode, dictionary: Any) -> list[Write]:
    setup, arm = plan.setup, plan.setup.arm
    assert arm is not None and plan.sync.interpolation_100us is not None
    model, axis = arm.model, arm.node_ids.index(node.node_id)
    low, high = software_limits(model)
    window = round(abs(float(model.units_per_q[axis, axis] * model.radian[axis])) * np.radians(FOLLOWING_WINDOW_DEG))
    speed = motor_speed_limit(model, axis, setup.limits.speed_share, plan.sync.period_ns)
    missed = [Write(MISSED_SYNCS, 0, arm.missed_syncs, "SYNCs after which the drive stops by itself")]
    return [
        *(missed if has_missed_syncs(dictionary) else []),
        Write(0x6060, 0, OperationMode.CYCLIC_SYNC_POSITION, "mode of operation"),
        Write(0x60C2, 1, plan.sync.interpolation_100us, "interpolation time"),
        Write(0x60C2, 2, -4, "unit of the interpolation time"),
        Write(0x6065, 0, window, "following error window"),
        Write(0x6066, 0, FOLLOWING_TIMEOUT_MS, "following error time-out"),
        Write(0x607F, 0, speed, "highest speed of the motor"),
        Write(0x607D, 1, int(low[axis]), "lowest position"),
        Write(0x607D, 2, int(high[axis]), "highest position"),
        Write(0x605A, 0, QUICK_STOP_AND_DISABLE, "what a quick stop does"),
        Write(0x6007, 0, ABORT_QUICK_STOP, "what a lost connection does"),
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


def _array_writes(plan: Plan, _: PlannedNode, dictionary: Any) -> list[Write]:
    array = plan.setup.array
    assert array is not None
    writes = [Write(0x2000, 0, TactileMode[array.mode.upper()], "what the array sends")]
    if array.mode == "window" and has_window_size(dictionary):
        writes.append(Write(WINDOW_SIZE, 0, int(array.window), "taxels along the window"))
    # nothing touches the array yet; a listening cell knows no such moment
    if plan.setup.touch is not None:
        writes.append(Write(0x2003, 0, TARE, "tare", read_back=False))
    return writes


def _array_given(plan: Plan, dictionary: Any) -> tuple[Given, ...]:
    """With another full scale the force would be wrong by the ratio of the two."""
    array = plan.setup.array
    assert array is not None
    if not has_full_scale(dictionary):
        return ()
    pascals = round(array.full_scale)
    return (Given(FULL_SCALE, 0, pascals, "sensor.full_scale_kpa", "force would be read wrong by their ratio"),)
