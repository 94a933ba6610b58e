"""How late each message on a CAN bus can be in the worst case.

Holds for a bus whose nodes send their highest-priority message first. Messages are independent of each other, or part
of one transaction: released at fixed offsets after an event that they share, such as SYNC. Errors may be allowed for.

Source: Davis, Burns, Bril, Lukkien, "Controller Area Network (CAN) schedulability analysis: refuted, revisited and
revised", Real-Time Systems 35 (2007). Offsets: Palencia and González Harbour, RTSS 1998.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canprobe.errors import ProtocolError
from canprobe.protocol.frame_bits import WORST_ERROR_BITS, worst_case_bits

# The longest delay of one message behind everything of higher priority, in all alignments at once. Integers, ns.
#
# Source: Davis, Burns, Bril, Lukkien 2007 (busy period, non-preemptive start); Palencia and González Harbour,
# "Schedulability analysis for tasks with static and dynamic offsets", RTSS 1998 (phases within a transaction); Tindell
# and Burns 1994 (errors).

Integers = NDArray[np.int64]


class Arrivals(NamedTuple):
    """When the frames of m messages are queued in n busy periods that begin at 0.

    Attributes:
        cost: (m,) time of one frame.
        period: (m,) between two releases.
        early: (n, m) releases before 0 that jitter has held back until then.
        first: (n, m) the first release after those, 0 ≤ first < period.
    """

    cost: Integers
    period: Integers
    early: Integers
    first: Integers

    @classmethod
    def behind(cls, cost: Integers, period: Integers, jitter: Integers, phase: Integers) -> Arrivals:
        """Messages released at `phase` (n, m) (mod period) and queued up to `jitter` (m,) later, at the worst."""
        first = phase % period
        return cls(cost, period, (jitter + first) // period, first)

    def before(self, t: Integers) -> Integers:
        """Frames (n, m) queued in [0, t) (n,), at most."""
        later = self.first - t[:, None]
        later //= self.period
        np.negative(later, out=later)
        np.maximum(later, 0, out=later)
        later += self.early
        return later

    def demand(self, t: Integers) -> Integers:
        """Time (n,) that the frames queued in [0, t) take."""
        return np.asarray(self.before(t) @ self.cost, dtype=np.int64)

    def columns(self, which: slice) -> Arrivals:
        """Of some of the messages."""
        return Arrivals(self.cost[which], self.period[which], self.early[:, which], self.first[:, which])

    def rows(self, which: NDArray[np.bool_]) -> Arrivals:
        """In some of the busy periods."""
        return self._replace(early=self.early[which], first=self.first[which])


@dataclass(frozen=True, slots=True)
class Level:
    """One message and all above it, in n alignments.

    Attributes:
        arrivals: of everything of higher priority and, last, of the message.
        blocking: (n,) of the longest frame of lower priority.
        bit: a bit time: a frame queued so late can still win the arbitration.
        errors: errors of a burst.
        error_period: shortest time between two further errors; None: there are none.
        error_cost: what each error costs.
    """

    arrivals: Arrivals
    blocking: Integers
    bit: int
    errors: int = 0
    error_period: int | None = None
    error_cost: int = 0

    def lost(self, t: Integers) -> Integers | int:
        """Time (n,) that errors take within t (n,), at most."""
        further = 0 if self.error_period is None else -(-t // self.error_period)
        return (self.errors + further) * self.error_cost

    def busy(self) -> Integers:
        """Lengths (n,) of the busy periods. Source: Davis et al. 2007."""
        length = np.ones_like(self.blocking)
        while True:
            longer = self.blocking + self.lost(length) + self.arrivals.demand(length)
            if (longer <= length).all():
                return length
            length = np.maximum(length, longer)

    def worst(self) -> tuple[int, int]:
        """From a release of the message to its last bit, at most, and the most instances in one busy period."""
        own = self.arrivals.columns(slice(-1, None))
        cost = int(own.cost[0])
        instances = own.before(self.busy())[:, 0]
        left, counts = self, instances
        delay, found = np.zeros_like(self.blocking), []
        for instance in range(int(instances.max())):
            if (some := counts > instance).sum() < len(some):
                own, counts, delay, left = own.rows(some), counts[some], delay[some], left._rows(some)
            delay = left._started(np.maximum(delay, left.blocking + instance * cost), instance * cost)
            release = own.first[:, 0] + (instance - own.early[:, 0]) * own.period[0]
            found.append(int((delay + cost - release).max()))
        return max(found), int(instances.max())

    def _started(self, delay: Integers, own: int) -> Integers:
        """Smallest w (n,) at which nothing is before the message, searched upward. Source: Davis et al. 2007."""
        above, cost = self.arrivals.columns(slice(-1)), int(self.arrivals.cost[-1])
        while True:
            longer = self.blocking + own + self.lost(delay + cost) + above.demand(delay + self.bit)
            if (longer <= delay).all():
                return delay
            delay = np.maximum(delay, longer)

    def _rows(self, which: NDArray[np.bool_]) -> Level:
        return Level(
            self.arrivals.rows(which), self.blocking[which], self.bit, self.errors, self.error_period, self.error_cost
        )


# How late each message on a CAN bus can be in the worst case.

_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Message:
    """One periodic or sporadic message.

    Attributes:
        name: for people.
        cob_id: identifier, which is its priority: lower wins.
        n_data: data bytes, 0..8.
        period_ns: shortest time between two of its events.
        jitter_ns: largest delay from its earliest to its latest queueing.
        deadline_ns: latest end of its transmission after the event; None: the period. May exceed the period.
        frame_ns: time of one frame, where it is not the worst case of a classical frame at the bit rate.
        offset_ns: earliest queueing after the event that all messages with an offset share, up to multiples of their
            periods; None for a message of its own time, queued at its event at the earliest.
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
class Errors:
    """Errors on the wire that are allowed for: in any time t at most burst + ⌈t / interval⌉.

    Each costs the error frame and the longest frame that it can hit, of this priority or a higher one.

    Attributes:
        burst: errors that can come together.
        interval_ns: between further errors; None: there are none.
        overhead_bits: of one error besides the frame that has to be sent again.

    Source: Tindell and Burns 1994; Davis et al. 2007.
    """

    burst: int = 0
    interval_ns: int | None = None
    overhead_bits: int = WORST_ERROR_BITS


