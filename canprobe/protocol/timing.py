"""How late each message on a CAN bus can be in the worst case.

Holds for a bus whose nodes send their highest-priority message first. Messages are independent of each other, or part
of one transaction: released at fixed offsets after an event that they share, such as SYNC. Errors may be allowed for.

Source: Davis, Burns, Bril, Lukkien, "Controller Area Network (CAN) schedulability analysis: refuted, revisited and
revised", Real-Time Systems 35 (2007). Offsets: Palencia and González Harbour, RTSS 1998.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from canprobe.errors import ProtocolError
from canprobe.protocol.busy_period import Arrivals, Integers, Level
from canprobe.protocol.frame_bits import WORST_ERROR_BITS, best_case_bits, worst_case_bits

__all__ = [
    "NO_ERRORS",
    "BusAnalysis",
    "Errors",
    "Message",
    "Response",
    "best_case_bits",
    "frame_time_ns",
    "worst_case_bits",
    "worst_case_response",
]

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
