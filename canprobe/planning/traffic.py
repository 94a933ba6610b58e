"""Does it fit the bus: average load, peak demand behind one SYNC, worst-case response time of every message."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

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
from canprobe.protocol.frame_bits import (
    best_case_bits,
    best_case_fd_bits,
    exact_bits,
    exact_fd_bits,
    worst_case_bits,
    worst_case_fd_bits,
)
from canprobe.protocol.frames import HEARTBEAT_BASE, SYNC_ID
from canprobe.protocol.response_times import (
    BusAnalysis,
    Message,
    Response,
    worst_case_response,
    worst_case_response_fifo,
)
from canprobe.scene.setup import Bus

# How much of a bus a PDO takes: a classical frame, or above 8 bytes one of CAN FD with bit-rate switch.

CLASSIC_BYTES = 8


def frame_bits(n_data: int, bus: Bus) -> int:
    """Worst case of one frame in bit times of the nominal rate; the data phase of an FD frame rounded up.

    Args:
        n_data: data bytes.
        bus: its two bit rates.
    """
    if n_data <= CLASSIC_BYTES:
        return worst_case_bits(n_data)
    worst = worst_case_fd_bits(n_data)
    return worst.nominal - (-worst.data * bus.bitrate // bus.data_bitrate)


def exact_frame_bits(can_id: int, data: bytes, bus: Bus) -> int:
    """Bits of this very frame, in the same bit times."""
    if len(data) <= CLASSIC_BYTES:
        return exact_bits(can_id, data)
    exact = exact_fd_bits(can_id, data)
    return exact.nominal - (-exact.data * bus.bitrate // bus.data_bitrate)


def unstuffed_frame_bits(n_data: int, bus: Bus) -> int:
    """Bits of a frame without stuff bits, as `canbusload -i` counts, in the same bit times."""
    if n_data <= CLASSIC_BYTES:
        return best_case_bits(n_data)
    best = best_case_fd_bits(n_data)
    return best.nominal - (-best.data * bus.bitrate // bus.data_bitrate)


# The cycle as one transaction behind SYNC: TPDOs, controller, RPDOs, and how much of the period they leave.
#
# A node queues its TPDOs when it has received the SYNC. The cell looks for them at fixed shares of the period and once
# at the time by which the last one must be in; in real time, after the first look, at each that comes. So the
# controller starts when the last one comes, but not before the first look, or at the next look; it takes at most the
# scene's `cycle.compute_us`, and its RPDOs follow. Their latest queueing hangs on the TPDOs' response times and those
# on the SYNC's: the analysis is repeated until nothing moves (Palencia and González Harbour 1998, dynamic offsets).
#
# Where nodes send their oldest frame first, what has to wait behind its own node's heartbeat hangs on no phase: the
# bound for FIFO queues, which knows no offsets, takes the place of the one for priority queues.

FIRST_LOOK, LAST_LOOK = 0.25, 0.6
"""Shares of the period at which the cell looks for TPDOs besides the planned time; after the last they are late."""
_ROUNDS = 20


@dataclass(frozen=True, slots=True)
class CycleMessages:
    """Everything on a bus, by its part in the cycle.

    Attributes:
        sync: the SYNC; its offset is 0.
        feedback: TPDOs that the controller waits for.
        commands: RPDOs that it sends.
        other: TPDOs that it does not wait for, of the sensor.
        strangers: what keeps its own time.
        best_sync_ns: shortest time of a SYNC on the wire.
        best_feedback_ns: shortest time of the feedback.
        fifo_nodes: name of every message that goes through a FIFO transmit queue → the node; empty: priority queues.
    """

    sync: Message
    feedback: tuple[Message, ...]
    commands: tuple[Message, ...]
    other: tuple[Message, ...]
    strangers: tuple[Message, ...]
    best_sync_ns: int
    best_feedback_ns: int
    fifo_nodes: Mapping[str, int] = field(default_factory=dict)


def analyse_cycle(messages: CycleMessages, compute_ns: int, bitrate: int) -> tuple[BusAnalysis, CycleBudget]:
    """Response times behind SYNC, and the budget of one cycle.

    Args:
        messages: of one bus.
        compute_ns: what the controller takes at most.
        bitrate: bit/s.

    Returns:
        The analysis, each response counted from the SYNC (a stranger's from its own event), and the budget.
    """
    period = messages.sync.period_ns
    sync_ns, feedback_ns = messages.best_sync_ns, max(messages.best_sync_ns, messages.best_feedback_ns)
    for _ in range(_ROUNDS):
        looks = look_times(period, feedback_ns)
        placed = _placed(messages, sync_ns, looks, feedback_ns, compute_ns)
        analysis = _analyse(placed, messages.fifo_nodes, bitrate)
        late_sync = _last(analysis, (messages.sync,))
        late_feedback = _last(analysis, messages.feedback) if messages.feedback else late_sync
        if (
            late_sync is None
            or late_feedback is None
            or analysis.load >= 1
            or (late_sync, late_feedback) == (sync_ns, feedback_ns)
        ):
            break
        sync_ns, feedback_ns = late_sync, late_feedback
    else:
        analysis = _without_bound(analysis)
    return analysis, _budget(messages, analysis, looks, feedback_ns, compute_ns)


def _analyse(placed: Sequence[Message], fifo_nodes: Mapping[str, int], bitrate: int) -> BusAnalysis:
    if fifo_nodes:
        return worst_case_response_fifo(placed, fifo_nodes, bitrate)
    return worst_case_response(placed, bitrate)


def _without_bound(analysis: BusAnalysis) -> BusAnalysis:
    """What is left where the rounds do not come to an end."""
    return dataclasses.replace(
        analysis, responses=tuple(dataclasses.replace(one, response_ns=None) for one in analysis.responses)
    )


def look_times(period_ns: int, feedback_ns: int | None) -> tuple[int, ...]:
    """When the cell looks for TPDOs, ns after the SYNC's deadline.

    Args:
        period_ns: of SYNC.
        feedback_ns: by when they are in at the latest; None where that is not known or nothing is waited for.
    """
    first, last = int(period_ns * FIRST_LOOK), int(period_ns * LAST_LOOK)
    known = {first, last} if feedback_ns is None else {first, last, min(feedback_ns, period_ns)}
    return tuple(sorted(look for look in known if look >= first))


def controller_starts(messages: CycleMessages, looks: Sequence[int], feedback_ns: int) -> tuple[int, int]:
    """Earliest and latest start of the controller after the SYNC, ns."""
    if not messages.feedback:
        return looks[0], looks[0]
    earliest = min(max(looks[0], messages.best_feedback_ns), looks[-1])
    return earliest, next((look for look in looks if look >= feedback_ns), looks[-1])


def _placed(
    messages: CycleMessages, sync_ns: int, looks: Sequence[int], feedback_ns: int, compute_ns: int
) -> list[Message]:
    answered = messages.best_sync_ns
    earliest, latest = controller_starts(messages, looks, feedback_ns)
    answers = [
        dataclasses.replace(m, offset_ns=answered, jitter_ns=sync_ns - answered)
        for m in (*messages.feedback, *messages.other)
    ]
    commands = [
        dataclasses.replace(m, offset_ns=earliest, jitter_ns=latest + compute_ns - earliest) for m in messages.commands
    ]
    return [dataclasses.replace(messages.sync, offset_ns=0), *answers, *commands, *messages.strangers]


def _last(analysis: BusAnalysis, messages: Sequence[Message]) -> int | None:
    """The latest end of several messages after the SYNC; None without a bound."""
    names = {message.name for message in messages}
    found = [response.response_ns for response in analysis.responses if response.message.name in names]
    return None if None in found or not found else max(ns for ns in found if ns is not None)


def _budget(
    messages: CycleMessages, analysis: BusAnalysis, looks: tuple[int, ...], feedback_ns: int, compute_ns: int
) -> CycleBudget:
    period = messages.sync.period_ns
    sync_ns, tactile = _last(analysis, (messages.sync,)), _last(analysis, messages.other)
    feedback, commands = _last(analysis, messages.feedback), _last(analysis, messages.commands)
    _, start = controller_starts(messages, looks, feedback_ns)
    known = not messages.feedback or feedback is not None
    out = (start + compute_ns if known else None) if not messages.commands else commands
    return CycleBudget(
        period_ns=period,
        looks_ns=looks,
        sync_ns=sync_ns,
        feedback_ns=feedback,
        start_ns=start if known else None,
        compute_ns=compute_ns,
        commands_ns=commands,
        tactile_ns=tactile,
        slack_ns=None if out is None else period - out,
    )


# Does it fit the bus: average load, peak demand behind one SYNC, worst-case response time of every message.

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
