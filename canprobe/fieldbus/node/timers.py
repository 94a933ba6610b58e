"""The deadlines of one node.

Few timers are armed at once, and most are armed again at every SYNC, before they fire. So the first deadline is found
by a search through the armed timers, without a heap.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol


class Timer:
    """One deadline.

    Attributes:
        due_ns: time at which it fires; None while it is not armed.
    """

    __slots__ = ("_owner", "callback", "due_ns")

    def __init__(self, owner: Timers, callback: Callable[[int], None]) -> None:
        self._owner = owner
        self.callback = callback
        self.due_ns: int | None = None

    def arm(self, due_ns: int) -> None:
        """Fire at `due_ns`, in place of any earlier deadline."""
        owner, before, self.due_ns = self._owner, self.due_ns, due_ns
        owner.armed[self] = due_ns
        first = owner.next_ns
        if first is None or due_ns < first or before == first:
            owner.find_next()

    def arm_next(self, due_ns: int, period_ns: int) -> None:
        """Fire one period after `due_ns`; periods that are past are skipped, and the phase stays."""
        late = self._owner.now_ns - due_ns
        self.arm(due_ns + period_ns * (1 + max(0, late) // period_ns))

    def cancel(self) -> None:
        """Disarm the timer."""
        if self.due_ns is not None:
            before, self.due_ns = self.due_ns, None
            del self._owner.armed[self]
            if before == self._owner.next_ns:
                self._owner.find_next()


class Holder(Protocol):
    """An object that shows the next deadline."""

    next_deadline_ns: int | None


class Timers:
    """All deadlines of a node.

    Args:
        holder: object whose `next_deadline_ns` follows `next_ns`; buses read it far more often than it changes.

    Attributes:
        now_ns: time up to which `run` was last called.
        next_ns: earliest deadline, or None.
        armed: deadlines by timer, which `Timer` keeps.
    """

    def __init__(self, holder: Holder) -> None:
        self._holder = holder
        self.armed: dict[Timer, int] = {}
        self.now_ns = 0
        self.next_ns: int | None = None

    def new(self, callback: Callable[[int], None]) -> Timer:
        """Make a timer that calls `callback(due_ns)`; it is not armed."""
        return Timer(self, callback)

    def find_next(self) -> None:
        """Find the earliest deadline, which `Timer` has changed."""
        self.next_ns = self._holder.next_deadline_ns = min(self.armed.values()) if self.armed else None

    def run(self, t_ns: int) -> None:
        """Fire every timer that is due up to and at `t_ns`, in order of time, each with its own deadline."""
        self.now_ns = t_ns
        while (due_ns := self.next_ns) is not None and due_ns <= t_ns:
            timer = next(timer for timer, ns in self.armed.items() if ns == due_ns)
            timer.cancel()  # before the call, which may arm it again
            timer.callback(due_ns)
