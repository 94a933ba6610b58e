"""How late a message can be where nodes send their oldest frame first, as SocketCAN's queue and many controllers do.

A frame then waits for everything that its own node has queued before it, and each of those competes with its own
identifier: the one of lowest priority holds up all behind it. Messages are independent of each other; an offset counts
as jitter. It stops being a bound where a message's response time exceeds its period: its own last frame could
then still be in the queue. Such messages have no response time here, nor have those that they could disturb.

Source: Davis, Kollmann, Pollex, Slomka, "Controller Area Network (CAN) schedulability analysis with FIFO queues",
ECRTS 2011.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from canprobe.errors import ProtocolError
from canprobe.protocol.timing import BusAnalysis, Message, Response, frame_time_ns

_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class _Sent:
    """A message, its frame's time, the messages of its queue (itself alone with a priority queue), ns."""

    message: Message
    frame_ns: int
    queue: tuple[int, ...]


def worst_case_response_fifo(
    messages: Sequence[Message], fifo_nodes: Mapping[str, object], bitrate: int = 1_000_000
) -> BusAnalysis:
    """Worst-case response time of every message on a bus on which some nodes have FIFO queues.

    Args:
        messages: everything that is sent on this bus; identifiers are unique.
        fifo_nodes: of every message that goes through a FIFO queue: its name → whose queue; the others' nodes send
            their message of highest priority first.
        bitrate: bit/s.

    Raises:
        ProtocolError: an identifier twice, or a name that no message has.
    """
    ordered = sorted(messages, key=lambda message: message.cob_id)
    if len({message.cob_id for message in ordered}) < len(ordered):
        raise ProtocolError("two messages use the same COB-ID")
    if unknown := set(fifo_nodes) - {message.name for message in ordered}:
        raise ProtocolError(f"no message is called {min(unknown)}")
    sent = [
        _Sent(_from_the_event(m), m.frame_ns or frame_time_ns(m.n_data, bitrate), _queue(ordered, m, fifo_nodes))
        for m in ordered
    ]
    found = _settled(sent, -(-_NS // bitrate))
    responses = tuple(
        Response(message, one.frame_ns, total, 0 if total is None else 1)
        for message, one, total in zip(ordered, sent, found, strict=True)
    )
    return BusAnalysis(responses, sum(one.frame_ns / one.message.period_ns for one in sent))


def _from_the_event(message: Message) -> Message:
    """Queued at any time from the event to the latest that its offset and jitter allow."""
    return replace(message, jitter_ns=message.jitter_ns + (message.offset_ns or 0), offset_ns=None)


def _queue(ordered: Sequence[Message], message: Message, fifo_nodes: Mapping[str, object]) -> tuple[int, ...]:
    own = fifo_nodes.get(message.name)
    shared = (rank for rank, other in enumerate(ordered) if own is not None and fifo_nodes.get(other.name) == own)
    return tuple(shared) or (ordered.index(message),)


def _settled(sent: Sequence[_Sent], bit: int) -> list[int | None]:
    """Responses from the events, repeated until the delays in the queues, which they hang on, move no more."""
    delays: list[int | None] = [0] * len(sent)
    while True:
        found = [_response(sent, rank, delays, bit) for rank in range(len(sent))]
        following = [None if total is None else _in_the_queue(sent, rank, total) for rank, total in enumerate(found)]
        if following == delays:
            return found
        delays = following


def _in_the_queue(sent: Sequence[_Sent], rank: int, total: int) -> int:
    """How long after its queueing a frame can begin to compete."""
    one = sent[rank]
    return total - one.message.jitter_ns - one.frame_ns if len(one.queue) > 1 else 0


def _response(sent: Sequence[_Sent], rank: int, delays: Sequence[int | None], bit: int) -> int | None:
    """From the event to the end of the frame; None where that is no bound."""
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
