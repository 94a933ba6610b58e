"""Does it fit the bus: average load, peak demand behind one SYNC, worst-case response time of every message."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from canprobe.planning.budget import CycleMessages, analyse_cycle
from canprobe.planning.model import (
    HEARTBEAT_PRODUCED_MS,
    MASTER_NODE_ID,
    SYNC_OVERFLOW,
    CycleBudget,
    Demand,
    PlannedPdo,
    SyncPlan,
    Traffic,
)
from canprobe.protocol.frames import HEARTBEAT_BASE, SYNC_ID
from canprobe.protocol.timing import Message, Response, best_case_bits, worst_case_bits
from canprobe.scene_setup import Bus

_SYNC_BYTES = 1 if SYNC_OVERFLOW else 0
_SYNC_BITS = worst_case_bits(_SYNC_BYTES)
SYNCHRONOUS = 240


def on_the_wire(pdos: Sequence[PlannedPdo]) -> list[PlannedPdo]:
    """One PDO for every identifier: an RPDO that two drives read is sent once."""
    return sorted({pdo.cob_id: pdo for pdo in reversed(pdos)}.values(), key=lambda pdo: pdo.cob_id)


def plan_traffic(
    pdos: Sequence[PlannedPdo], sync: SyncPlan, node_ids: Sequence[int], bus: Bus, compute_ns: int = 0
) -> tuple[Traffic, list[PlannedPdo], list[str]]:
    """Traffic of a set of PDOs, the PDOs with their response times, and what does not fit.

    Args:
        pdos: of all nodes.
        sync: the cycle.
        node_ids: everything that produces a heartbeat, besides the master.
        bus: its bit rate.
        compute_ns: what the controller takes of a cycle at most.
    """
    wire = on_the_wire(pdos)
    analysis, budget = analyse_cycle(_messages(wire, sync, node_ids, bus), compute_ns, bus.bitrate)
    responses = {response.message.cob_id: response for response in analysis.responses}
    traffic = Traffic(
        load=analysis.load,
        parts=_parts(wire, sync, node_ids, bus.bitrate),
        demands=_demands(wire, sync, bus.bitrate),
        sync_response_ns=responses[SYNC_ID].response_ns,
        budget=budget,
    )
    timed = [dataclasses.replace(pdo, response_ns=responses[pdo.cob_id].response_ns) for pdo in pdos]
    timed.sort(key=lambda pdo: (pdo.cob_id, pdo.node_id))
    return traffic, timed, _problems(traffic, analysis.responses, bus)


def _messages(wire: Sequence[PlannedPdo], sync: SyncPlan, node_ids: Sequence[int], bus: Bus) -> CycleMessages:
    """What SYNC triggers, by its part in the cycle, and what keeps its own time."""
    bitrate = bus.bitrate
    cyclic = [pdo for pdo in wire if pdo.transmission_type <= SYNCHRONOUS]
    feedback = [pdo for pdo in cyclic if pdo.direction == "tpdo" and pdo.kind == "drive"]
    heartbeats = [
        Message(_heartbeat(node), HEARTBEAT_BASE + node, 1, HEARTBEAT_PRODUCED_MS * 1_000_000)
        for node in (*node_ids, MASTER_NODE_ID)
    ]
    best_sync = best_case_bits(_SYNC_BYTES)
    return CycleMessages(
        sync=Message("SYNC", SYNC_ID, _SYNC_BYTES, sync.period_ns),
        feedback=tuple(_message(pdo, sync, bitrate) for pdo in feedback),
        commands=tuple(_message(pdo, sync, bitrate) for pdo in cyclic if pdo.direction == "rpdo"),
        other=tuple(_message(pdo, sync, bitrate) for pdo in cyclic if pdo.direction == "tpdo" and pdo not in feedback),
        strangers=(*(_message(pdo, sync, bitrate) for pdo in wire if pdo not in cyclic), *heartbeats),
        best_sync_ns=best_sync * 1_000_000_000 // bitrate,
        best_feedback_ns=(best_sync + sum(best_case_bits(pdo.layout.length) for pdo in feedback))
        * 1_000_000_000
        // bitrate,
        fifo_nodes=_senders(wire, node_ids) if bus.transmit_queue == "fifo" else {},
    )


def _senders(wire: Sequence[PlannedPdo], node_ids: Sequence[int]) -> dict[str, int]:
    """Name of every message → the node in whose transmit queue it waits."""
    pdos = {_name(pdo): pdo.node_id if pdo.direction == "tpdo" else MASTER_NODE_ID for pdo in wire}
    heartbeats = {_heartbeat(node): node for node in (*node_ids, MASTER_NODE_ID)}
    return {"SYNC": MASTER_NODE_ID, **pdos, **heartbeats}


def _name(pdo: PlannedPdo) -> str:
    return f"{pdo.direction.upper()} {pdo.cob_id:03X}h"


def _heartbeat(node_id: int) -> str:
    return f"heartbeat of node {node_id}"


def _message(pdo: PlannedPdo, sync: SyncPlan, bitrate: int) -> Message:
    frame_ns, period_ns = _ns(pdo.bits_worst, bitrate), _period_ns(pdo, sync)
    return Message(_name(pdo), pdo.cob_id, pdo.layout.length, period_ns, deadline_ns=pdo.deadline_ns, frame_ns=frame_ns)


def _period_ns(pdo: PlannedPdo, sync: SyncPlan) -> int:
    if pdo.transmission_type <= SYNCHRONOUS:
        return sync.period_ns * pdo.transmission_type
    return round(1e9 / pdo.rate_hz)


def _parts(
    wire: Sequence[PlannedPdo], sync: SyncPlan, node_ids: Sequence[int], bitrate: int
) -> tuple[tuple[str, float], ...]:
    heartbeats = worst_case_bits(1) * 1000 / HEARTBEAT_PRODUCED_MS * (len(node_ids) + 1)
    bits = {
        "SYNC": _SYNC_BITS * sync.rate_hz,
        "drives": sum(pdo.bits_worst * pdo.rate_hz for pdo in wire if pdo.kind == "drive"),
        "tactile": sum(pdo.bits_worst * pdo.rate_hz for pdo in wire if pdo.kind == "tactile"),
        "heartbeats": heartbeats,
    }
    return tuple((what, rate / bitrate) for what, rate in bits.items() if rate > 0)


def _demands(wire: Sequence[PlannedPdo], sync: SyncPlan, bitrate: int) -> tuple[Demand, ...]:
    """What one SYNC releases, and what a tactile frame waits for until its last PDO is through."""
    cyclic = [pdo for pdo in wire if pdo.transmission_type <= SYNCHRONOUS]
    drives = _SYNC_BITS + sum(pdo.bits_worst for pdo in cyclic if pdo.kind == "drive")
    tactile = [pdo for pdo in cyclic if pdo.kind == "tactile"]
    what = "SYNC and drive PDOs" if drives > _SYNC_BITS else "SYNC"
    demands = [Demand(what, 1, _ns(drives, bitrate), sync.period_ns)]
    if tactile:
        cycles = tactile[0].deadline_ns // sync.period_ns
        used = cycles * drives + sum(pdo.bits_worst for pdo in tactile)
        demands.append(Demand("tactile frame and all above it", cycles, _ns(used, bitrate), cycles * sync.period_ns))
    return tuple(demands)


def _ns(bits: int, bitrate: int) -> int:
    return -(-bits * 1_000_000_000 // bitrate)


def _problems(traffic: Traffic, responses: Sequence[Response], bus: Bus) -> list[str]:
    where = f"bus {bus.channel} at {bus.bitrate} bit/s"
    if bus.transmit_queue == "fifo":
        where += ", every node's oldest frame first"
    problems = []
    if traffic.load > 1:
        parts = ", ".join(f"{what} {100 * share:.0f} %" for what, share in traffic.parts)
        problems.append(f"{where}: worst-case load {100 * traffic.load:.0f} % ({parts})")
    problems += [
        f"{where}: {demand.what} take {demand.used_ns / 1000:.0f} µs of the {demand.available_ns / 1000:.0f} µs "
        f"in {demand.cycles} cycle{'s' if demand.cycles > 1 else ''}"
        for demand in traffic.demands
        if demand.used_ns > demand.available_ns
    ]
    if not problems and (short := _short(traffic.budget)):
        problems.append(f"{where}: {short}")
    late = [response for response in responses if not response.fits]
    if late and not problems:
        problems.append(f"{where}: {_late(late)}")
    return problems


def _short(budget: CycleBudget) -> str | None:
    """What is wrong with one cycle: the last RPDO is not through before the next SYNC."""
    if budget.slack_ns is None or budget.start_ns is None or budget.slack_ns >= 0:
        return None
    out = budget.period_ns - budget.slack_ns
    last = "the last RPDO is through" if budget.commands_ns is not None else "the controller is done"
    return (
        f"one cycle: the controller can start after {budget.start_ns / 1000:.0f} µs, takes "
        f"{budget.compute_ns / 1000:.0f} µs (cycle.compute_us), and {last} after {out / 1000:.0f} µs, "
        f"{-budget.slack_ns / 1000:.0f} µs behind the next SYNC"
    )


def _late(late: Sequence[Response]) -> str:
    first = late[0]
    more = f" and {len(late) - 1} more" if len(late) > 1 else ""
    response = "without bound" if first.response_ns is None else f"{first.response_ns / 1000:.0f} µs"
    return (
        f"worst-case response time of {first.message.name} is {response}, its deadline "
        f"{first.message.due_ns / 1000:.0f} µs{more}"
    )
