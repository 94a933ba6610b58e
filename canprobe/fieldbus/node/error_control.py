"""Error control: heartbeat producer and consumer, node guarding and life guarding.

Source: CiA 301, "Heartbeat protocol", objects 1016h and 1017h; "Node guarding protocol", "Life guarding", objects
100Ch and 100Dh; error 8130h.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

from canprobe.fieldbus.node.core import NodeCore, Route, Service
from canprobe.fieldbus.node.dictionary import Value
from canprobe.fieldbus.node.emcy import Emergency
from canprobe.fieldbus.node.timers import Timer
from canprobe.fieldbus.protocol.emcy import HEARTBEAT_LOST_CODE
from canprobe.fieldbus.protocol.frames import HEARTBEAT_BASE, RTR_FLAG, NmtState, pack_heartbeat
from canprobe.fieldbus.protocol.sdo import Abort, SdoAbort

_MASTER_SOURCE = 0  # source of the error: the protocol does not carry the id of the master
_TOGGLE_FLAG = 0x80


class HeartbeatProducer(Service):
    """Reports the NMT state every 1017h milliseconds, and at once when it changes or 1017h is written."""

    def __init__(self, core: NodeCore) -> None:
        self._core = core
        self._timer = core.timers.new(self._due)
        core.dictionary.on_write(0x1017, lambda _sub, _value: self._begin(core.now_ns))

    def reset(self, t_ns: int) -> None:
        """Stay silent until `boot_up`."""
        self._timer.cancel()

    def entered(self, t_ns: int) -> None:
        """Send a heartbeat with the new state."""
        self._begin(t_ns)

    def boot_up(self, t_ns: int) -> None:
        """Send the boot-up message, which is the first heartbeat."""
        self._core.send(*pack_heartbeat(self._core.node_id, NmtState.INITIALISING))
        if self._period_ns():
            self._timer.arm(t_ns + self._period_ns())

    def _period_ns(self) -> int:
        return self._core.dictionary.number(0x1017) * 1_000_000

    def _begin(self, t_ns: int) -> None:
        self._timer.cancel()
        if self._period_ns():
            self._due(t_ns)

    def _due(self, due_ns: int) -> None:
        self._core.send(*pack_heartbeat(self._core.node_id, self._core.state))
        self._timer.arm_next(due_ns, self._period_ns())


class HeartbeatConsumer(Service):
    """Watches the producers that 1016h names, each from its first heartbeat on."""

    def __init__(self, core: NodeCore, emcy: Emergency, on_loss: Callable[[int], None]) -> None:
        """`on_loss(t_ns)` is called when a producer is lost."""
        self._core, self._emcy, self._on_loss = core, emcy, on_loss
        self._watched: dict[int, tuple[Timer, int]] = {}  # timer and period in ns by node id
        core.dictionary.on_check(0x1016, self._check)
        core.dictionary.on_change(self._configure, 0x1016)

    def reset(self, t_ns: int) -> None:
        """Read 1016h; no producer has been heard."""
        self._configure()

    def routes(self) -> Mapping[int, Route]:
        """Heartbeat identifiers of the producers that are watched."""
        return {HEARTBEAT_BASE + node_id: partial(self._heard, node_id) for node_id in self._watched}

    def _entries(self) -> dict[int, tuple[int, int]]:
        """Node id and period in ms of the entries in use, by subindex."""
        number, found = self._core.dictionary.number, {}
        for subindex in range(1, 128):
            word = number(0x1016, subindex)
            if 1 <= word >> 16 & 0xFF <= 127 and word & 0xFFFF:
                found[subindex] = word >> 16 & 0xFF, word & 0xFFFF
        return found

    def _configure(self) -> None:
        for node_id, (timer, _) in self._watched.items():
            timer.cancel()
            self._emcy.clear(HEARTBEAT_LOST_CODE, node_id)
        self._watched = {
            node_id: (self._core.timers.new(partial(self._timed_out, node_id)), period * 1_000_000)
            for node_id, period in self._entries().values()
        }
        self._core.reroute()

    def _heard(self, node_id: int, data: bytes, t_ns: int) -> None:
        if len(data) == 1:
            timer, period_ns = self._watched[node_id]
            timer.arm(t_ns + period_ns)
            if self._emcy.any:
                self._emcy.clear(HEARTBEAT_LOST_CODE, node_id)

    def _timed_out(self, node_id: int, due_ns: int) -> None:
        self._emcy.report(HEARTBEAT_LOST_CODE, bytes((node_id,)), source=node_id)
        self._on_loss(due_ns)

    def _check(self, subindex: int, value: Value) -> None:
        node_id, period = int(value) >> 16 & 0xFF, int(value) & 0xFFFF
        if subindex == 0 or not (node_id and period):
            return
        others = {node for sub, (node, _) in self._entries().items() if sub != subindex}
        if node_id in others or node_id > 127:
            raise SdoAbort(Abort.PARAMETER_INCOMPATIBLE)


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
