"""Faults of a bus that tests cause: a babbling idiot, and bits that are hit where the test says."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from canprobe.fieldbus.bus.virtual.lockstep import Participant
from canprobe.fieldbus.protocol.frames import Frame

# A babbling idiot: a node that talks without being asked, as a broken controller does.


class Babbler(Participant):
    """Queues one frame again and again; a participant for a lockstep bus.

    Args:
        frame: what it says; a low identifier shuts everybody else up.
        period_ns: from one to the next; the frame's own time fills the bus.
        first_ns: when it begins.
        last_ns: when it falls silent; None: never.
    """

    name = "babbling idiot"
    listens: frozenset[int] = frozenset()
    next_deadline_ns: int | None = None

    def __init__(self, frame: Frame, period_ns: int, first_ns: int = 0, last_ns: int | None = None) -> None:
        if period_ns <= 0:
            raise ValueError(f"the period of a babbling idiot must be above 0 ns, not {period_ns}")
        self._frame = frame
        self._period_ns = period_ns
        self._last_ns = last_ns
        self.next_deadline_ns = first_ns

    def advance(self, t_ns: int) -> Sequence[Frame]:
        """Say it once more."""
        following = t_ns + self._period_ns
        self.next_deadline_ns = None if self._last_ns is not None and following > self._last_ns else following
        return (self._frame,)


class ErrorsAt:
    """Fails the transmissions with these numbers, counted from 0, each at the given bit.

    Args:
        hits: number of the transmission → its bit; retransmissions count too.
        can_id: only transmissions of this identifier count, where given.
    """

    def __init__(self, hits: Mapping[int, int], can_id: int | None = None) -> None:
        self._hits = hits
        self._can_id = can_id
        self._count = 0

    def __call__(self, can_id: int, data: bytes, bits: int) -> int | None:
        """Its bit, where this transmission is one of them."""
        if self._can_id is not None and can_id != self._can_id:
            return None
        hit = self._hits.get(self._count)
        self._count += 1
        return hit if hit is None else min(hit, bits - 1)
