"""The deadlines of one node.

Few timers are armed at once, and most are armed again before they fire, at every SYNC. So the first deadline is looked
for among the armed timers, without a heap.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol


class Timer:
    """One deadline.

    Attributes:
        due_ns: when it fires, or None while it is not armed.
    """

    __slots__ = ("_owner", "callback", "due_ns")

    def __init__(self, owner: Timers, callback: Callable[[int], None]) -> None:
        self._owner = owner
        self.callback = callback
        self.due_ns: int | None = None

    def arm(self, due_ns: int) -> None:
        """Fire at `due_ns`, in place of any earlier order."""
        owner, before, self.due_ns = self._owner, self.due_ns, due_ns
        owner.armed[self] = due_ns
        first = owner.next_ns
        if first is None or due_ns < first or before == first:
            owner.find_next()

    def arm_next(self, due_ns: int, period_ns: int) -> None:
        """Fire one period after `due_ns`; periods already missed are skipped, the phase is kept."""
        late = self._owner.now_ns - due_ns
        self.arm(due_ns + period_ns * (1 + max(0, late) // period_ns))

    def cancel(self) -> None:
        """Do not fire."""
        if self.due_ns is not None:
            before, self.due_ns = self.due_ns, None
            del self._owner.armed[self]
            if before == self._owner.next_ns:
                self._owner.find_next()


class Holder(Protocol):
    """Somebody who shows the next deadline."""

    next_deadline_ns: int | None


class Timers:
    """All deadlines of a node.

    Args:
        holder: whose `next_deadline_ns` follows `next_ns`: buses ask for it far more often than it changes.

    Attributes:
        now_ns: the time up to which `run` was last called.
        next_ns: the earliest deadline, or None.
        armed: deadlines by timer (for `Timer`).
    """

    def __init__(self, holder: Holder) -> None:
        self._holder = holder
        self.armed: dict[Timer, int] = {}
        self.now_ns = 0
        self.next_ns: int | None = None

    def new(self, callback: Callable[[int], None]) -> Timer:
        """A timer that calls `callback(due_ns)`; not armed."""
        return Timer(self, callback)

    def find_next(self) -> None:
        """The first deadline has changed (for `Timer`)."""
        self.next_ns = self._holder.next_deadline_ns = min(self.armed.values()) if self.armed else None

    def run(self, t_ns: int) -> None:
        """Fire everything due up to and at `t_ns`, in order of time, each with the time that was ordered."""
        self.now_ns = t_ns
        while (due_ns := self.next_ns) is not None and due_ns <= t_ns:
            timer = next(timer for timer, ns in self.armed.items() if ns == due_ns)
            timer.cancel()
            timer.callback(due_ns)
