"""How late a message can be where nodes send their oldest frame first, as SocketCAN's queue and many controllers do.

A frame then waits for everything that its own node has queued before it. Each of those frames competes with its own
identifier, so the one of lowest priority holds up all behind it. Messages are independent of each other; an offset
counts as jitter. The result is no bound where a message's response time exceeds its period, as its own last frame could
then still be in the queue. Such messages have no response time here, nor have those that they could disturb.

Source: Davis, Kollmann, Pollex, Slomka, "Controller Area Network (CAN) schedulability analysis with FIFO queues",
ECRTS 2011.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from canprobe.errors import ProtocolError
from canprobe.fieldbus.protocol.response_times import NS_PER_S, BusAnalysis, Message, Response, _analysis, _timed


@dataclass(frozen=True, slots=True)
class _Sent:
    """A message, the time of its frame in ns, and the messages of its queue: itself alone with a priority queue."""

    message: Message
    frame_ns: int
    queue: tuple[int, ...]


def worst_case_response_fifo(
    messages: Sequence[Message], fifo_nodes: Mapping[str, object], bitrate: int = 1_000_000
) -> BusAnalysis:
    """Worst-case response time of every message on a bus on which some nodes have FIFO queues.

    Args:
        messages: everything that is sent on this bus; identifiers are unique.
        fifo_nodes: the owner of the queue, by the name of each message that goes through a FIFO queue; the nodes of
            the other messages send their message of highest priority first.
        bitrate: bit/s.

    Raises:
        ProtocolError: two messages have one identifier, or no message has a name of `fifo_nodes`.
    """
    timed = _timed(messages, bitrate)
    if unknown := set(fifo_nodes) - {message.name for message in messages}:
        raise ProtocolError(f"fifo_nodes: no message is called {min(unknown)}")
    owners = [fifo_nodes.get(message.name) for message, _ in timed]
    sent = []
    for rank, ((message, frame_ns), owner) in enumerate(zip(timed, owners, strict=True)):
        queue = (rank,) if owner is None else tuple(r for r, other in enumerate(owners) if other == owner)
        # queued at any time from the event to the latest that its offset and jitter allow
        at_any_time = replace(message, jitter_ns=message.jitter_ns + (message.offset_ns or 0), offset_ns=None)
        sent.append(_Sent(at_any_time, frame_ns, queue))
    found = _settled(sent, -(-NS_PER_S // bitrate))
    return _analysis(
        [
            Response(message, frame_ns, total, 0 if total is None else 1)
            for (message, frame_ns), total in zip(timed, found, strict=True)
        ]
    )


def _settled(sent: Sequence[_Sent], bit: int) -> list[int | None]:
    """Responses from the events, computed again until the delays in the queues, on which they depend, stay the same."""
    delays: list[int | None] = [0] * len(sent)
    while True:
        found = [_response(sent, rank, delays, bit) for rank in range(len(sent))]
        following = [None if total is None else _in_the_queue(sent, rank, total) for rank, total in enumerate(found)]
        if following == delays:
            return found
        delays = following


def _in_the_queue(sent: Sequence[_Sent], rank: int, total: int) -> int:
    """Longest time from the queueing of a frame until it competes, ns."""
    one = sent[rank]
    return total - one.message.jitter_ns - one.frame_ns if len(one.queue) > 1 else 0


def _response(sent: Sequence[_Sent], rank: int, delays: Sequence[int | None], bit: int) -> int | None:
    """Time from the event to the end of the frame, ns; None where there is no bound."""
    one = sent[rank]
    lowest, frames = max(one.queue), [sent[other].frame_ns for other in one.queue]
    above = [other for other in range(lowest) if other not in one.queue]
    if any(delays[other] is None for other in above):
        return None
    blocking = max([*frames, *(other.frame_ns for other in sent[lowest + 1 :])])
    ahead = blocking + sum(frames) - one.frame_ns
    disturbing = [
        (sent[k].frame_ns, sent[k].message.period_ns, sent[k].message.jitter_ns + (delays[k] or 0)) for k in above
    ]
    limit = one.message.period_ns - one.message.jitter_ns - one.frame_ns
    delay = ahead
    while delay <= limit:
        longer = ahead + sum(-(-(delay + bit + late) // period) * cost for cost, period, late in disturbing)
        if longer <= delay:
            return one.message.jitter_ns + delay + one.frame_ns
        delay = longer
    return None
