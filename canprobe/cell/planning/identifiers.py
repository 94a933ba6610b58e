"""Identifiers of PDOs in the order of their deadlines, what is wrong with a set of them, and who shares one.

The bus gives way to the lower identifier. With priorities in the order of the deadlines a message that can wait never
stands before one that cannot. Source: Davis et al. 2007 (priority assignment); restricted identifiers: CiA 301.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

from canprobe.cell.planning.device_capabilities import DeviceCapabilities
from canprobe.cell.planning.model import MASTER_NODE_ID, PlannedFrames, PlannedPdo, RawKind
from canprobe.cell.planning.pdos import BusPlan
from canprobe.cell.planning.wire_time import frame_bits
from canprobe.cell.scene.setup import Array, Setup
from canprobe.fieldbus.protocol.frames import (
    EMCY_BASE,
    HEARTBEAT_BASE,
    NMT_ID,
    SDO_RX_BASE,
    SDO_TX_BASE,
    SYNC_ID,
    Frame,
    is_restricted,
)

_POOL = range(0x181, 0x580)
"""Identifiers below SYNC, emergencies and TIME and above SDO and heartbeats; restricted ones are left out."""


def order_by_deadline(pdos: Sequence[PlannedPdo], devices: Iterable[DeviceCapabilities] = ()) -> list[PlannedPdo]:
    """The same PDOs with identifiers in the order of their deadlines.

    At equal deadlines feedback has priority over commands; otherwise the order stays. An RPDO that several drives read
    keeps one identifier, and so does a PDO whose COB-ID cannot be changed.

    Args:
        pdos: PDOs of all nodes.
        devices: devices whose RPDOs may have fixed identifiers, which no other PDO gets.
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
        pdo if pdo.fixed_id else replace(pdo, layout=replace(pdo.layout, cob_id=chosen[pdo.cob_id])) for pdo in pdos
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


def plan_raw_frames(setup: Setup) -> Iterator[PlannedFrames]:
    """The frames of an array that is no CANopen node, an entry for each identifier and sender."""
    array = setup.array
    if array is None or array.raw is None:
        return
    raw = array.raw
    images = tuple((can_id, bytes(frame.length)) for can_id in raw.image.ids for frame in raw.image.frames)
    kinds: tuple[tuple[RawKind, tuple[Frame, ...], float], ...] = (
        ("image", images, array.rate_hz),
        ("start", raw.start, 0.0),
        ("stop", raw.stop, 0.0),
        ("poll", raw.poll, array.rate_hz),
    )
    for what, frames, rate_hz in kinds:
        for can_id in dict.fromkeys(can_id for can_id, _ in frames):
            lengths = [len(data) for each, data in frames if each == can_id]
            yield PlannedFrames(
                can_id=can_id,
                channel=array.channel,
                what=what,
                sent=what != "image",
                count=len(lengths),
                length=max(lengths),
                rate_hz=rate_hz,
                bits_worst=sum(frame_bits(length, setup.bus) for length in lengths),
            )


def raw_frame_problems(bus: BusPlan, array: Array) -> list[str]:
    """Problems where other frames of the cell have the identifiers of an array's raw frames.

    The cell tells received frames apart by their identifiers, whatever their bus; a frame that it sends is on one bus.
    """
    problems = []
    received, on_bus = _identifiers(bus)
    for frame in bus.raw:
        own = on_bus[frame.channel].get(frame.can_id)
        other = own or (None if frame.sent else received.get(frame.can_id))
        if other is None:
            continue
        if own:
            ways = f'on {frame.channel}; give it a separate bus (sensor.channel = "can1"), or take other node ids'
        else:
            ways = "on another bus, and the cell knows what it receives by the identifier alone; take other node ids"
        problems.append(f"array {array.name}: its {frame.what} frame {frame.can_id:03X}h is {other} {ways}")
    if len(problems) > 1:
        return [f"{problems[0]} ({len(problems) - 1} more of its identifiers are taken too)"]
    return problems


def _identifiers(bus: BusPlan) -> tuple[dict[int, str], dict[str, dict[int, str]]]:
    """Frames that the cell receives on any bus, and all frames of each bus, by identifier."""
    common = {
        NMT_ID: "NMT",
        SYNC_ID: "SYNC",
        HEARTBEAT_BASE + MASTER_NODE_ID: "the heartbeat of the master",
    }
    received: dict[int, str] = {}
    on_bus = {channel: dict(common) for channel in bus.channels}
    for channel, node_ids in bus.channels.items():
        for node_id in node_ids:
            its = {
                HEARTBEAT_BASE + node_id: f"the heartbeat of node {node_id}",
                EMCY_BASE + node_id: f"the EMCY of node {node_id}",
                SDO_TX_BASE + node_id: f"the SDO answer of node {node_id}",
            }
            mine = [pdo for pdo in bus.pdos if pdo.node_id == node_id]
            its |= {pdo.cob_id: f"TPDO{pdo.number} of node {node_id}" for pdo in mine if pdo.direction == "tpdo"}
            received |= its
            on_bus[channel] |= its | {SDO_RX_BASE + node_id: f"the SDO request to node {node_id}"}
            commands = [pdo for pdo in mine if pdo.direction == "rpdo"]
            on_bus[channel] |= {pdo.cob_id: f"RPDO{pdo.number} of node {node_id}" for pdo in commands}
    return received | common, on_bus
