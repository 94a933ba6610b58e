"""What the services of one node share: identity, NMT state, time, dictionary, timers, application and the frames to
send.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from heapq import heapify, heappop, heappush, heapreplace
from typing import TYPE_CHECKING, Protocol

from canprobe.emulator.node.dictionary import Dictionary
from canprobe.protocol.frames import Frame, NmtCommand, NmtState

if TYPE_CHECKING:
    from canprobe.emulator.node.slave_node import SlaveNode


# Deadlines of one node: a heap that forgives re-arming, because a cyclic node re-arms on every SYNC.

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


# What the services of one node share: identity, state, time, dictionary, timers and the frames to send.

Route = Callable[[bytes, int], None]
NO_ROUTES: Mapping[int, Route] = {}


class NodeCore:
    """Shared by the services of one node; the node itself drives it.

    Attributes:
        node_id: 1–127.
        state: NMT state.
        now_ns: time of the event being served.
        out: frames to send, in order.
    """

    __slots__ = ("dictionary", "node_id", "now_ns", "out", "reroute", "state", "timers")

    def __init__(self, node_id: int, dictionary: Dictionary) -> None:
        self.node_id = node_id
        self.dictionary = dictionary
        self.timers = Timers()
        self.state = NmtState.INITIALISING
        self.now_ns = 0
        self.out: list[Frame] = []
        self.reroute: Callable[[], None] = _nothing

    def send(self, can_id: int, data: bytes) -> None:
        """Queue a frame behind those the node already sends."""
        self.out.append((can_id, data))


class Service(Protocol):
    """One CiA 301 service of a node."""

    def reset(self, t_ns: int) -> None:
        """Forget everything and read the parameters again (the dictionary holds its defaults)."""

    def entered(self, t_ns: int) -> None:
        """The NMT state has just changed to `core.state`."""

    def routes(self) -> Mapping[int, Route]:
        """What to call for which CAN-ID, in the present NMT state."""


def _nothing() -> None:
    return None


# The NMT state machine of a slave as a table.
#
#     power on / reset → INITIALISING → (boot-up) PRE_OPERATIONAL ⇄ OPERATIONAL ⇄ STOPPED ⇄ PRE_OPERATIONAL
#
# Source: CiA 301, "NMT state machine" and "NMT node control".

_ALIVE = (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL, NmtState.STOPPED)
_GOALS = {
    NmtCommand.START: NmtState.OPERATIONAL,
    NmtCommand.STOP: NmtState.STOPPED,
    NmtCommand.PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
    NmtCommand.RESET_NODE: NmtState.INITIALISING,
    NmtCommand.RESET_COMMUNICATION: NmtState.INITIALISING,
}

NMT_TRANSITIONS: dict[tuple[NmtState, NmtCommand], NmtState] = {
    (state, command): goal for state in _ALIVE for command, goal in _GOALS.items()
}
"""Every command works in every state but INITIALISING, where none does."""


# What a device does with its CANopen node: the base class of drive and sensor, which does nothing.


class Application:
    """A device without a function; subclasses override what they need."""

    def attach(self, node: SlaveNode) -> None:
        """Once, at construction of the node: hang checks, hooks and samplers on its dictionary and PDOs."""

    def keep(self) -> bytes:
        """What "save" (1010h) stores of the device beside its dictionary."""
        return b""

    def recall(self, kept: bytes) -> None:
        """Before `reset`: what was stored; empty when nothing was, or after "load" (1011h)."""

    def reset(self, t_ns: int) -> None:
        """The node boots; the dictionary holds its defaults or what was stored."""

    def entered(self, t_ns: int) -> None:
        """The NMT state has just changed."""

    def sync(self, t_ns: int, counter: int) -> None:
        """A SYNC in operational: synchronous RPDOs have been applied, TPDOs are packed next."""

    def advance(self, t_ns: int) -> None:
        """Time has come to `t_ns`; called before anything that the node does then."""

    def connection_lost(self, t_ns: int) -> None:
        """The network is gone: heartbeat consumer, life guarding, NMT stop."""
