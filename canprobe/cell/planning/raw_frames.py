"""The frames of an array that is no CANopen node, and identifiers that they share with something else in the cell."""

from __future__ import annotations

from collections.abc import Mapping

from canprobe.cell.planning.model import MASTER_NODE_ID, PlannedFrames, PlannedPdo, RawKind
from canprobe.cell.planning.wire_time import frame_bits
from canprobe.cell.scene.setup import Setup
from canprobe.fieldbus.protocol.frames import (
    EMCY_BASE,
    HEARTBEAT_BASE,
    NMT_ID,
    SDO_RX_BASE,
    SDO_TX_BASE,
    SYNC_ID,
    Frame,
)


def plan_raw_frames(setup: Setup) -> tuple[PlannedFrames, ...]:
    """The frames of an array that is no CANopen node, an entry for each identifier and sender."""
    array = setup.array
    if array is None or array.raw is None:
        return ()
    raw, channel = array.raw, array.channel

    def planned(what: RawKind, can_id: int, lengths: list[int], rate_hz: float, *, sent: bool) -> PlannedFrames:
        bits = sum(frame_bits(length, setup.bus) for length in lengths)
        return PlannedFrames(can_id, channel, what, sent, len(lengths), max(lengths), rate_hz, bits)

    lengths = [frame.length for frame in raw.image.frames]
    found = [planned("image", can_id, lengths, array.rate_hz, sent=False) for can_id in raw.image.ids]
    commands: tuple[tuple[RawKind, tuple[Frame, ...], float], ...] = (
        ("start", raw.start, 0.0),
        ("stop", raw.stop, 0.0),
        ("poll", raw.poll, array.rate_hz),
    )
    for what, frames, rate_hz in commands:
        for can_id in dict.fromkeys(can_id for can_id, _ in frames):
            mine = [len(data) for each, data in frames if each == can_id]
            found.append(planned(what, can_id, mine, rate_hz, sent=True))
    return tuple(found)


def raw_frame_problems(
    frames: tuple[PlannedFrames, ...], pdos: list[PlannedPdo], buses: Mapping[str, tuple[int, ...]], name: str
) -> list[str]:
    """Problems where other frames of the cell have the identifiers of raw frames.

    The cell tells received frames apart by their identifiers, whatever their bus; a frame that it sends is on one bus.

    Args:
        frames: raw frames of the array.
        pdos: PDOs of all nodes.
        buses: node ids by channel.
        name: name of the array.
    """
    problems = []
    received, on_bus = _identifiers(pdos, buses)
    for frame in frames:
        own = on_bus[frame.channel].get(frame.can_id)
        other = own or (None if frame.sent else received.get(frame.can_id))
        if other is None:
            continue
        if own:
            ways = f'on {frame.channel}; give it a separate bus (sensor.channel = "can1"), or take other node ids'
        else:
            ways = "on another bus, and the cell knows what it receives by the identifier alone; take other node ids"
        problems.append(f"array {name}: its {frame.what} frame {frame.can_id:03X}h is {other} {ways}")
    if len(problems) > 1:
        return [f"{problems[0]} ({len(problems) - 1} more of its identifiers are taken too)"]
    return problems


def _identifiers(
    pdos: list[PlannedPdo], buses: Mapping[str, tuple[int, ...]]
) -> tuple[dict[int, str], dict[str, dict[int, str]]]:
    """Frames that the cell receives on any bus, and all frames of each bus, by identifier."""
    received: dict[int, str] = {}
    on_bus: dict[str, dict[int, str]] = {}
    for channel, node_ids in buses.items():
        here = on_bus[channel] = {
            NMT_ID: "NMT",
            SYNC_ID: "SYNC",
            HEARTBEAT_BASE + MASTER_NODE_ID: "the heartbeat of the master",
        }
        for node_id in node_ids:
            its = {
                HEARTBEAT_BASE + node_id: f"the heartbeat of node {node_id}",
                EMCY_BASE + node_id: f"the EMCY of node {node_id}",
                SDO_TX_BASE + node_id: f"the SDO answer of node {node_id}",
            }
            mine = [pdo for pdo in pdos if pdo.node_id == node_id]
            its |= {pdo.cob_id: f"TPDO{pdo.number} of node {node_id}" for pdo in mine if pdo.direction == "tpdo"}
            received |= its
            here |= its | {SDO_RX_BASE + node_id: f"the SDO request to node {node_id}"}
            here |= {pdo.cob_id: f"RPDO{pdo.number} of node {node_id}" for pdo in mine if pdo.direction == "rpdo"}
    for common in (NMT_ID, SYNC_ID, HEARTBEAT_BASE + MASTER_NODE_ID):
        received[common] = next(iter(on_bus.values()))[common]
    return received, on_bus
