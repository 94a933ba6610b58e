"""Deadlines of one node: a heap that forgives re-arming, because a cyclic node re-arms on every SYNC."""

from __future__ import annotations

from collections.abc import Callable
from heapq import heapify, heappop, heappush, heapreplace
from typing import Protocol

_ROOM = 64


class Timer:
    """One deadline. Re-arming to a later time costs an assignment; the heap is put right when it becomes the first.

    Attributes:
        due_ns: when it fires, or None while it is not armed.
        queued_ns: where its entry on the heap is, at `due_ns` or before (for `Timers`).
    """

    __slots__ = ("_callback", "_owner", "due_ns", "queued_ns")

    def __init__(self, owner: Timers, callback: Callable[[int], None]) -> None:
        self._owner = owner
        self._callback = callback
        self.queued_ns: int | None = None
        self.due_ns: int | None = None

    def arm(self, due_ns: int) -> None:
        """Fire at `due_ns`, in place of any earlier order."""
        self.due_ns = due_ns
        queued = self.queued_ns
        if queued is None or due_ns < queued:
            self.queued_ns = due_ns
            self._owner.queue(due_ns, self)
        elif queued == self._owner.next_ns:
            self._owner.tidy()

    def arm_next(self, due_ns: int, period_ns: int) -> None:
        """Fire one period after `due_ns`; periods already missed are skipped, the phase is kept."""
        late = self._owner.now_ns - due_ns
        self.arm(due_ns + period_ns * (1 + max(0, late) // period_ns))

    def cancel(self) -> None:
        """Do not fire."""
        self.due_ns = None
        if self.queued_ns is not None:
            self._owner.tidy()

    def holds(self, queued_ns: int) -> bool:
        """Whether the entry of `queued_ns` is still needed; if it is not, it counts as taken off the heap."""
        if queued_ns != self.queued_ns:
            return False
        if self.due_ns is None:
            self.queued_ns = None
        return self.due_ns is not None

    def fire(self, due_ns: int) -> None:
        """Disarm and call back with the time that was ordered; the entry is off the heap."""
        self.due_ns = self.queued_ns = None
        self._callback(due_ns)


class Holder(Protocol):
    """Somebody who shows the next deadline."""

    next_deadline_ns: int | None


class _Nobody:
    next_deadline_ns: int | None = None


class Timers:
    """All deadlines of a node.

    Attributes:
        now_ns: the time up to which `run` was last called.
        next_ns: the earliest deadline, or None.
        holder: whose `next_deadline_ns` is the same: buses ask for it far more often than it changes.
    """

    __slots__ = ("_count", "_heap", "_most", "holder", "next_ns", "now_ns")

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, Timer]] = []
        self._count = 0
        self._most = _ROOM
        self.now_ns = 0
        self.next_ns: int | None = None
        self.holder: Holder = _Nobody()

    def new(self, callback: Callable[[int], None]) -> Timer:
        """A timer that calls `callback(due_ns)`; not armed."""
        return Timer(self, callback)

    def queue(self, due_ns: int, timer: Timer) -> None:
        """Put an entry on the heap (for `Timer`)."""
        self._count += 1
        heappush(self._heap, (due_ns, self._count, timer))
        if self.next_ns is None or due_ns < self.next_ns:
            self.next_ns = self.holder.next_deadline_ns = due_ns
        if len(self._heap) > self._most:
            self._compact()

    def tidy(self) -> None:
        """Put the heap right where its first entry is of a deadline that was moved or cancelled (for `Timer`)."""
        heap = self._heap
        while heap:
            queued, _, timer = heap[0]
            due = timer.due_ns
            if due == queued:
                self.next_ns = self.holder.next_deadline_ns = due
                return
            if timer.holds(queued) and due is not None:
                timer.queued_ns = due
                self._count += 1
                heapreplace(heap, (due, self._count, timer))
            else:
                heappop(heap)
        self.next_ns = self.holder.next_deadline_ns = None

    def _compact(self) -> None:
        """Drop the entries of deadlines that were moved or cancelled, which else stay until their time."""
        heap = self._heap
        heap[:] = {timer: (due, count, timer) for due, count, timer in heap if timer.holds(due)}.values()
        heapify(heap)
        self._most = 2 * len(heap) + _ROOM

    def run(self, t_ns: int) -> None:
        """Fire everything due up to and at `t_ns`, in order of time, then of arming."""
        self.now_ns = t_ns
        heap = self._heap
        while heap and heap[0][0] <= t_ns:
            due, _, timer = heappop(heap)
            timer.fire(due)
            self.tidy()
