"""How long CAN frames take, and how late each message can be in the worst case.

Holds for a bus whose nodes send their highest-priority message first, without errors on the wire. Periods are
treated as independent: phases fixed by SYNC can only be better than this.

Source: Davis, Burns, Bril, Lukkien, "Controller Area Network (CAN) schedulability analysis: refuted, revisited and
revised", Real-Time Systems 35 (2007): equation numbers below are theirs.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from canprobe.errors import ProtocolError
from canprobe.protocol.frame_bits import best_case_bits, worst_case_bits

__all__ = [
    "BusAnalysis",
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
        cob_id: 11-bit identifier, which is its priority: lower wins.
        n_data: data bytes, 0..8.
        period_ns: shortest time between two of its releases.
        jitter_ns: largest delay from the event to the frame being queued.
        deadline_ns: latest end of its transmission after the event; None: the period. May exceed the period.
        frame_ns: time of one frame, where it is not the worst case at the bit rate.
    """

    name: str
    cob_id: int
    n_data: int
    period_ns: int
    jitter_ns: int = 0
    deadline_ns: int | None = None
    frame_ns: int | None = None

    @property
    def due_ns(self) -> int:
        """The deadline, or the period where none is set."""
        return self.period_ns if self.deadline_ns is None else self.deadline_ns


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


def _busy_period(blocking: int, level: Sequence[tuple[Message, int]]) -> int:
    """Length of the longest busy period of a priority level, ns; `level` has that message and all above. (6), (7)."""
    length = blocking + level[-1][1]
    while True:
        longer = blocking + sum(_ceil_div(length + m.jitter_ns, m.period_ns) * c for m, c in level)
        if longer == length:
            return length
        length = longer


def _queueing_delay(start: int, fixed: int, above: Sequence[tuple[Message, int]], bit_ns: int) -> int:
    """Smallest w with w = fixed + interference of everything above, searched upward from `start`. (9)."""
    delay = start
    while True:
        longer = fixed + sum(_ceil_div(delay + m.jitter_ns + bit_ns, m.period_ns) * c for m, c in above)
        if longer <= delay:
            return delay
        delay = longer


def _overloaded(level: Sequence[tuple[Message, int]]) -> bool:
    """Whether a level asks for the whole bus or more; exact, in integers."""
    product = 1
    for message, _ in level:
        product *= message.period_ns
    return sum(product // m.period_ns * c for m, c in level) >= product


def _respond(blocking: int, level: Sequence[tuple[Message, int]], bit_ns: int) -> Response:
    *above, (message, frame_ns) = level
    if _overloaded(level):
        return Response(message, frame_ns, None, 0)
    busy = _busy_period(blocking, level)
    instances = _ceil_div(busy + message.jitter_ns, message.period_ns)  # (8)
    worst = delay = 0
    for instance in range(instances):
        fixed = blocking + instance * frame_ns
        delay = _queueing_delay(max(delay, fixed), fixed, above, bit_ns)
        worst = max(worst, message.jitter_ns + delay - instance * message.period_ns + frame_ns)  # (10), (11)
    return Response(message, frame_ns, worst, instances)


def worst_case_response(messages: Sequence[Message], bitrate: int = 1_000_000) -> BusAnalysis:
    """Worst-case response time of every message on one bus.

    Args:
        messages: everything that is sent on this bus, in any order; identifiers are unique.
        bitrate: bit/s.

    Raises:
        ProtocolError: an identifier twice, or a message with no period, a bad identifier, length or jitter.
    """
    ordered = sorted(messages, key=lambda message: message.cob_id)
    for first, second in itertools.pairwise(ordered):
        if first.cob_id == second.cob_id:
            raise ProtocolError(f"{first.name} and {second.name} both use COB-ID {first.cob_id:03X}h")
    for message in ordered:
        if message.period_ns <= 0 or message.jitter_ns < 0 or not 0 <= message.cob_id <= 0x7FF:
            raise ProtocolError(f"{message.name}: needs a period > 0, a jitter >= 0 and an 11-bit COB-ID: {message}")
    timed = [(m, frame_time_ns(m.n_data, bitrate) if m.frame_ns is None else m.frame_ns) for m in ordered]
    bit_ns = _ceil_div(_NS, bitrate)
    responses = []
    for rank in range(len(timed)):
        blocking = max((c for _, c in timed[rank + 1 :]), default=0)
        responses.append(_respond(blocking, timed[: rank + 1], bit_ns))
    return BusAnalysis(tuple(responses), sum(c / m.period_ns for m, c in timed))
