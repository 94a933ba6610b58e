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
from dataclasses import replace
from typing import NamedTuple

from canprobe.cell.planning.model import (
    HEARTBEAT_PRODUCED_MS,
    MASTER_NODE_ID,
    SYNC_OVERFLOW,
    CycleBudget,
    Demand,
    Part,
    PlannedBus,
    PlannedFrames,
    PlannedPdo,
    SyncPlan,
)
from canprobe.cell.planning.pdos import BusPlan
from canprobe.cell.scene.hardware import BusSettings
from canprobe.fieldbus.protocol.frame_bits import NS_PER_S, best_case_bits, worst_case_bits
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


class _BusMessage(NamedTuple):
    """A message of a bus.

    Attributes:
        message: the message.
        part: its part in the cycle.
        node: id of the node whose transmit queue it is in.
    """

    message: Message
    part: Part
    node: int


def on_the_wire(pdos: Sequence[PlannedPdo]) -> list[PlannedPdo]:
    """One PDO for every identifier: an RPDO that two drives read is sent once."""
    return sorted({pdo.cob_id: pdo for pdo in reversed(pdos)}.values(), key=lambda pdo: pdo.cob_id)


def wire_ns(bits: int, bitrate: int) -> int:
    """Time of a number of bits, rounded up."""
    return -(-bits * NS_PER_S // bitrate)


RAW_DEVICE = 0
"""Stands for the node id of an array that is no CANopen node, for its transmit queue."""


def plan_traffic(plan: BusPlan) -> None:
    """Fill in the buses with their traffic, the response times of PDOs and raw frames, and what does not fit."""
    bitrate, sync = plan.setup.bus.bitrate, plan.sync
    wires = {channel: on_the_wire([pdo for pdo in plan.pdos if pdo.channel == channel]) for channel in plan.channels}
    sent = [[*_messages(plan, channel, wire)] for channel, wire in wires.items()]
    analyses, plan.budget = _analyse(sent, plan)
    response_ns: dict[tuple[str, int], int | None] = {}
    for (channel, wire), analysis in zip(wires.items(), analyses, strict=True):
        response_ns |= {(channel, one.message.cob_id): one.response_ns for one in analysis.responses}
        drives, encoder, tactile = (
            sum(pdo.bits_worst * pdo.rate_hz for pdo in wire if pdo.kind == kind)
            for kind in ("drive", "encoder", "tactile")
        )
        heartbeats = 1000 / HEARTBEAT_PRODUCED_MS * (len(plan.channels[channel]) + 1)
        bits_per_s = {
            "SYNC": SYNC_BITS * sync.rate_hz,
            "drives": drives,
            "encoder": encoder,
            "tactile": tactile + sum(one.bits_worst * one.rate_hz for one in plan.raw if one.channel == channel),
            "heartbeats": worst_case_bits(1) * heartbeats,
        }
        bus = PlannedBus(
            channel,
            plan.channels[channel],
            load=analysis.load,
            parts=tuple((what, bits / bitrate) for what, bits in bits_per_s.items() if bits > 0),
            demands=tuple(_demands(wire, sync, bitrate)),
            sync_response_ns=response_ns[channel, SYNC_ID],
        )
        plan.buses.append(bus)
    timed = [replace(pdo, response_ns=response_ns[pdo.channel, pdo.cob_id]) for pdo in plan.pdos]
    plan.pdos = sorted(timed, key=lambda pdo: (list(wires).index(pdo.channel), pdo.cob_id, pdo.node_id))
    plan.raw = [replace(one, response_ns=response_ns.get((one.channel, one.can_id))) for one in plan.raw]
    plan.overload = _problems(plan, plan.budget, analyses)


def _raw_messages(raw: Sequence[PlannedFrames], bitrate: int) -> Iterator[Message]:
    """Raw frames that repeat, one message for each identifier: its frames follow one another."""
    repeated: dict[int, list[PlannedFrames]] = {}
    for frames in raw:
        if frames.rate_hz > 0:
            repeated.setdefault(frames.can_id, []).append(frames)
    for can_id, all_of_it in repeated.items():
        bits = sum(frames.bits_worst for frames in all_of_it)
        period = round(1e9 / all_of_it[0].rate_hz)
        length = max(frames.length for frames in all_of_it)
        yield Message(f"raw frames {can_id:03X}h", can_id, length, period, frame_ns=wire_ns(bits, bitrate))


def _messages(plan: BusPlan, channel: str, wire: Sequence[PlannedPdo]) -> Iterator[_BusMessage]:
    """The messages of one bus: its SYNC, its PDOs, raw frames and heartbeats."""
    bitrate, sync = plan.setup.bus.bitrate, plan.sync
    yield _BusMessage(Message("SYNC", SYNC_ID, _SYNC_BYTES, sync.period_ns), "SYNC", MASTER_NODE_ID)
    for pdo in wire:
        message = Message(
            f"{pdo.direction.upper()} {pdo.cob_id:03X}h",
            pdo.cob_id,
            pdo.layout.length,
            sync.period_ns * pdo.transmission_type if pdo.layout.synchronous else round(1e9 / pdo.rate_hz),
            deadline_ns=pdo.deadline_ns,
            frame_ns=wire_ns(pdo.bits_worst, bitrate),
        )
        yield _BusMessage(message, pdo.part, pdo.node_id if pdo.direction == "tpdo" else MASTER_NODE_ID)
    for message in _raw_messages([one for one in plan.raw if one.channel == channel], bitrate):
        yield _BusMessage(message, "event", RAW_DEVICE)
    for node in (*plan.channels[channel], MASTER_NODE_ID):
        beat = Message(f"heartbeat of node {node}", HEARTBEAT_BASE + node, 1, HEARTBEAT_PRODUCED_MS * 1_000_000)
        yield _BusMessage(beat, "event", node)


def _analyse(buses: Sequence[Sequence[_BusMessage]], plan: BusPlan) -> tuple[list[BusAnalysis], CycleBudget]:
    """Response times of each bus behind SYNC (of an event behind itself), and the budget of one cycle.

    The controller couples the buses: it starts when the feedback of all of them is in.
    """
    period_ns, compute_ns = plan.sync.period_ns, plan.setup.compute_ns
    feedback_bits = [sum(best_case_bits(one.message.n_data) for one in bus if one.part == "feedback") for bus in buses]
    best_sync_ns, best_all_ns = (
        (SYNC_BITS_LEAST + bits) * NS_PER_S // plan.setup.bus.bitrate for bits in (0, max(feedback_bits))
    )
    best_ns = best_all_ns if any(feedback_bits) else None
    awaited: Part = "SYNC" if best_ns is None else "feedback"
    syncs_ns, feedback_ns = [best_sync_ns] * len(buses), best_ns or best_sync_ns
    for _ in range(MAX_ROUNDS):
        looks = look_times(period_ns, feedback_ns)
        earliest, latest = controller_starts(best_ns, looks, feedback_ns)
        analyses = []
        for one, sync_ns in zip(buses, syncs_ns, strict=True):
            answers = best_sync_ns, sync_ns - best_sync_ns
            commands = earliest, latest + compute_ns - earliest
            queued: dict[Part, tuple[int, int]] = {
                "SYNC": (0, 0), "feedback": answers, "tactile": answers, "other": answers, "command": commands,
            }  # fmt: skip
            analyses.append(_placed(one, queued, plan.setup.bus))
        late_syncs = [_last([one], [analysis], "SYNC") for one, analysis in zip(buses, analyses, strict=True)]
        late_feedback = _last(buses, analyses, awaited)
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
    feedback, commands_ns = _last(buses, analyses, "feedback"), _last(buses, analyses, "command")
    _, start = controller_starts(best_ns, looks, feedback_ns)
    known = best_ns is None or feedback is not None
    commanded = any(one.part == "command" for bus in buses for one in bus)
    out = commands_ns if commanded else start + compute_ns if known else None
    return analyses, CycleBudget(
        period_ns=period_ns,
        looks_ns=looks,
        sync_ns=_last(buses, analyses, "SYNC"),
        feedback_ns=feedback,
        start_ns=start if known else None,
        compute_ns=compute_ns,
        commands_ns=commands_ns,
        tactile_ns=_last(buses, analyses, "tactile", "other"),
        slack_ns=None if out is None else period_ns - out,
    )


def _placed(sent: Sequence[_BusMessage], queued: Mapping[Part, tuple[int, int]], settings: BusSettings) -> BusAnalysis:
    """Response times of one bus.

    Args:
        sent: messages of the bus.
        queued: earliest queueing after SYNC and its jitter, ns, by part; a part that is missing hangs on no SYNC.
        settings: bit rate and transmit queues.
    """
    placed = [
        replace(one.message, offset_ns=queued[one.part][0], jitter_ns=queued[one.part][1])
        if one.part in queued
        else one.message
        for one in sent
    ]
    if settings.transmit_queue == "fifo":
        return worst_case_response_fifo(placed, {one.message.name: one.node for one in sent}, settings.bitrate)
    return worst_case_response(placed, settings.bitrate)


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


def _last(buses: Sequence[Sequence[_BusMessage]], analyses: Sequence[BusAnalysis], *parts: Part) -> int | None:
    """The latest end of the messages of some parts after the SYNC, on any bus; None without a bound."""
    found: list[int | None] = []
    for bus, analysis in zip(buses, analyses, strict=True):
        ids = {one.message.cob_id for one in bus if one.part in parts}
        found += [one.response_ns for one in analysis.responses if one.message.cob_id in ids]
    return None if None in found or not found else max(ns for ns in found if ns is not None)


def _demands(wire: Sequence[PlannedPdo], sync: SyncPlan, bitrate: int) -> Iterator[Demand]:
    """Demand of the frames that one SYNC releases, and of those for which a tactile frame waits."""
    cyclic = [pdo for pdo in wire if pdo.layout.synchronous]
    drives = SYNC_BITS + sum(pdo.bits_worst for pdo in cyclic if pdo.kind != "tactile")
    tactile = [pdo for pdo in cyclic if pdo.kind == "tactile"]
    what = "SYNC and drive PDOs" if drives > SYNC_BITS else "SYNC"
    yield Demand(what, 1, wire_ns(drives, bitrate), sync.period_ns)
    if tactile:
        cycles = tactile[0].deadline_ns // sync.period_ns
        used = cycles * drives + sum(pdo.bits_worst for pdo in tactile)
        yield Demand("tactile frame and all above it", cycles, wire_ns(used, bitrate), cycles * sync.period_ns)


def _problems(plan: BusPlan, budget: CycleBudget, analyses: Sequence[BusAnalysis]) -> list[str]:
    """Problems: load and demands of a bus, or else the cycle, or else the first late message of each bus."""
    settings = plan.setup.bus
    found = [(one.channel, problem) for one in plan.buses for problem in _excess(one)]
    if not found and (behind := _behind(budget)) is not None:
        found = [(" and ".join(plan.channels), behind)]
    else:
        full = {channel for channel, _ in found}
        for channel, analysis in zip(plan.channels, analyses, strict=True):
            if channel not in full and (late := [each for each in analysis.responses if not each.fits]):
                found.append((channel, _lateness(late)))
    queue = ", every node's oldest frame first" if settings.transmit_queue == "fifo" else ""
    return [f"bus {channel} at {settings.bitrate} bit/s{queue}: {problem}" for channel, problem in found]


def _excess(bus: PlannedBus) -> Iterator[str]:
    """Load and demands of one bus that are more than it carries."""
    if bus.load > 1:
        parts = ", ".join(f"{what} {100 * share:.0f} %" for what, share in bus.parts)
        yield f"worst-case load {100 * bus.load:.0f} % ({parts})"
    for demand in bus.demands:
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