NO_ERRORS = Errors()


@dataclass(frozen=True, slots=True)
class Response:
    """What the analysis says of one message.

    Attributes:
        message: of which.
        frame_ns: longest time of one frame.
        response_ns: worst case from the event to the end of the transmission; None: no bound, the bus cannot carry it.
        instances: releases in the longest busy period; with more than one the first need not be the worst.
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
    """Worst case of a whole bus.

    Attributes:
        responses: one per message, highest priority first.
        load: share of the bus that all messages take with worst-case stuffing, 1.0 = full.
    """

    responses: tuple[Response, ...]
    load: float

    @property
    def fits(self) -> bool:
        """Whether every message always meets its deadline."""
        return all(response.fits for response in self.responses)

    def of(self, name: str) -> Response:
        """The response of a message by name.

        Raises:
            KeyError: no such message.
        """
        for response in self.responses:
            if response.message.name == name:
                return response
        raise KeyError(name)


def _ceil_div(numerator: int, denominator: int) -> int:
    return -(-numerator // denominator)


def frame_time_ns(n_data: int, bitrate: int) -> int:
    """Longest time of a frame with n data bytes, ns, rounded up."""
    return _ceil_div(worst_case_bits(n_data) * _NS, bitrate)


def worst_case_response(
    messages: Sequence[Message], bitrate: int = 1_000_000, *, errors: Errors = NO_ERRORS
) -> BusAnalysis:
    """Worst-case response time of every message on one bus.

    Args:
        messages: everything that is sent on this bus, in any order; identifiers are unique.
        bitrate: bit/s.
        errors: what the bus has to bear besides.

    Raises:
        ProtocolError: an identifier twice, or a message with no period, a bad identifier, length, offset or jitter.
    """
    ordered = sorted(messages, key=lambda message: message.cob_id)
    _check(ordered, errors)
    timed = [(m, frame_time_ns(m.n_data, bitrate) if m.frame_ns is None else m.frame_ns) for m in ordered]
    responses = _respond_all(timed, [None] * len(timed), bitrate, errors)
    if any(m.offset_ns is not None for m in ordered):  # now it is known who can be on the bus when
        responses = _respond_all(timed, [response.response_ns for response in responses], bitrate, errors)
    return BusAnalysis(tuple(responses), sum(c / m.period_ns for m, c in timed))


def _check(ordered: Sequence[Message], errors: Errors) -> None:
    for first, second in itertools.pairwise(ordered):
        if first.cob_id == second.cob_id:
            raise ProtocolError(f"{first.name} and {second.name} both use COB-ID {first.cob_id:03X}h")
    for message in ordered:
        if message.period_ns <= 0 or message.jitter_ns < 0 or not 0 <= message.cob_id <= 0x7FF:
            raise ProtocolError(f"{message.name}: needs a period > 0, a jitter >= 0 and an 11-bit COB-ID: {message}")
        if message.offset_ns is not None and message.offset_ns < 0:
            raise ProtocolError(f"{message.name}: needs an offset >= 0: {message}")
    if errors.burst < 0 or (errors.interval_ns is not None and errors.interval_ns <= 0):
        raise ProtocolError(f"errors need a burst >= 0 and an interval > 0: {errors}")


_Timed = tuple[Message, int]


def _respond_all(timed: Sequence[_Timed], bounds: Sequence[int | None], bitrate: int, errors: Errors) -> list[Response]:
    """Every response; `bounds` are upper bounds of them, where known."""
    known = list(zip(timed, bounds, strict=True))
    table = _table(timed)
    return [
        _respond(timed[: rank + 1], table[: rank + 1], known[rank + 1 :], bitrate, errors) for rank in range(len(timed))
    ]


def _respond(
    level: Sequence[_Timed],
    table: Integers,
    below: Sequence[tuple[_Timed, int | None]],
    bitrate: int,
    errors: Errors,
) -> Response:
    message, frame_ns = level[-1]
    error_cost = _ceil_div(errors.overhead_bits * _NS, bitrate) + max(c for _, c in level)
    if _overloaded(level, errors.interval_ns, error_cost):
        return Response(message, frame_ns, None, 0)
    starts, blocking = _starts(level, below)
    bit = _ceil_div(_NS, bitrate)
    at = Level(_aligned(table, starts), blocking, bit, errors.burst, errors.interval_ns, error_cost)
    worst, instances = at.worst()
    return Response(message, frame_ns, max(0, (message.offset_ns or 0) + worst), instances)


def _starts(level: Sequence[_Timed], below: Sequence[tuple[_Timed, int | None]]) -> tuple[Integers, Integers]:
    """Where (n,) a busy period has to begin in the transaction, and how long (n,) a frame from below can block it.

    It begins where one of the transaction's messages is at its latest. If nothing of the level keeps its own time, then
    really with that message, so that what blocks it is on the bus between its earliest and its latest queueing.
    """
    longest = max((c for (_, c), _ in below), default=0)
    members = [(m, m.offset_ns) for m, _ in level if m.offset_ns is not None]
    if not members:
        return np.zeros(1, dtype=np.int64), np.full(1, longest)
    cycle = math.lcm(*(m.period_ns for m, _ in members))
    unknown = len(members) < len(level) or any(end is None for _, end in below)
    if not unknown:
        cycle = math.lcm(cycle, *(m.period_ns for (m, _), _ in below if m.offset_ns is not None))
    releases = [np.arange(offset, offset + cycle, m.period_ns) for m, offset in members]
    first = np.concatenate(releases)
    jitter = np.repeat([m.jitter_ns for m, _ in members], [len(one) for one in releases])
    starts, index = np.unique((first + jitter) % cycle, return_inverse=True)
    blocking = np.zeros_like(starts)
    np.maximum.at(blocking, index, longest if unknown else _blocking(below, first, jitter))
    return starts, blocking


def _blocking(below: Sequence[tuple[_Timed, int | None]], first: Integers, jitter: Integers) -> Integers:
    """Longest frame that can be on the bus at `first` (n,) or within `jitter` (n,) after it."""
    always = max((c for (m, c), end in below if m.offset_ns is None or end is None), default=0)
    # a message with an offset is through `end` after its event at the latest
    table = [(c, m.period_ns, m.offset_ns, end) for (m, c), end in below if None not in (m.offset_ns, end)]
    if not table:
        return np.full_like(first, always)
    cost, period, offset, end = np.array(table, dtype=np.int64).T
    into = (first[:, None] - offset) % period  # since it was last released
    on_the_bus = (into < end - offset) | (into + jitter[:, None] >= period)
    return np.asarray(np.where(on_the_bus, cost, 0).max(axis=1, initial=always), dtype=np.int64)


def _table(timed: Sequence[_Timed]) -> Integers:
    """(m, 5): frame, period, jitter, whether there is an offset, and phase in a busy period that begins at 0."""
    rows = [
        (c, m.period_ns, m.jitter_ns, *((0, -m.jitter_ns) if m.offset_ns is None else (1, m.offset_ns)))
        for m, c in timed
    ]
    return np.array(rows, dtype=np.int64).reshape(-1, 5)


def _aligned(table: Integers, starts: Integers) -> Arrivals:
    """The messages of a `_table` in busy periods that begin at these phases of the transaction."""
    cost, period, jitter, moves, phase = table.T
    return Arrivals.behind(cost, period, jitter, phase - starts[:, None] * moves)


def _overloaded(level: Sequence[_Timed], error_interval: int | None, error_cost: int) -> bool:
    """Whether a level asks for the whole bus or more; exact, in integers."""
    demands = [(m.period_ns, c) for m, c in level]
    if error_interval is not None:
        demands.append((error_interval, error_cost))
    cycle = math.lcm(*(period for period, _ in demands))
    return sum(cycle // period * c for period, c in demands) >= cycle


# How late a message can be where nodes send their oldest frame first, as SocketCAN's queue and many controllers do.
#
# A frame then waits for everything that its own node has queued before it, and each of those competes with its own
# identifier: the one of lowest priority holds up all behind it. Messages are independent of each other; an offset
# counts as jitter. It stops being a bound where a message's response time exceeds its period: its own last frame could
# then still be in the queue. Such messages have no response time here, nor have those that they could disturb.
#
# Source: Davis, Kollmann, Pollex, Slomka, "Controller Area Network (CAN) schedulability analysis with FIFO queues",
# ECRTS 2011.


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
