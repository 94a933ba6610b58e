"""Worst-case response time of each message on a CAN bus.

The analysis holds for a bus whose nodes send their highest-priority message first. Messages are independent of each
other, or part of one transaction: released at fixed offsets after an event that they share, such as SYNC. For nodes
that send their oldest frame first there is `worst_case_response_fifo`. The wire has no errors here.

With a FIFO queue a frame waits for everything that its own node has queued before it. Each of those frames competes
with its own identifier, so the one of lowest priority holds up all behind it; an offset counts as jitter. The result is
no bound where a message's response time exceeds its period, as its own last frame could then still be in the queue.
Such messages have no response time there, nor have those that they could disturb.

Source: Davis, Burns, Bril, Lukkien, "Controller Area Network (CAN) schedulability analysis: refuted, revisited and
revised", Real-Time Systems 35 (2007). Offsets: Palencia and González Harbour, "Schedulability analysis for tasks with
static and dynamic offsets", RTSS 1998. FIFO queues: Davis, Kollmann, Pollex, Slomka, "Controller Area Network (CAN)
schedulability analysis with FIFO queues", ECRTS 2011.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from canprobe.errors import ProtocolError
from canprobe.fieldbus.protocol.frame_bits import NS_PER_S, worst_case_bits


@dataclass(frozen=True, slots=True)
class Message:
    """One periodic or sporadic message.

    Attributes:
        name: name of the message, for people.
        cob_id: identifier, which is the priority: the lower one wins.
        n_data: number of data bytes, 0..8.
        period_ns: shortest time between two of its events.
        jitter_ns: largest delay from its earliest to its latest queueing.
        deadline_ns: latest end of its transmission, from the event on; it may exceed the period; None: the period.
        frame_ns: time of one frame, where it is not the worst case of a classical frame at the bit rate.
        offset_ns: earliest queueing after the event that all messages with an offset share, up to multiples of their
            periods; None for a message that keeps its own time, queued at its event at the earliest.
    """

    name: str
    cob_id: int
    n_data: int
    period_ns: int
    jitter_ns: int = 0
    deadline_ns: int | None = None
    frame_ns: int | None = None
    offset_ns: int | None = None

    @property
    def due_ns(self) -> int:
        """The deadline, or the period where none is set."""
        return self.period_ns if self.deadline_ns is None else self.deadline_ns


@dataclass(frozen=True, slots=True)
class Response:
    """Result of the analysis for one message.

    Attributes:
        message: the message.
        frame_ns: longest time of one frame.
        response_ns: longest time from the event to the end of the transmission; None: the bus cannot carry the message.
        instances: number of releases in the longest busy period; of several the first need not be the worst.
    """

    message: Message
    frame_ns: int
    response_ns: int | None
    instances: int

    @property
    def fits(self) -> bool:
        """Whether the deadline always holds."""
        return self.response_ns is not None and self.response_ns <= self.message.due_ns


@dataclass(frozen=True, slots=True)
class BusAnalysis:
    """Worst case of all messages on a bus.

    Attributes:
        responses: response of each message, highest priority first.
        load: share of the bus that all messages take with worst-case stuffing, 1.0 = full.
    """

    responses: tuple[Response, ...]
    load: float


def frame_time_ns(n_data: int, bitrate: int) -> int:
    """Longest time of a frame with n data bytes, ns, rounded up."""
    return -(-worst_case_bits(n_data) * NS_PER_S // bitrate)


def worst_case_response(messages: Sequence[Message], bitrate: int = 1_000_000) -> BusAnalysis:
    """Worst-case response time of every message on one bus.

    Args:
        messages: everything that is sent on this bus, in any order; identifiers are unique.
        bitrate: bit/s.

    Raises:
        ProtocolError: two messages have one identifier, or a message has no period, or a bad identifier, length, offset
            or jitter.
    """
    timed = _timed(messages, bitrate)
    responses = _respond_all(timed, [None] * len(timed), bitrate)
    if any(m.offset_ns is not None for m in messages):  # now it is known who can be on the bus when
        responses = _respond_all(timed, [response.response_ns for response in responses], bitrate)
    return _analysis(responses)


_Timed = tuple[Message, int]
"""A message and the time of its frame, ns."""


def _timed(messages: Sequence[Message], bitrate: int) -> list[_Timed]:
    """The messages and the times of their frames, by rising identifier."""
    ordered = sorted(messages, key=lambda message: message.cob_id)
    for first, second in itertools.pairwise(ordered):
        if first.cob_id == second.cob_id:
            raise ProtocolError(f"{first.name} and {second.name} both use COB-ID {first.cob_id:03X}h")
    for message in ordered:
        bad = message.period_ns <= 0 or min(message.jitter_ns, message.offset_ns or 0) < 0
        if bad or not 0 <= message.cob_id <= 0x7FF:
            raise ProtocolError(
                f"{message.name}: expected a period > 0, jitter and offset >= 0, an 11-bit COB-ID, got {message}"
            )
    return [(m, frame_time_ns(m.n_data, bitrate) if m.frame_ns is None else m.frame_ns) for m in ordered]


def _analysis(responses: Sequence[Response]) -> BusAnalysis:
    return BusAnalysis(tuple(responses), sum(one.frame_ns / one.message.period_ns for one in responses))


def _respond_all(timed: Sequence[_Timed], bounds: Sequence[int | None], bitrate: int) -> list[Response]:
    """Every response; `bounds` are upper bounds of them, where known."""
    known = list(zip(timed, bounds, strict=True))
    return [_respond(timed[: rank + 1], known[rank + 1 :], bitrate) for rank in range(len(timed))]


def _respond(level: Sequence[_Timed], below: Sequence[tuple[_Timed, int | None]], bitrate: int) -> Response:
    """The response of the last message of a level, which is the message and all of higher priority."""
    message, frame_ns = level[-1]
    level = [*_merged(level[:-1]), level[-1]]
    if _overloaded(level):
        return Response(message, frame_ns, None, 0)
    bit = -(-NS_PER_S // bitrate)
    found = [_busy_period(level, start, block, bit).delays() for start, block in _starts(level, below).items()]
    worst = max((delay for delays in found for delay in delays), default=0)
    return Response(message, frame_ns, max(0, (message.offset_ns or 0) + worst), max(map(len, found)))


def _merged(messages: Sequence[_Timed]) -> list[_Timed]:
    """The messages, where those of one timing count as one message with the time of all their frames.

    They are queued together in every busy period, and who is below waits for all of them.
    """
    merged: dict[tuple[int | None, int, int], _Timed] = {}
    for m, cost in messages:
        timing = m.offset_ns, m.jitter_ns, m.period_ns
        one, so_far = merged.get(timing, (m, 0))
        merged[timing] = one, so_far + cost
    return list(merged.values())


def _overloaded(level: Sequence[_Timed]) -> bool:
    """Whether a level asks for the whole bus or more; exact, in integers."""
    cycle = math.lcm(*(m.period_ns for m, _ in level))
    return sum(cycle // m.period_ns * c for m, c in level) >= cycle


class _Queued(NamedTuple):
    """A message as a busy period that begins at 0 meets it. Integers, ns.

    Attributes:
        cost: time of one frame.
        period: time between two releases.
        first: time of the first release after the beginning, 0 ≤ first < period.
        early: number of releases before the beginning that jitter has held back until then.
    """

    cost: int
    period: int
    first: int
    early: int

    def before(self, t: int) -> int:
        """Most frames that are queued in [0, t), t ≥ 0."""
        return self.early - (self.first - t) // self.period


class _BusyPeriod(NamedTuple):
    """One message and all above it, queued in a busy period that begins at 0. Integers, ns.

    Attributes:
        above: the messages of higher priority.
        own: the message.
        blocking: time of the longest frame of lower priority.
        bit: time of one bit; a frame that is queued so much later can still win the arbitration.
    """

    above: tuple[_Queued, ...]
    own: _Queued
    blocking: int
    bit: int

    def delays(self) -> list[int]:
        """Longest times from each release of the message in the busy period to its last bit."""
        own, length = self.own, 1
        while (longer := self.blocking + self._ahead(length) + own.before(length) * own.cost) > length:
            length = longer
        found, delay = [], 0
        for instance in range(own.before(length)):
            delay = self._started(max(delay, self.blocking + instance * own.cost), instance * own.cost)
            found.append(delay + own.cost - own.first - (instance - own.early) * own.period)
        return found

    def _started(self, delay: int, before: int) -> int:
        """First time at which no frame is before the message, found from below. Source: Davis et al. 2007."""
        while (longer := self.blocking + before + self._ahead(delay + self.bit)) > delay:
            delay = longer
        return delay

    def _ahead(self, t: int) -> int:
        """Time that the frames of higher priority queued in [0, t) take."""
        return sum(one.before(t) * one.cost for one in self.above)


def _busy_period(level: Sequence[_Timed], start: int, blocking: int, bit: int) -> _BusyPeriod:
    """The busy period of a level that begins `start` after the event of its transaction."""
    queued = []
    for m, cost in level:
        first = (-m.jitter_ns if m.offset_ns is None else m.offset_ns - start) % m.period_ns
        queued.append(_Queued(cost, m.period_ns, first, (m.jitter_ns + first) // m.period_ns))
    return _BusyPeriod(tuple(queued[:-1]), queued[-1], blocking, bit)


def _starts(level: Sequence[_Timed], below: Sequence[tuple[_Timed, int | None]]) -> dict[int, int]:
    """Longest blocking by a frame from below, by the time in the transaction at which a busy period has to begin.

    It begins where one of the transaction's messages is at its latest. If no message of the level keeps its own time,
    the period begins with that very message, and a frame that blocks it is on the bus between its earliest and its
    latest queueing.
    """
    below = sorted(below, key=lambda one: one[0][1], reverse=True)  # the longest frame first
    longest = below[0][0][1] if below else 0
    members = [(m, m.offset_ns) for m, _ in level if m.offset_ns is not None]
    if not members:
        return {0: longest}
    cycle = math.lcm(*(m.period_ns for m, _ in members))
    unknown = len(members) < len(level) or any(end is None for _, end in below)
    if not unknown:
        cycle = math.lcm(cycle, *(m.period_ns for (m, _), _ in below if m.offset_ns is not None))
    starts: dict[int, int] = {}
    for m, offset in members:
        for first in range(offset, offset + cycle, m.period_ns):
            start = (first + m.jitter_ns) % cycle
            blocking = longest if unknown else _blocking(below, first, m.jitter_ns)
            starts[start] = max(starts.get(start, 0), blocking)
    return starts


def _blocking(below: Sequence[tuple[_Timed, int | None]], first: int, jitter: int) -> int:
    """First of the frames from below that can be on the bus at `first` or within `jitter` after it; 0 without any."""

    def can_be_on_the_bus(m: Message, end: int | None) -> bool:
        if m.offset_ns is None or end is None:
            return True
        into = (first - m.offset_ns) % m.period_ns  # since it was last released
        return into < end - m.offset_ns or into + jitter >= m.period_ns  # it is through `end` after its event

    return next((c for (m, c), end in below if can_be_on_the_bus(m, end)), 0)


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
