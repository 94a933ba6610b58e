"""What the services of one node share: identity, NMT state, time, dictionary, timers and the frames to send."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from heapq import heapify, heappop, heappush, heapreplace
from typing import Protocol

from canprobe.emulator.node.dictionary import Abort, Dictionary, SdoAbort, Value, nothing
from canprobe.protocol.frames import Frame, NmtCommand, NmtState, is_restricted

# Deadlines of one node: a heap that forgives re-arming, because a cyclic node re-arms on every SYNC.

_ROOM = 64


class Timer:
    """One deadline. Re-arming to a later time costs an assignment; the heap is put right when it becomes the first.

    Attributes:
        due_ns: when it fires, or None while it is not armed.
        queued_ns: where its entry on the heap is, at `due_ns` or before (for `Timers`).
    """

    __slots__ = ("_owner", "callback", "due_ns", "queued_ns")

    def __init__(self, owner: Timers, callback: Callable[[int], None]) -> None:
        self._owner = owner
        self.callback = callback
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
    """

    def __init__(self, holder: Holder) -> None:
        self._heap: list[tuple[int, int, Timer]] = []
        self._count = 0
        self._most = _ROOM
        self._holder = holder
        self.now_ns = 0
        self.next_ns: int | None = None

    def new(self, callback: Callable[[int], None]) -> Timer:
        """A timer that calls `callback(due_ns)`; not armed."""
        return Timer(self, callback)

    def queue(self, due_ns: int, timer: Timer) -> None:
        """Put an entry on the heap (for `Timer`)."""
        self._count += 1
        heappush(self._heap, (due_ns, self._count, timer))
        if self.next_ns is None or due_ns < self.next_ns:
            self.next_ns = self._holder.next_deadline_ns = due_ns
        if len(self._heap) > self._most:
            self._compact()

    def tidy(self) -> None:
        """Put the heap right where its first entry is of a deadline that was moved or cancelled (for `Timer`)."""
        heap = self._heap
        while heap:
            queued, _, timer = heap[0]
            due = timer.due_ns
            if due == queued:
                self.next_ns = self._holder.next_deadline_ns = due
                return
            if timer.holds(queued) and due is not None:
                timer.queued_ns = due
                self._count += 1
                heapreplace(heap, (due, self._count, timer))
            else:
                heappop(heap)
        self.next_ns = self._holder.next_deadline_ns = None

    def _compact(self) -> None:
        """Drop the entries of deadlines that were moved or cancelled, which else stay until their time."""
        heap = self._heap
        heap[:] = {timer: (due, count, timer) for due, count, timer in heap if timer.holds(due)}.values()
        heapify(heap)
        self._most = 2 * len(heap) + _ROOM

    def run(self, t_ns: int) -> None:
        """Fire everything due up to and at `t_ns`, in order of time, then of arming, each with the time ordered."""
        self.now_ns = t_ns
        heap = self._heap
        while heap and heap[0][0] <= t_ns:
            due, _, timer = heappop(heap)
            timer.due_ns = timer.queued_ns = None
            timer.callback(due)
            self.tidy()


# What the services of one node share: identity, state, time, dictionary, timers and the frames to send.

Route = Callable[[bytes, int], None]
NO_ROUTES: Mapping[int, Route] = {}


class NodeCore:
    """Shared by the services of one node; the node itself drives it.

    Args:
        node_id: 1–127, or 255 for none.
        dictionary: the node's.
        holder: shows the next deadline of the timers.

    Attributes:
        state: NMT state.
        now_ns: time of the event being served.
        out: frames to send, in order.
        reroute: to be called when the routes of a service have changed.
    """

    def __init__(self, node_id: int, dictionary: Dictionary, holder: Holder) -> None:
        self.node_id = node_id
        self.dictionary = dictionary
        self.timers = Timers(holder)
        self.state = NmtState.INITIALISING
        self.now_ns = 0
        self.out: list[Frame] = []
        self.reroute: Callable[[], None] = nothing

    def send(self, can_id: int, data: bytes) -> None:
        """Queue a frame behind those the node already sends."""
        self.out.append((can_id, data))


class Service:
    """One CiA 301 service of a node. The base class keeps nothing and hears nothing."""

    def reset(self, t_ns: int) -> None:
        """Forget everything and read the parameters again (the dictionary holds its defaults)."""

    def entered(self, t_ns: int) -> None:
        """The NMT state has just changed to `core.state`."""

    def routes(self) -> Mapping[int, Route]:
        """What to call for which CAN-ID, in the present NMT state."""
        return NO_ROUTES


INVALID = 1 << 31
"""Of a COB-ID: the object does not exist."""


def check_cob_id(new: Value, old: int, reserved: int = 0x3FFFF800) -> None:
    """Raises SdoAbort for a COB-ID with reserved or 29-bit bits, of a restricted identifier, or of another while valid.

    Source: CiA 301, objects 1014h, 1200h, 1400h, 1800h, "Restricted CAN-IDs".
    """
    word = int(new)
    changed_while_valid = not (word | old) & INVALID and (word ^ old) & 0x7FF
    if word & reserved or changed_while_valid or (not word & INVALID and is_restricted(word & 0x7FF)):
        raise SdoAbort(Abort.VALUE)


# The NMT state machine of a slave as a table.
#
#     power on / reset → INITIALISING → (boot-up) PRE_OPERATIONAL ⇄ OPERATIONAL ⇄ STOPPED ⇄ PRE_OPERATIONAL
#
# Every command works in every state but INITIALISING, where none does.
# Source: CiA 301, "NMT state machine" and "NMT node control".

NMT_GOALS = {
    NmtCommand.START: NmtState.OPERATIONAL,
    NmtCommand.STOP: NmtState.STOPPED,
    NmtCommand.PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
    NmtCommand.RESET_NODE: NmtState.INITIALISING,
    NmtCommand.RESET_COMMUNICATION: NmtState.INITIALISING,
}
