"""What the services of one node share: identity, NMT state, time, dictionary, timers and the frames to send."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

from canprobe.fieldbus.node.dictionary import Abort, Dictionary, SdoAbort, Value, nothing
from canprobe.fieldbus.node.quirks import Quirks
from canprobe.fieldbus.protocol.frames import Frame, NmtCommand, NmtState, is_restricted

# Deadlines of one node. Few of them are armed at once, and most are armed again before they fire, at every SYNC: the
# first is looked for among those that are armed.


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


# What the services of one node share: identity, state, time, dictionary, timers and the frames to send.

Route = Callable[[bytes, int], None]
NO_ROUTES: Mapping[int, Route] = {}


class NodeCore:
    """Shared by the services of one node; the node itself drives it.

    Args:
        node_id: 1–127, or 255 for none.
        dictionary: the node's.
        holder: shows the next deadline of the timers.
        quirks: what makes the node difficult.

    Attributes:
        state: NMT state.
        now_ns: time of the event being served.
        out: frames to send, in order.
        reroute: to be called when the routes of a service have changed.
    """

    def __init__(self, node_id: int, dictionary: Dictionary, holder: Holder, quirks: Quirks) -> None:
        self.node_id = node_id
        self.dictionary = dictionary
        self.quirks = quirks
        _refuse(dictionary, quirks)
        self.timers = Timers(holder)
        self.state = NmtState.INITIALISING
        self.now_ns = 0
        self.out: list[Frame] = []
        self.reroute: Callable[[], None] = nothing

    def send(self, can_id: int, data: bytes) -> None:
        """Queue a frame behind those the node already sends."""
        self.out.append((can_id, data))


def _refuse(dictionary: Dictionary, quirks: Quirks) -> None:
    """Hang the checks of a node that refuses writes, before any other."""

    def refuse(subindex: int, value: Value) -> None:
        raise SdoAbort(Abort.UNSUPPORTED_ACCESS)

    def refuse_cob_id(subindex: int, value: Value) -> None:
        if subindex == 1:
            raise SdoAbort(Abort.READ_ONLY)

    def refuse_mapping(subindex: int, value: Value) -> None:
        raise SdoAbort(Abort.READ_ONLY)

    for index in quirks.refuse:
        dictionary.on_check(index, refuse)
    for index in dictionary.indices_in(range(0x1400, 0x1C00)) if quirks.fixed_mapping else ():
        dictionary.on_check(index, refuse_mapping if index & 0x200 else refuse_cob_id)
    for index in dictionary.indices_in(range(0x1800, 0x1A00)) if quirks.keep_bit30 else ():

        def keep_bit30(subindex: int, value: Value, index: int = index) -> None:
            if subindex == 1 and (int(value) ^ dictionary.number(index, 1)) & NO_RTR:
                raise SdoAbort(Abort.VALUE)

        dictionary.on_check(index, keep_bit30)


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
NO_RTR = 1 << 30
"""Of the COB-ID of a TPDO: a remote request is not answered."""


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
