"""The cycle as one transaction behind SYNC: TPDOs, controller, RPDOs, and how much of the period they leave.

A node queues its TPDOs when it has received the SYNC. The cell looks for them at fixed shares of the period and once
at the time by which the last one must be in; in real time, after the first look, at each that comes. So the
controller starts when the last one comes, but not before the first look, or at the next look; it takes at most the
scene's `cycle.compute_us`, and its RPDOs follow. Their latest queueing hangs on the TPDOs' response times and those
on the SYNC's: the analysis is repeated until nothing moves (Palencia and González Harbour 1998, dynamic offsets).

Where nodes send their oldest frame first, what has to wait behind its own node's heartbeat hangs on no phase: the
bound for FIFO queues, which knows no offsets, takes the place of the one for priority queues.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from canprobe.cell.planning.model import (
    HEARTBEAT_PRODUCED_MS,
    MASTER_NODE_ID,
    SYNC_OVERFLOW,
    CycleBudget,
    Demand,
    PlannedBus,
    PlannedFrames,
    PlannedPdo,
    SyncPlan,
    Traffic,
)
from canprobe.cell.scene.hardware import BusSettings
from canprobe.fieldbus.protocol.frame_bits import best_case_bits, worst_case_bits
from canprobe.fieldbus.protocol.frames import HEARTBEAT_BASE, SYNC_ID
from canprobe.fieldbus.protocol.response_times import (
    BusAnalysis,
    Message,
    Response,
    worst_case_response,
    worst_case_response_fifo,
)

FIRST_LOOK, LAST_LOOK = 0.25, 0.6
"""Shares of the period at which the cell looks for TPDOs besides the planned time; after the last one they are late."""
MAX_ROUNDS = 20
"""Most rounds of the analysis; where times still change after them there is no bound."""
_SYNC_BYTES = 1 if SYNC_OVERFLOW else 0
SYNC_BITS = worst_case_bits(_SYNC_BYTES)
SYNC_BITS_LEAST = best_case_bits(_SYNC_BYTES)


@dataclass(frozen=True, slots=True)
class _Messages:
    """All messages of a bus, by their part in the cycle.

    Attributes:
        sync: the SYNC; its offset is 0.
        feedback: TPDOs that the controller waits for.
        commands: RPDOs that it sends.
        other: TPDOs that it does not wait for: those of the array, and unused ones.
        strangers: messages that SYNC does not trigger.
        best_sync_ns: shortest time of a SYNC on the wire.
        best_feedback_ns: shortest time of the feedback.
        fifo_nodes: node of every message in a FIFO transmit queue, by the message's name; empty: priority queues.
    """

    sync: Message
    feedback: tuple[Message, ...]
    commands: tuple[Message, ...]
    other: tuple[Message, ...]
    strangers: tuple[Message, ...]
    best_sync_ns: int
    best_feedback_ns: int
    fifo_nodes: Mapping[str, int]


def on_the_wire(pdos: Sequence[PlannedPdo]) -> list[PlannedPdo]:
    """One PDO for every identifier: an RPDO that two drives read is sent once."""
    return sorted({pdo.cob_id: pdo for pdo in reversed(pdos)}.values(), key=lambda pdo: pdo.cob_id)


def wire_ns(bits: int, bitrate: int) -> int:
    """Time of a number of bits, rounded up."""
    return -(-bits * 1_000_000_000 // bitrate)


RAW_DEVICE = 0
"""Stands for the node id of an array that is no CANopen node, for its transmit queue."""


@dataclass(frozen=True, slots=True)
class PlannedTraffic:
    """Traffic of all buses.

    Attributes:
        buses: the buses with their traffic.
        pdos, raw: PDOs and raw frames with their response times.
        problems: what does not fit.
    """

    buses: tuple[PlannedBus, ...]
    pdos: tuple[PlannedPdo, ...]
    raw: tuple[PlannedFrames, ...]
    problems: list[str]


def plan_traffic(
    pdos: Sequence[PlannedPdo],
    sync: SyncPlan,
    channels: Mapping[str, tuple[int, ...]],
    bus: BusSettings,
    compute_ns: int = 0,
    *,
    raw: Sequence[PlannedFrames] = (),
) -> PlannedTraffic:
    """The buses with their traffic, PDOs and raw frames with their response times, and what does not fit.

    Args:
        pdos: PDOs of all nodes.
        sync: rate and period of SYNC, which every bus has.
        channels: node ids by channel; each node produces heartbeats, and so does the master.
        bus: settings of all buses, such as the bit rate.
        compute_ns: longest computing time of the controller in a cycle.
        raw: raw frames of an array that is no CANopen node.
    """
    wires = [on_the_wire([pdo for pdo in pdos if pdo.channel == channel]) for channel in channels]
    raws = [[frames for frames in raw if frames.channel == channel] for channel in channels]
    messages = [
        _messages(wire, its, sync, ids, bus) for wire, its, ids in zip(wires, raws, channels.values(), strict=True)
    ]
    analyses, budget = _analyse(messages, compute_ns, bus.bitrate)
    buses: list[PlannedBus] = []
    timed: list[PlannedPdo] = []
    raw_timed: list[PlannedFrames] = []
    for (channel, node_ids), wire, its, analysis in zip(channels.items(), wires, raws, analyses, strict=True):
        response_ns = {response.message.cob_id: response.response_ns for response in analysis.responses}
        bits_per_s = {
            "SYNC": SYNC_BITS * sync.rate_hz,
            "drives": sum(pdo.bits_worst * pdo.rate_hz for pdo in wire if pdo.kind == "drive"),
            "tactile": sum(pdo.bits_worst * pdo.rate_hz for pdo in wire if pdo.kind == "tactile")
            + sum(frames.bits_worst * frames.rate_hz for frames in its),
            "heartbeats": worst_case_bits(1) * 1000 / HEARTBEAT_PRODUCED_MS * (len(node_ids) + 1),
        }
        traffic = Traffic(
            load=analysis.load,
            parts=tuple((what, bits / bus.bitrate) for what, bits in bits_per_s.items() if bits > 0),
            demands=tuple(_demands(wire, sync, bus.bitrate)),
            sync_response_ns=response_ns[SYNC_ID],
            budget=budget,
        )
        buses.append(PlannedBus(channel, node_ids, traffic))
        mine = [replace(pdo, response_ns=response_ns[pdo.cob_id]) for pdo in pdos if pdo.channel == channel]
        timed += sorted(mine, key=lambda pdo: (pdo.cob_id, pdo.node_id))
        raw_timed += [replace(frames, response_ns=response_ns.get(frames.can_id)) for frames in its]
    return PlannedTraffic(tuple(buses), tuple(timed), tuple(raw_timed), _problems(buses, analyses, bus))


def _raw_messages(raw: Sequence[PlannedFrames], bus: BusSettings) -> Iterator[Message]:
    """Raw frames that repeat, one message for each identifier: its frames follow one another."""
    repeated: dict[int, list[PlannedFrames]] = {}
    for frames in raw:
        if frames.rate_hz > 0:
            repeated.setdefault(frames.can_id, []).append(frames)
    for can_id, all_of_it in repeated.items():
        bits = sum(frames.bits_worst for frames in all_of_it)
        period = round(1e9 / all_of_it[0].rate_hz)
        length = max(frames.length for frames in all_of_it)
        yield Message(f"raw frames {can_id:03X}h", can_id, length, period, frame_ns=wire_ns(bits, bus.bitrate))


def _messages(
    wire: Sequence[PlannedPdo], raw: Sequence[PlannedFrames], sync: SyncPlan, node_ids: Sequence[int], bus: BusSettings
) -> _Messages:
    """Messages that SYNC triggers, by their part in the cycle, and those that it does not."""
    queues = {"SYNC": MASTER_NODE_ID}
    cyclic: dict[str, list[Message]] = {"feedback": [], "commands": [], "other": []}
    strangers, feedback_bits = [], SYNC_BITS_LEAST
    for pdo in wire:
        triggered = pdo.layout.synchronous
        message = Message(
            f"{pdo.direction.upper()} {pdo.cob_id:03X}h",
            pdo.cob_id,
            pdo.layout.length,
            sync.period_ns * pdo.transmission_type if triggered else round(1e9 / pdo.rate_hz),
            deadline_ns=pdo.deadline_ns,
            frame_ns=wire_ns(pdo.bits_worst, bus.bitrate),
        )
        queues[message.name] = pdo.node_id if pdo.direction == "tpdo" else MASTER_NODE_ID
        if not triggered:
            strangers.append(message)
        elif pdo.direction == "rpdo":
            cyclic["commands"].append(message)
        elif pdo.kind == "drive" and pdo.used:
            cyclic["feedback"].append(message)
            feedback_bits += best_case_bits(pdo.layout.length)
        else:
            cyclic["other"].append(message)
    for message in _raw_messages(raw, bus):
        strangers.append(message)
        queues[message.name] = RAW_DEVICE
    for node in (*node_ids, MASTER_NODE_ID):
        name = f"heartbeat of node {node}"
        strangers.append(Message(name, HEARTBEAT_BASE + node, 1, HEARTBEAT_PRODUCED_MS * 1_000_000))
        queues[name] = node
    return _Messages(
        sync=Message("SYNC", SYNC_ID, _SYNC_BYTES, sync.period_ns),
        **{part: tuple(messages) for part, messages in cyclic.items()},
        strangers=tuple(strangers),
        best_sync_ns=SYNC_BITS_LEAST * 1_000_000_000 // bus.bitrate,
        best_feedback_ns=feedback_bits * 1_000_000_000 // bus.bitrate,
        fifo_nodes=queues if bus.transmit_queue == "fifo" else {},
    )


def _analyse(buses: Sequence[_Messages], compute_ns: int, bitrate: int) -> tuple[list[BusAnalysis], CycleBudget]:
    """Response times of each bus behind SYNC (of a stranger behind its own event), and the budget of one cycle.

    The controller couples the buses: it starts when the feedback of all of them is in.
    """
    period = buses[0].sync.period_ns
    best_ns = max(one.best_feedback_ns for one in buses) if any(one.feedback for one in buses) else None
    syncs_ns: list[int] = [one.best_sync_ns for one in buses]
    feedback_ns = max(*syncs_ns, best_ns or 0)
    for _ in range(MAX_ROUNDS):
        looks = look_times(period, feedback_ns)
        starts = controller_starts(best_ns, looks, feedback_ns)
        analyses = [
            _placed(one, sync_ns, starts, compute_ns, bitrate) for one, sync_ns in zip(buses, syncs_ns, strict=True)
        ]
        late_syncs = [_last([analysis], [one.sync]) for one, analysis in zip(buses, analyses, strict=True)]
        late_feedback = _last(analyses, [m for one in buses for m in (one.feedback or ([] if best_ns else [one.sync]))])
        moved = (late_syncs, late_feedback) != (syncs_ns, feedback_ns)
        full = any(analysis.load >= 1 for analysis in analyses)
        if None in late_syncs or late_feedback is None or full or not moved:
            break
        syncs_ns, feedback_ns = [ns for ns in late_syncs if ns is not None], late_feedback
    else:  # the times do not settle: there is no bound
        analyses = [
            replace(analysis, responses=tuple(replace(one, response_ns=None) for one in analysis.responses))
            for analysis in analyses
        ]
    feedback = _last(analyses, [m for one in buses for m in one.feedback])
    commands = _last(analyses, [m for one in buses for m in one.commands])
    _, start = controller_starts(best_ns, looks, feedback_ns)
    known = best_ns is None or feedback is not None
    out = commands if any(one.commands for one in buses) else start + compute_ns if known else None
    return analyses, CycleBudget(
        period_ns=period,
        looks_ns=looks,
        sync_ns=_last(analyses, [buses[0].sync]),
        feedback_ns=feedback,
        start_ns=start if known else None,
        compute_ns=compute_ns,
        commands_ns=commands,
        tactile_ns=_last(analyses, [m for one in buses for m in one.other]),
        slack_ns=None if out is None else period - out,
    )


def _placed(
    messages: _Messages, sync_ns: int, starts_ns: tuple[int, int], compute_ns: int, bitrate: int
) -> BusAnalysis:
    """Response times of one bus.

    Args:
        messages: messages of the bus.
        sync_ns: latest time when its SYNC is through.
        starts_ns: earliest and latest start of the controller.
        compute_ns: longest computing time of the controller.
        bitrate: bit/s.
    """
    answered, (earliest, start) = messages.best_sync_ns, starts_ns
    placed = [
        replace(messages.sync, offset_ns=0),
        *(replace(m, offset_ns=answered, jitter_ns=sync_ns - answered) for m in (*messages.feedback, *messages.other)),
        *(replace(m, offset_ns=earliest, jitter_ns=start + compute_ns - earliest) for m in messages.commands),
        *messages.strangers,
    ]
    if messages.fifo_nodes:
        return worst_case_response_fifo(placed, messages.fifo_nodes, bitrate)
    return worst_case_response(placed, bitrate)


def look_times(period_ns: int, feedback_ns: int) -> tuple[int, ...]:
    """Times when the cell looks for TPDOs, ns after the SYNC's deadline.

    Args:
        period_ns: period of SYNC.
        feedback_ns: latest time when the TPDOs are in.
    """
    first, last = int(period_ns * FIRST_LOOK), int(period_ns * LAST_LOOK)
    return tuple(sorted(look for look in {first, last, min(feedback_ns, period_ns)} if look >= first))


def controller_starts(best_ns: int | None, looks: Sequence[int], feedback_ns: int) -> tuple[int, int]:
    """Earliest and latest start of the controller after the SYNC, ns.

    Args:
        best_ns: earliest time when all feedback can be in; None where the controller waits for none.
        looks: times when the cell looks for it.
        feedback_ns: latest time when it is in.
    """
    if best_ns is None:
        return looks[0], looks[0]
    earliest = min(max(looks[0], best_ns), looks[-1])
    return earliest, next((look for look in looks if look >= feedback_ns), looks[-1])


def _last(analyses: Sequence[BusAnalysis], messages: Sequence[Message]) -> int | None:
    """The latest end of several messages after the SYNC, on any bus; None without a bound."""
    names = {message.name for message in messages}
    found = [one.response_ns for analysis in analyses for one in analysis.responses if one.message.name in names]
    return None if None in found or not found else max(ns for ns in found if ns is not None)


def _demands(wire: Sequence[PlannedPdo], sync: SyncPlan, bitrate: int) -> Iterator[Demand]:
    """Demand of the frames that one SYNC releases, and of those for which a tactile frame waits."""
    cyclic = [pdo for pdo in wire if pdo.layout.synchronous]
    drives = SYNC_BITS + sum(pdo.bits_worst for pdo in cyclic if pdo.kind == "drive")
    tactile = [pdo for pdo in cyclic if pdo.kind == "tactile"]
    what = "SYNC and drive PDOs" if drives > SYNC_BITS else "SYNC"
    yield Demand(what, 1, wire_ns(drives, bitrate), sync.period_ns)
    if tactile:
        cycles = tactile[0].deadline_ns // sync.period_ns
        used = cycles * drives + sum(pdo.bits_worst for pdo in tactile)
        yield Demand("tactile frame and all above it", cycles, wire_ns(used, bitrate), cycles * sync.period_ns)


def _problems(buses: Sequence[PlannedBus], analyses: Sequence[BusAnalysis], bus: BusSettings) -> list[str]:
    """Problems: load and demands of a bus, or else the cycle, or else the first late message of each bus."""
    found = [(one.channel, problem) for one in buses for problem in _excess(one.traffic)]
    if not found and (behind := _behind(buses[0].traffic.budget)) is not None:
        found = [(" and ".join(one.channel for one in buses), behind)]
    else:
        full = {channel for channel, _ in found}
        for one, analysis in zip(buses, analyses, strict=True):
            if one.channel not in full and (late := [each for each in analysis.responses if not each.fits]):
                found.append((one.channel, _lateness(late)))
    queue = ", every node's oldest frame first" if bus.transmit_queue == "fifo" else ""
    return [f"bus {channel} at {bus.bitrate} bit/s{queue}: {problem}" for channel, problem in found]


def _excess(traffic: Traffic) -> Iterator[str]:
    """Load and demands of one bus that are more than it carries."""
    if traffic.load > 1:
        parts = ", ".join(f"{what} {100 * share:.0f} %" for what, share in traffic.parts)
        yield f"worst-case load {100 * traffic.load:.0f} % ({parts})"
    for demand in traffic.demands:
        if demand.used_ns > demand.available_ns:
            yield (
                f"{demand.what} take {demand.used_ns / 1000:.0f} µs of the {demand.available_ns / 1000:.0f} µs "
                f"in {demand.cycles} cycle{'s' if demand.cycles > 1 else ''}"
            )


def _behind(budget: CycleBudget) -> str | None:
    """Problem where the cycle ends behind the next SYNC; None where it does not, or has no bound."""
    if budget.slack_ns is None or budget.start_ns is None or budget.slack_ns >= 0:
        return None
    last = "the last RPDO is through" if budget.commands_ns is not None else "the controller is done"
    out_us, behind_us = (budget.period_ns - budget.slack_ns) / 1000, -budget.slack_ns / 1000
    return (
        f"one cycle: the controller can start after {budget.start_ns / 1000:.0f} µs, takes "
        f"{budget.compute_ns / 1000:.0f} µs (cycle.compute_us), and {last} after {out_us:.0f} µs, "
        f"{behind_us:.0f} µs behind the next SYNC"
    )


def _lateness(late: Sequence[Response]) -> str:
    """Problem of the first late message of a bus."""
    first = late[0]
    response = "without bound" if first.response_ns is None else f"{first.response_ns / 1000:.0f} µs"
    return (
        f"worst-case response time of {first.message.name} is {response}, its deadline "
        f"{first.message.due_ns / 1000:.0f} µs{f' and {len(late) - 1} more' if len(late) > 1 else ''}"
    )
