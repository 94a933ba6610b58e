"""Node guarding and life guarding.

Source: CiA 301, "Node guarding protocol", "Life guarding", objects 100Ch and 100Dh; error 8130h.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from canprobe.fieldbus.node.core import NO_ROUTES, NodeCore, Route, Service
from canprobe.fieldbus.node.emcy import Emergency
from canprobe.fieldbus.protocol.emcy import HEARTBEAT_LOST_CODE
from canprobe.fieldbus.protocol.frames import HEARTBEAT_BASE, RTR_FLAG, NmtState

_MASTER_SOURCE = 0  # source of the error: the protocol does not carry the id of the master
_TOGGLE_FLAG = 0x80


class NodeGuarding(Service):
    """Answers remote requests with toggle bit and state, and watches them from the first one on, while 1017h is 0."""

    def __init__(self, core: NodeCore, emcy: Emergency, on_loss: Callable[[int], None]) -> None:
        """`on_loss(t_ns)` is called when the life guarding error occurs."""
        self._core, self._emcy, self._on_loss = core, emcy, on_loss
        self._timer = core.timers.new(self._timed_out)
        self._toggle = self._life_ns = 0
        self._heartbeat = False
        core.dictionary.on_change(self._configure, 0x100C, 0x100D, 0x1017)

    def reset(self, t_ns: int) -> None:
        """Clear the toggle bit, as the first answer after a boot-up has it, and read the parameters."""
        self._toggle = 0
        self._configure()

    def routes(self) -> Mapping[int, Route]:
        """The remote request for this node's error control identifier."""
        if self._core.state is NmtState.INITIALISING:
            return NO_ROUTES
        return {HEARTBEAT_BASE + self._core.node_id | RTR_FLAG: self._guarded}

    def _configure(self) -> None:
        number = self._core.dictionary.number
        self._heartbeat = bool(number(0x1017))
        self._life_ns = number(0x100C) * number(0x100D) * 1_000_000
        self._timer.cancel()
        self._emcy.clear(HEARTBEAT_LOST_CODE, _MASTER_SOURCE)

    def _guarded(self, data: bytes, t_ns: int) -> None:
        if self._heartbeat:
            return
        self._core.send(HEARTBEAT_BASE + self._core.node_id, bytes((self._toggle | self._core.state,)))
        self._toggle ^= _TOGGLE_FLAG
        if self._life_ns:
            self._timer.arm(t_ns + self._life_ns)
            self._emcy.clear(HEARTBEAT_LOST_CODE, _MASTER_SOURCE)

    def _timed_out(self, due_ns: int) -> None:
        self._emcy.report(HEARTBEAT_LOST_CODE, bytes((_MASTER_SOURCE,)), source=_MASTER_SOURCE)
        self._on_loss(due_ns)
