"""The cycle as one transaction behind SYNC: TPDOs, controller, RPDOs, and how much of the period they leave.

A node queues its TPDOs when it has received the SYNC. The cell looks for them at fixed shares of the period and once at
the time by which the last one must be in; in real time, after the first look, at each that comes. So the controller
starts when the last one comes, but not before the first look, or at the next look; it takes at most the scene's
`cycle.compute_us`, and its RPDOs follow. Their latest queueing hangs on the TPDOs' response times and those on the
SYNC's: the analysis is repeated until nothing moves (Palencia and González Harbour 1998, dynamic offsets).

Where nodes send their oldest frame first, what has to wait behind its own node's heartbeat hangs on no phase: the bound
for FIFO queues, which knows no offsets, takes the place of the one for priority queues.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from canprobe.planning.model import CycleBudget
from canprobe.protocol.fifo_queues import worst_case_response_fifo
from canprobe.protocol.timing import BusAnalysis, Message, worst_case_response

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
